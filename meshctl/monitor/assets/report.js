// The report of recordings: what each node recorded as tables, charts and events, and the ways of the robots.

import { axisOf, Charts, paletteOf, spansChart } from "./charts.js";
import { el } from "./dom.js";
import { clockTime, isKnown, shortNumber } from "./format.js";

const HISTOGRAM_HEIGHT = 150;
// As in transport_recording.py: recordings alone do not say which node is the base.
const BASE_NAMES = ["base", "base-station", "basestation"];

// `meta` says how many moments the file holds; `onTime` goes to one.
export function showReport(panel, documents, meta, colors, at_s, onTime) {
  if (panel.of !== documents) {
    panel.of = documents;
    panel.chosen = 0;
    panel.drawn = null;
  }
  const key = `${panel.chosen} ${colors["--bg"]}`;
  if (panel.drawn !== key) {
    panel.drawn = key;
    build(panel, documents, meta, colors, onTime);
  }
  panel.charts.mark(at_s);
}

function build(panel, documents, meta, colors, onTime) {
  panel.charts?.clear();
  for (const plot of panel.histograms ?? []) plot.destroy();
  const shown = documents[panel.chosen];
  const charts = el("div", {});
  const histograms = el("div", {});
  const choice = el("select", { "aria-label": "Recording" }, ...documents.map((one, i) => el("option", { value: String(i), selected: i === panel.chosen }, `recorded by ${nameOf(one)}`)));
  choice.addEventListener("change", () => {
    panel.chosen = Number(choice.value);
    panel.drawn = null;
    showReport(panel, documents, meta, colors, panel.charts.at_s, onTime);
    panel.querySelector("select").focus();
  });
  panel.replaceChildren(
    el("div", { class: "details-head" }, documents.length > 1 ? choice : el("h2", {}, `Recorded by ${nameOf(shown)}`)),
    ...shown.notes.map((note) => el("p", {}, note)),
    el("p", { class: "muted note" }, momentsOf(meta)),
    ...shown.tables.slice(0, 2).flatMap(tableOf),
    charts, histograms,
    ...shown.tables.slice(2).flatMap(tableOf),
    ...eventsOf(shown, onTime),
  );
  panel.charts = new Charts(charts, onTime);
  const spans = shown.spans.rows.length > 0 ? [spansChart(shown.spans)] : [];
  panel.charts.show([...shown.charts.slice(0, 2), ...spans, ...shown.charts.slice(2)], colors);
  panel.histograms = shown.histograms.map((one) => histogramOf(histograms, one, colors));
}

const nameOf = (one) => (one.node === "" ? "an unnamed node" : one.node);

// Charts and tables are of every line; the map has fewer moments.
function momentsOf(meta) {
  const thinned = isKnown(meta.frames) && meta.frames < meta.recorded_frames ? `${meta.frames} of ${meta.recorded_frames} moments are in this file. ` : "";
  return `${thinned}Map and robots show about one moment per ${Math.max(1, Math.round(meta.interval_s))} s; tables and charts count every line of the recording.`;
}

function tableOf(table) {
  const kind = (i) => (table.columns[i].is_number ? "number" : "name");
  return [
    el("h2", { class: "over" }, table.title),
    el("table", { class: "is-still" },
      el("thead", {}, el("tr", {}, ...table.columns.map((column) => el("th", { scope: "col", class: column.is_number ? "number" : null }, column.label)))),
      el("tbody", {}, ...table.rows.map((row) => el("tr", {}, ...row.map((text, i) => el("td", { class: kind(i), title: table.columns[i].is_number ? null : text }, text)))))),
    ...(table.note === "" ? [] : [el("p", { class: "muted note" }, table.note)]),
  ];
}

function eventsOf(shown, onTime) {
  if (shown.events.length === 0) return [];
  return [
    el("h2", { class: "over" }, "Events in order"),
    el("ul", {}, ...shown.events.map((event) => el("li", { class: "alarm-line" },
      el("button", { type: "button", class: "when", title: "Go to this moment", onclick: () => onTime(event.time_s) }, clockTime(event.time_s)),
      el("strong", {}, event.kind), el("span", { class: "muted" }, event.at === shown.node ? event.text : `${event.at}: ${event.text}`)))),
  ];
}

// Bars of a density, with a normal curve for comparison.
function histogramOf(parent, one, colors) {
  const width = (one.high - one.low) / one.bars.length;
  const middles = one.bars.map((_, i) => one.low + (i + 0.5) * width);
  const curve = middles.map((value) => Math.exp(-(((value - one.mean) / one.deviation) ** 2) / 2) / (one.deviation * Math.sqrt(2 * Math.PI)));
  const palette = paletteOf(colors);
  const axis = axisOf(colors);
  const holder = el("div", { class: "chart" }, el("h3", {}, `${one.title} (${one.unit})`));
  parent.append(holder);
  const plot = new uPlot({
    width: Math.max(200, parent.clientWidth - 4), height: HISTOGRAM_HEIGHT, cursor: { drag: { x: true, y: false } },
    scales: { x: { time: false }, y: { range: (_, low, high) => [0, (isKnown(high) ? high : 1) * 1.05] } },
    axes: [{ ...axis, size: 28 }, { ...axis, size: 52 }],
    series: [
      { label: one.unit, value: (_, value) => (isKnown(value) ? shortNumber(value) : "–") },
      { label: "density", value: (_, value) => (isKnown(value) ? shortNumber(value) : "–"), stroke: palette[0], fill: palette[0], paths: uPlot.paths.bars({ size: [1] }), points: { show: false } },
      { label: "for comparison", value: (_, value) => (isKnown(value) ? shortNumber(value) : "–"), stroke: palette[4], width: 2, points: { show: false } },
    ],
  }, [middles, one.bars, curve], holder);
  holder.append(el("p", { class: "muted note" }, one.note));
  new ResizeObserver(() => plot.setSize({ width: Math.max(200, parent.clientWidth - 4), height: HISTOGRAM_HEIGHT })).observe(parent);
  return plot;
}

// The way of each robot as the base recorded it, else as the robot did, else any: [{name, points}].
export function tracksOf(documents) {
  const base = documents.find((one) => BASE_NAMES.includes(one.node))?.node;
  const found = new Map();
  const rank = (one, name) => (one.node === base ? 0 : one.node === name ? 1 : 2);
  for (const one of documents) {
    for (const track of one.tracks) {
      const known = found.get(track.name);
      if (known === undefined || rank(one, track.name) < known.rank) found.set(track.name, { ...track, rank: rank(one, track.name) });
    }
  }
  return [...found.values()];
}

// Moments to mark in the timeline: events that are not good news.
export const markersOf = (documents) => documents.flatMap((one) => one.events).filter((event) => event.kind !== "peer-online").map((event) => ({ time_s: event.time_s, level: "warning" }));
