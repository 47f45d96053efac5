// What the page shows, shared by its parts. `state.at_s` null means live.

import { openSource } from "./source.js";

export const source = openSource();
export const state = {
  meta: null, live: null, frame: null, view: null, at_s: null, selected: null, tab: "alarms", arrangement: "auto",
  alarms: [], reference: null, link: "connecting", linkReason: "", lostAt_s: null, report: [], tracks: [], hasSnr: true, span: null, window_s: 3600, playing: 0, offset_s: 0,
};

export const now_s = () => Date.now() / 1000 + state.offset_s;
export const interval_s = () => state.frame?.airtime?.interval_s ?? state.meta?.interval_s ?? 5;
export const shown_s = () => state.at_s ?? state.frame?.time_s ?? now_s();
