// The time slider of the whole page: verdict and alarms over time, and the moment that is shown.

import { byId } from "./dom.js";
import { clockTime } from "./format.js";

// Half of the slider's thumb: its center never reaches the edges.
const INSET = 8;
const LEGEND_ROWS = 18;

export class Timeline {
  constructor(onTime) {
    this.canvas = byId("history");
    this.slider = byId("slider");
    this.onTime = onTime;
    this.buckets = [];
    this.span = null;
    this.markers = [];
    this.reference_s = null;
    this.slider.addEventListener("input", () => this.onTime(Number(this.slider.value)));
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  setSpan(from_s, to_s) {
    this.span = { from_s, to_s: Math.max(to_s, from_s + 1) };
    this.slider.min = String(this.span.from_s);
    this.slider.max = String(this.span.to_s);
  }

  setTime(at_s) {
    this.slider.value = String(at_s);
    this.slider.setAttribute("aria-valuetext", clockTime(at_s));
  }

  show(buckets, markers, colors) {
    this.buckets = buckets;
    this.markers = markers;
    this.colors = colors;
    this.draw();
  }

  draw() {
    if (this.span === null || this.colors === undefined) return;
    const box = this.canvas.getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
    const c = this.canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    const width = box.width - 2 * INSET;
    const xOf = (time_s) => INSET + ((time_s - this.span.from_s) / (this.span.to_s - this.span.from_s)) * width;
    const [top, height] = [2, box.height - LEGEND_ROWS - 4];
    c.fillStyle = this.colors["--grid"];
    c.fillRect(INSET, top, width, height);
    for (const bucket of this.buckets) {
      if (bucket.frames === 0) continue;
      const [left, right] = [Math.max(INSET, xOf(bucket.start_s)), Math.min(INSET + width, xOf(bucket.end_s))];
      if (right <= left) continue;
      // go: a low band; no-go: a tall one, so that height says it without color
      c.fillStyle = bucket.go === null ? this.colors["--stale"] : bucket.go ? this.colors["--good"] : this.colors["--poor"];
      const band = bucket.go === false ? height * 0.55 : height * 0.22;
      c.fillRect(left, top + height - band, right - left + 0.5, band);
      const alarms = Math.min(8, bucket.errors * 2 + bucket.warnings);
      if (alarms > 0) {
        c.fillStyle = this.colors["--fair"];
        c.fillRect(left, top, right - left + 0.5, 2 + alarms);
      }
    }
    for (const marker of this.markers) {
      const x = xOf(marker.time_s);
      if (x < INSET || x > INSET + width) continue;
      c.fillStyle = marker.level === "error" ? this.colors["--poor"] : this.colors["--fair"];
      c.beginPath(); c.moveTo(x - 4, top); c.lineTo(x + 4, top); c.lineTo(x, top + 9); c.fill();
    }
    if (this.reference_s !== null) {
      const x = xOf(this.reference_s);
      c.fillStyle = this.colors["--cut"];
      c.fillRect(x - 1, top, 2, height);
      c.beginPath(); c.moveTo(x, top); c.lineTo(x + 9, top + 4); c.lineTo(x, top + 8); c.fill();
    }
    this.#scale(c, xOf, box, width);
  }

  #scale(c, xOf, box, width) {
    const span_s = this.span.to_s - this.span.from_s;
    const step = [10, 30, 60, 300, 600, 900, 1800, 3600, 7200, 21600, 43200, 86400].find((seconds) => (seconds / span_s) * width >= 84) ?? 86400;
    c.fillStyle = this.colors["--muted"];
    c.font = '13px system-ui, "Noto Sans", "DejaVu Sans", sans-serif';
    c.textBaseline = "bottom";
    c.textAlign = "center";
    const shift_s = new Date(this.span.from_s * 1000).getTimezoneOffset() * 60;
    const first = Math.ceil((this.span.from_s - shift_s) / step) * step + shift_s;
    for (let time_s = first; time_s <= this.span.to_s; time_s += step) {
      const x = xOf(time_s);
      if (x < 30 || x > box.width - 30) continue;
      c.fillText(step < 60 ? clockTime(time_s) : clockTime(time_s).slice(0, 5), x, box.height);
    }
  }
}
