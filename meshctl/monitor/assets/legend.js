// The legend of the map.

import { byId, el } from "./dom.js";
import { drawSample } from "./signs.js";
import { state } from "./state.js";

// `colors` are those of the map.
export function showLegend(colors) {
  const [good, fair, poor] = state.hasSnr ? ["> 20 dB", "10–20 dB", "< 10 dB"] : ["≥ 80 %", "50–80 %", "< 50 %"];
  const entries = [["good", `good ${good}`], ["fair", `fair ${fair}`], ["poor", `poor ${poor}`], ["one-way", "one-way"], ["stale", "stale"], ["path", "path to base"], ["cut", "single point of failure"], ["base", "base"], ["robot", "robot"], ["beacon", "beacon"], ...(state.tracks.length > 0 ? [["track", "track, online"], ["lost-track", "track, offline"]] : [])];
  byId("legend").replaceChildren(...entries.map(([kind, text]) => {
    const sample = el("canvas", { "aria-hidden": "true" });
    drawSample(sample, kind, colors);
    return el("li", {}, sample, text);
  }));
}
