// Charts of one device over time, by uPlot. A click goes to that time; dragging zooms, a double click shows all.

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
    const signature = JSON.stringify(charts.map((chart) => [chart.title, chart.series.map((one) => one.label)]));
    const isSame = signature === this.signature && this.plots.length === charts.length;
    this.signature = signature;
    if (isSame) {
      charts.forEach((chart, i) => this.plots[i].setData(dataOf(chart)));
      return;
    }
    this.clear();
    if (charts.length === 0) this.parent.append(el("p", { class: "empty" }, "No measurements in this time span."));
    for (const chart of charts) {
      const holder = el("div", { class: "chart" }, el("h3", {}, `${chart.title}${chart.unit === "" ? "" : ` (${chart.unit})`}`));
      this.parent.append(holder);
      this.plots.push(new uPlot(this.#options(chart, colors), dataOf(chart), holder));
    }
  }

  #options(chart, colors) {
    const palette = [colors["--accent"], colors["--fair"], colors["--good"], colors["--cut"], colors["--poor"], colors["--text"]];
    const axis = { stroke: colors["--muted"], grid: { stroke: colors["--grid"], width: 1 }, ticks: { stroke: colors["--line"], width: 1 }, font: "12px system-ui, sans-serif" };
    return {
      width: this.width, height: 150, cursor: { sync: { key: "time" }, drag: { x: true, y: false } },
      scales: { x: { time: true }, y: { range: (plot, low, high) => (isKnown(low) && isKnown(high) ? rangeOf(low, high, chart.unit) : [0, 1]) } },
      axes: [
        { ...axis, size: 28, values: (plot, times) => times.map((time) => clockTime(time).slice(0, 5)) },
        { ...axis, size: 46 },
      ],
      series: [
        { label: "Time", value: (plot, time) => (isKnown(time) ? clockTime(time) : MISSING) },
        ...chart.series.map((one, i) => ({
          label: one.label, stroke: palette[i % palette.length], width: 2, dash: DASHES[Math.floor(i / palette.length) % DASHES.length],
          spanGaps: false, points: { show: chart.times_s.length < 30 }, value: (plot, value) => (isKnown(value) ? `${Math.round(value * 10) / 10}` : MISSING),
        })),
      ],
      hooks: {
        draw: [(plot) => this.#drawMark(plot, colors["--accent"])],
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

const dataOf = (chart) => [chart.times_s, ...chart.series.map((one) => one.values)];

function rangeOf(low, high, unit) {
  if (unit === "dB" || unit === "dBm") return [Math.floor(low - 3), Math.ceil(high + 3)];
  return [Math.min(0, low), high <= 0 ? 1 : high * 1.1];
}
