// Charts over time, by uPlot. A click goes to that time; dragging zooms, a double click shows all.
// {title, unit, note?, kind?: lines | stacked | spans, times_s, series: [{label, values, low?, high?}]}

import { el } from "./dom.js";
import { clockTime, isKnown, MISSING } from "./format.js";

const DASHES = [[], [8, 4], [3, 3], [10, 3, 2, 3]];

export class Charts {
  constructor(parent, onTime) {
    this.parent = parent;
    this.onTime = onTime;
    this.plots = [];
    this.at_s = null;
    new ResizeObserver(() => { for (const plot of this.plots) plot.setSize({ width: this.width, height: plot.height }); }).observe(parent);
  }

  get width() { return Math.max(200, this.parent.clientWidth - 4); }

  // The moment shown by everything else, as a line.
  mark(at_s) {
    if (this.at_s === at_s) return;
    this.at_s = at_s;
    for (const plot of this.plots) plot.redraw(false);
  }

  clear() {
    for (const plot of this.plots) plot.destroy();
    this.plots = [];
    this.parent.replaceChildren();
  }

  show(charts, colors) {
    const signature = JSON.stringify(charts.map((chart) => [chart.title, chart.series.map((one) => [one.label, one.low !== undefined])]));
    const isSame = signature === this.signature && this.plots.length === charts.length;
    this.signature = signature;
    if (isSame) {
      charts.forEach((chart, i) => refill(this.plots[i], dataOf(chart)));
      return;
    }
    this.clear();
    if (charts.length === 0) this.parent.append(el("p", { class: "empty" }, "No measurements in this time span."));
    for (const chart of charts) {
      const holder = el("div", { class: "chart", "data-kind": chart.kind ?? "lines" }, el("h3", {}, titleOf(chart)));
      this.parent.append(holder);
      this.plots.push(new uPlot(this.#options(chart, colors), dataOf(chart), holder));
      if (chart.note) holder.append(el("p", { class: "muted note" }, chart.note));
    }
  }

  #options(chart, colors) {
    const palette = paletteOf(colors);
    const axis = axisOf(colors);
    const isStacked = chart.kind === "stacked";
    const isSpans = chart.kind === "spans";
    const bounds = boundsOf(chart);
    const shown = (value, raw) => (isSpans ? (isKnown(value) ? "online" : MISSING) : isKnown(raw) ? shortNumber(raw) : MISSING);
    return {
      width: this.width, height: isSpans ? 70 + 20 * chart.series.length : 150, cursor: { sync: { key: "time" }, drag: { x: true, y: false } },
      scales: { x: { time: true }, y: { range: (plot, low, high) => (isSpans ? [0.4, chart.series.length + 0.6] : isKnown(low) && isKnown(high) ? rangeOf(low, high, chart.unit) : [0, 1]) } },
      axes: [
        { ...axis, size: 28, values: (plot, times, place, space, step) => times.map((time) => (step < 60 ? clockTime(time) : clockTime(time).slice(0, 5))) },
        isSpans ? { ...axis, size: 96, splits: () => chart.series.map((_, i) => i + 1), values: (plot, rows) => rows.map((row) => shortened(chart.series[row - 1]?.label ?? "", 12)) } : { ...axis, size: 52 },
      ],
      series: [
        { label: "Time", value: (plot, time) => (isKnown(time) ? clockTime(time) : MISSING) },
        ...chart.series.map((one, i) => ({
          label: one.label, stroke: palette[i % palette.length], width: isSpans ? 10 : 2, dash: isSpans ? [] : DASHES[Math.floor(i / palette.length) % DASHES.length],
          fill: isStacked ? palette[i % palette.length] : undefined,
          spanGaps: false, points: { show: !isSpans && chart.times_s.length < 30 }, value: (plot, value, row, at) => shown(value, one.values[at]),
        })),
        ...bounds.map(() => ({ class: "is-bound", stroke: "#0000", width: 0, spanGaps: false, points: { show: false } })),
      ],
      bands: bounds.filter((bound) => bound.isHigh).map((bound) => ({ series: [bound.at, bound.at + 1], fill: `${palette[bound.of % palette.length]}40` })),
      hooks: {
        draw: [(plot) => this.#drawMark(plot, colors["--accent"])],
        setSeries: [(plot, row, options) => {
          if (!isKnown(options.show)) return;
          for (const bound of bounds) if (bound.of === row - 1) plot.setSeries(bound.at, { show: options.show });
        }],
        ready: [(plot) => plot.over.addEventListener("click", () => {
          if (plot.cursor.left >= 0 && plot.select.width === 0) this.onTime(plot.posToVal(plot.cursor.left, "x"));
        })],
      },
    };
  }

  #drawMark(plot, color) {
    if (this.at_s === null) return;
    const x = plot.valToPos(this.at_s, "x", true);
    if (x < plot.bbox.left || x > plot.bbox.left + plot.bbox.width) return;
    plot.ctx.save();
    plot.ctx.strokeStyle = color;
    plot.ctx.lineWidth = 2;
    plot.ctx.beginPath();
    plot.ctx.moveTo(x, plot.bbox.top);
    plot.ctx.lineTo(x, plot.bbox.top + plot.bbox.height);
    plot.ctx.stroke();
    plot.ctx.restore();
  }
}

export const paletteOf = (colors) => [colors["--accent"], colors["--fair"], colors["--good"], colors["--cut"], colors["--poor"], colors["--text"]];
export const axisOf = (colors) => ({ stroke: colors["--muted"], grid: { stroke: colors["--grid"], width: 1 }, ticks: { stroke: colors["--line"], width: 1 }, font: "13px system-ui, sans-serif" });
const titleOf = (chart) => `${chart.title}${chart.unit === "" ? "" : ` (${chart.unit})`}`;
const shortened = (text, length) => (text.length > length ? `${text.slice(0, length - 1)}…` : text);

// The series of least and greatest values, behind the lines: the greatest, then the least of each line that has them.
function boundsOf(chart) {
  const found = [];
  chart.series.forEach((one, i) => {
    if (one.low === undefined) return;
    found.push({ of: i, isHigh: true, at: chart.series.length + found.length + 1, values: one.high });
    found.push({ of: i, isHigh: false, at: chart.series.length + found.length + 1, values: one.low });
  });
  return found;
}

function dataOf(chart) {
  if (chart.kind !== "stacked") return [chart.times_s, ...chart.series.map((one) => one.values), ...boundsOf(chart).map((bound) => bound.values)];
  // the whole first, so that each smaller sum is painted over it
  const sumFrom = (first) => chart.times_s.map((_, at) => chart.series.slice(first).reduce((sum, one) => sum + (one.values[at] ?? 0), 0));
  return [chart.times_s, ...chart.series.map((_, i) => sumFrom(i))];
}

// New data leave a zoom as it is.
function refill(plot, data) {
  const [first, last] = [plot.data[0][0], plot.data[0].at(-1)];
  const isZoomed = plot.scales.x.min > first || plot.scales.x.max < last;
  plot.setData(data, !isZoomed);
  if (isZoomed) plot.redraw();
}

// When each peer was online, as a chart with one row for each.
export function spansChart(spans) {
  const edges = new Set();
  for (const row of spans.rows) for (const [from, to] of row.spans_s) for (const edge of [from, to, to + 0.001]) edges.add(edge);
  const times_s = [...edges].sort((x, y) => x - y);
  const series = [...spans.rows].reverse().map((row, i) => {
    let at = 0;
    return { label: row.label, values: times_s.map((time) => {
      while (at < row.spans_s.length && row.spans_s[at][1] < time) at += 1;
      return at < row.spans_s.length && row.spans_s[at][0] <= time ? i + 1 : null;
    }) };
  });
  return { title: spans.title, unit: "", note: spans.note, kind: "spans", times_s, series };
}

function rangeOf(low, high, unit) {
  if (unit === "dB" || unit === "dBm") return [Math.floor(low - 3), Math.ceil(high + 3)];
  return [Math.min(0, low), high <= 0 ? 1 : high * 1.1];
}
