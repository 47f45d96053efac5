// The page: one state, shown by the strip, the map, the panels and the timeline.

import { byId, el, setText } from "./dom.js";
import { clockTime, isKnown } from "./format.js";
import { differences, viewOf } from "./model.js";
import { Layout } from "./layout.js";
import { MeshCanvas } from "./mesh.js";
import { showLegend } from "./legend.js";
import { Charts } from "./charts.js";
import { markersOf, showReport, tracksOf } from "./report.js";
import { Timeline } from "./timeline.js";
import { AlarmSound } from "./sound.js";
import { openSilence } from "./actions.js";
import { interval_s, now_s, shown_s, source, state } from "./state.js";
import { recalled, remember } from "./storage.js";
import { count, notice, showClock, showStrip } from "./strip.js";
import { alarmsAt, isQuiet, showAlarms, showChanges, showDetails, showRadios, showRobots } from "./panels.js";

const TABS = ["robots", "alarms", "radios", "changes", "details", "report"];
const MAX_BUCKETS = 240;
const CHARTS_EVERY_MS = 4000;
const TIMELINE_EVERY_MS = 4000;
const PLAY_EVERY_MS = 200;
const REFERENCE_KEY = "meshctl-monitor-reference";

const layout = new Layout();
const sound = new AlarmSound();
const mesh = new MeshCanvas(byId("mesh"), byId("tip"), (name) => select(name));
const timeline = new Timeline((time_s) => goTo(time_s));
let charts = null;
let wanted = null;
let isFetching = false;
let timelineAt = -Infinity;
let chartsAt = -Infinity;

// ---- time

async function goTo(at_s) {
  const last = state.span?.[1] ?? at_s;
  const first = state.span?.[0] ?? at_s;
  state.at_s = Math.min(last, Math.max(first, at_s));
  timeline.setTime(state.at_s);
  wanted = state.at_s;
  if (isFetching) return;
  isFetching = true;
  try {
    while (wanted !== null) {
      const target = wanted;
      wanted = null;
      const frame = await source.frame(target);
      // back to live meanwhile
      if (state.at_s !== null) show(frame);
    }
  } catch (error) {
    notice(`Cannot load ${clockTime(at_s)}: ${error.message}`);
  } finally {
    isFetching = false;
  }
}

function goLive() {
  if (state.meta?.mode === "replay") { goTo(state.span[1]); return; }
  stop();
  state.at_s = null;
  wanted = null;
  if (state.live !== null) show(state.live);
}

function step(by) {
  goTo(shown_s() + by * Math.max(0.5, interval_s()));
}

function play() {
  if (state.playing !== 0) { stop(); return; }
  if (state.at_s === null || (state.meta.mode === "replay" && state.at_s >= state.span[1])) goTo(state.at_s === null ? timeline.span.from_s : state.span[0]);
  byId("play").textContent = "❚❚";
  byId("play").setAttribute("aria-label", "Pause");
  state.playing = setInterval(() => {
    const next = state.at_s + (PLAY_EVERY_MS / 1000) * Number(byId("speed").value);
    if (next >= state.span[1]) { goLive(); stop(); } else goTo(next);
  }, PLAY_EVERY_MS);
}

function stop() {
  clearInterval(state.playing);
  state.playing = 0;
  byId("play").textContent = "▶";
  byId("play").setAttribute("aria-label", "Play");
}

// ---- showing

function show(frame) {
  if (frame === null || frame === undefined) return;
  state.frame = frame;
  state.view = viewOf(withMeters(frame), state.meta);
  render();
}

// Live, readings of the placement meter arrive between frames.
const withMeters = (frame) => (state.at_s === null && state.meters !== undefined ? { ...frame, meters: state.meters } : frame);

function render() {
  const { view } = state;
  if (view === null) return;
  const changes = state.reference === null ? [] : differences(view, state.reference);
  const isMetric = isMetricView(view);
  mesh.show(view, isMetric ? layout.meters(view) : layout.hops(view, mesh.isPortrait, mesh.room), isMetric, changes);
  byId("by-metres").setAttribute("aria-pressed", String(isMetric));
  byId("by-hops").setAttribute("aria-pressed", String(!isMetric));
  const hasSnr = view.links.some((link) => isKnown(link.snr_db)) || view.links.length === 0;
  if (hasSnr !== state.hasSnr) {
    state.hasSnr = hasSnr;
    showLegend(mesh.colors);
  }
  if (isMetric) findLastPlaces(view);
  showStrip(view);
  showAlarms(byId("alarms"), state.alarms, shown_s(), alarmHandlers, state.meta.can_acknowledge);
  count("tab-alarms", alarmsAt(state.alarms, shown_s()).open.filter((alarm) => alarm.level !== "note" && !isQuiet(alarm)));
  count("tab-changes", changes.filter((change) => change.kind === "worse"));
  if (isVisible("robots")) showRobots(byId("robots"), view, state.selected, select);
  if (isVisible("radios")) showRadios(byId("radios"), view, state.selected, select);
  if (isVisible("changes")) showChanges(byId("changes"), changes, state.reference?.time_s ?? null, select, (none) => setReference(none === null ? null : state.frame));
  if (isVisible("details")) {
    showDetails(byId("details"), view, state.selected, { meta: state.meta, source });
    refreshCharts();
  }
  if (isVisible("report")) showReport(byId("report"), state.report, state.meta, mesh.colors, shown_s(), goTo);
  document.documentElement.dataset.shown = String(state.frame.time_s);
  showTimeline();
}

// Where a device without a position was when it was last seen.
const searched = new Set();
function findLastPlaces(view) {
  for (const device of view.shown) {
    if (device.position !== null || layout.lastPlaces.has(device.name) || !isKnown(device.age_s) || searched.has(device.name) || view.time_s - device.age_s < (state.span?.[0] ?? Infinity)) continue;
    searched.add(device.name);
    source.frame(view.time_s - device.age_s).then((frame) => {
      if (layout.learn(viewOf(frame, state.meta), device.name)) render();
    }, () => undefined);
  }
}

const isVisible = (panel) => state.tab === panel || (panel === "robots" && matchMedia("(min-width: 1500px)").matches);

function isMetricView(view) {
  const placed = view.shown.filter((device) => device.position !== null).length;
  byId("by-metres").disabled = placed === 0;
  if (placed === 0) return false;
  return state.arrangement === "meters" || (state.arrangement === "auto" && placed * 2 >= view.shown.length);
}

// ---- timeline, charts

async function showTimeline(isForced = false) {
  if (state.span === null) return;
  const last = Math.max(state.span[1], state.at_s ?? 0);
  const from_s = state.window_s === 0 ? state.span[0] : Math.max(state.span[0], last - state.window_s);
  // a moment before the window moves it
  const start_s = state.at_s !== null && state.at_s < from_s ? Math.max(state.span[0], state.at_s - 60) : from_s;
  timeline.setSpan(start_s, last);
  timeline.setTime(shown_s());
  timeline.reference_s = state.reference?.time_s ?? null;
  if (!isForced && performance.now() - timelineAt < TIMELINE_EVERY_MS) { timeline.draw(); return; }
  timelineAt = performance.now();
  try {
    // wider than the time between frames, or there would be gaps
    const buckets = Math.max(1, Math.min(MAX_BUCKETS, Math.floor((last - start_s) / (1.6 * interval_s()))));
    const found = await source.timeline(start_s, last, buckets);
    const markers = state.alarms.filter((alarm) => alarm.level !== "note").map((alarm) => ({ time_s: alarm.first_s, level: alarm.level })).concat(markersOf(state.report));
    timeline.show(found.buckets, markers, mesh.colors);
  } catch (error) {
    notice(`Cannot load the history: ${error.message}`);
  }
}

async function refreshCharts(isForced = false) {
  const panel = byId("details");
  if (charts === null && panel.charts !== undefined) charts = new Charts(panel.charts, goTo);
  if (charts === null || state.selected === null) { charts?.clear(); return; }
  charts.mark(shown_s());
  if (!isForced && performance.now() - chartsAt < CHARTS_EVERY_MS) return;
  chartsAt = performance.now();
  const device = state.selected;
  const found = await source.series(device, timeline.span.from_s, timeline.span.to_s).catch(() => ({ charts: [] }));
  if (device === state.selected) charts.show(found.charts, mesh.colors);
}

// ---- selection, tabs, reference, alarms

function select(name) {
  state.selected = name;
  mesh.select(name);
  if (name !== null) openTab("details");
  chartsAt = -Infinity;
  render();
}

function openTab(name) {
  if (byId(`tab-${name}`).hidden) return;
  state.tab = name;
  document.documentElement.dataset.tab = name;
  for (const tab of TABS) {
    const isOpen = tab === name;
    byId(tab).hidden = !isOpen;
    byId(`tab-${tab}`).setAttribute("aria-selected", String(isOpen));
    byId(`tab-${tab}`).tabIndex = isOpen ? 0 : -1;
  }
  render();
}

function setReference(frame) {
  state.reference = frame === null ? null : viewOf(frame, state.meta);
  byId("reference").setAttribute("aria-pressed", String(frame !== null));
  byId("reference").title = frame === null ? "Mark this state (R)" : `Reference: ${clockTime(frame.time_s)} (R forgets it)`;
  remember(REFERENCE_KEY, frame === null ? null : JSON.stringify({ fleet: frame.fleet, time_s: frame.time_s }));
  if (frame !== null) openTab("changes"); else render();
  showTimeline(true);
}

const alarmHandlers = {
  jump: (alarm) => { stop(); goTo(alarm.first_s); if (alarm.device !== "") { state.selected = alarm.device.replace(/^robot:/, ""); mesh.select(state.selected); } },
  select: (name) => select(state.view.robots.find((robot) => robot.name === name)?.radio ?? name),
  acknowledge: async (alarm) => {
    try { receiveAlarms(await source.post("api/alarms/ack", { device: alarm.device, code: alarm.code })); } catch (error) { notice(`Cannot acknowledge: ${error.message}`); }
  },
  silence: (alarm) => openSilence(alarm, async (reason, for_s) => receiveAlarms(await source.post("api/alarms/silence", { device: alarm.device, code: alarm.code, reason, for_s }))),
};

function receiveAlarms(alarms) {
  const known = new Set(state.alarms.map((alarm) => `${alarm.device}\u0000${alarm.code}\u0000${alarm.first_s}`));
  const fresh = alarms.filter((alarm) => alarm.ended_s === null && alarm.level !== "note" && !isQuiet(alarm) && !known.has(`${alarm.device}\u0000${alarm.code}\u0000${alarm.first_s}`));
  const isFirst = state.hasAlarms !== true;
  state.hasAlarms = true;
  state.alarms = alarms;
  if (fresh.length > 0 && !isFirst) sound.play(fresh.some((alarm) => alarm.level === "error") ? "error" : "warning");
  render();
}

const KEYS = [
  ["L", "back to live", () => goLive()], ["Space", "play or pause", () => play()], ["← →", "one step in time (Shift: ten)", null],
  ["R", "mark or forget the reference", () => setReference(state.reference === null ? state.frame : null)], ["M", "meters or hops", () => arrange(mesh.isMetric ? "hops" : "meters")],
  ["F", "fit the map", () => mesh.fit()], ["1 – 6", "panels", null], ["N", "next open alarm", () => nextAlarm()], ["S", "sound", () => toggleSound()], ["T", "dark or light", () => toggleTheme()],
  ["arrows on the map", "select a device in that direction", null], ["?", "this list", () => byId("keys").showModal()],
];

function arrange(kind) {
  state.arrangement = kind;
  render();
  mesh.fit();
}

function nextAlarm() {
  openTab("alarms");
  const buttons = [...byId("alarms").querySelectorAll("article:not(.is-acknowledged) button")];
  const at = buttons.indexOf(document.activeElement);
  buttons[(at + 1) % Math.max(1, buttons.length)]?.focus();
}

async function toggleSound() {
  await sound.toggle();
  byId("sound").setAttribute("aria-pressed", String(sound.isOn));
  setText(byId("sound").querySelector("span"), sound.isOn ? "Sound on" : "Sound off");
}

function toggleTheme() {
  const root = document.documentElement;
  root.dataset.theme = root.dataset.theme === "light" ? "dark" : "light";
  remember("meshctl-monitor-theme", JSON.stringify(root.dataset.theme));
  recolor();
}

function recolor() {
  mesh.readColors();
  showLegend(mesh.colors);
  charts?.clear();
  chartsAt = -Infinity;
  render();
  showTimeline(true);
}

function onKey(event) {
  const target = event.target;
  if (event.ctrlKey || event.metaKey || event.altKey || byId("action").open || (target instanceof HTMLInputElement && target.type !== "range") || target instanceof HTMLSelectElement) return;
  if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
    if (target.getAttribute?.("role") === "tab") return;
    stop();
    step((event.key === "ArrowLeft" ? -1 : 1) * (event.shiftKey ? 10 : 1));
  } else if (/^[1-6]$/.test(event.key)) openTab(TABS[Number(event.key) - 1]);
  else if (event.key === "Escape") select(null);
  else {
    if (event.key === " " && target instanceof HTMLButtonElement) return;
    const pressed = event.key === " " ? "Space" : event.key.toUpperCase();
    const found = KEYS.find(([key, , action]) => key === pressed && action !== null);
    if (found === undefined) return;
    found[2]();
  }
  event.preventDefault();
}

function wire() {
  const on = (id, action) => byId(id).addEventListener("click", action);
  on("live", goLive);
  on("play", play);
  on("step-back", () => { stop(); step(-1); });
  on("step-forward", () => { stop(); step(1); });
  on("reference", () => setReference(state.reference === null ? state.frame : null));
  on("sound", toggleSound);
  on("theme", toggleTheme);
  on("help", () => byId("keys").showModal());
  on("by-metres", () => arrange("meters"));
  on("by-hops", () => arrange("hops"));
  on("zoom-in", () => mesh.zoom(1.25));
  on("zoom-out", () => mesh.zoom(0.8));
  on("zoom-fit", () => mesh.fit());
  for (const tab of TABS) on(`tab-${tab}`, () => openTab(tab));
  document.querySelector(".tabs").addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const tabs = TABS.filter((tab) => byId(`tab-${tab}`).offsetParent !== null);
    if (by === undefined) return;
    const next = tabs[(tabs.indexOf(state.tab) + by + tabs.length) % tabs.length];
    openTab(next);
    byId(`tab-${next}`).focus();
    event.preventDefault();
  });
  byId("window").addEventListener("change", () => { state.window_s = Number(byId("window").value); chartsAt = -Infinity; showTimeline(true); render(); });
  document.addEventListener("keydown", onKey);
  byId("keys").replaceChildren(el("h2", {}, "Keys"), el("dl", {}, ...KEYS.flatMap(([key, text]) => [el("dt", {}, key), el("dd", {}, text)])), el("button", { type: "button", onclick: () => byId("keys").close() }, "Close"));
  matchMedia("(min-width: 1500px)").addEventListener("change", (event) => openTab(event.matches && state.tab === "robots" ? "alarms" : state.tab));
  mesh.onResize = () => { if (state.view !== null) requestAnimationFrame(() => render()); };
  setInterval(() => { if (state.meta !== null) showClock(); }, 250);
}

const events = {
  frame(frame) {
    state.live = frame;
    state.span = [state.span?.[0] ?? frame.time_s, frame.time_s];
    if (state.at_s === null) show(frame); else showTimeline();
  },
  alarms: receiveAlarms,
  meters(readings) {
    state.meters = readings;
    if (state.at_s === null && state.live !== null) show(state.live);
  },
  state(link, reason) {
    if (link !== "live") state.meters = {};
    if (link !== "live" && state.lostAt_s === null) state.lostAt_s = now_s();
    if (link === "live") { state.lostAt_s = null; timelineAt = -Infinity; }
    state.link = link;
    if (link === "lost") notice(`No connection to the monitor since ${clockTime(state.lostAt_s)} (${reason}). Trying again.`);
    else if (link === "refused") notice("The monitor refused this page: open the address with the token that it printed.");
    else notice("");
    if (state.meta !== null) showClock();
  },
};

async function loadReport() {
  state.report = await source.report();
  state.tracks = tracksOf(state.report);
  mesh.tracks = state.tracks;
  byId("tab-report").hidden = state.report.length === 0;
  openTab("report");
}

async function start() {
  wire();
  document.documentElement.dataset.theme = recalled("meshctl-monitor-theme") ?? "dark";
  mesh.readColors();
  openTab(matchMedia("(min-width: 1500px)").matches ? "alarms" : "robots");
  for (;;) {
    try {
      state.meta = await source.meta();
      break;
    } catch (error) {
      events.state(error.status === 401 ? "refused" : "lost", error.message);
      await new Promise((resolve) => setTimeout(resolve, 1500));
    }
  }
  notice("");
  state.offset_s = source.isRecorded ? 0 : state.meta.now_s - Date.now() / 1000;
  state.span = state.meta.span;
  setText(byId("fleet"), state.meta.fleet);
  if (state.meta.mode === "replay") {
    state.window_s = 0;
    byId("window").value = "0";
    byId("live").textContent = "END";
  }
  if (state.meta.has_report) await loadReport();
  showLegend(mesh.colors);
  receiveAlarms(await source.alarms());
  const reference = recalled(REFERENCE_KEY);
  if (reference !== null && reference.fleet === state.meta.fleet && state.span !== null && reference.time_s >= state.span[0]) {
    source.frame(reference.time_s).then((frame) => { state.reference = viewOf(frame, state.meta); byId("reference").setAttribute("aria-pressed", "true"); render(); }, () => undefined);
  }
  if (state.meta.mode === "replay") await goTo(state.span[0]);
  else source.listen(events);
}

start().catch((error) => notice(`This page failed: ${error.message}`));
