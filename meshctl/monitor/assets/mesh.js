// The mesh on a canvas: links by class, paths, shapes by role, labels; pan, zoom, selection.

import { isKnown } from "./format.js";
import { drawLabels } from "./labels.js";
import { pathOf } from "./model.js";
import { drawArrow, drawText, HOLLOW, LINK, shape } from "./signs.js";
import { drawTracks } from "./tracks.js";
import { summaryOf, tipOf } from "./words.js";

const MAX_RADIUS = 11;
const MIN_RADIUS = 5;
// Room for labels, and the buttons above.
const MARGIN = { x: 90, top: 100 };
const HIT_PX = 22;
const MOVE_MS = 350;

export class MeshCanvas {
  constructor(canvas, tip, onSelect) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.tip = tip;
    this.onSelect = onSelect;
    this.view = null;
    this.points = new Map();
    this.drawn = new Map();
    this.camera = null;
    this.isFitted = true;
    this.selected = null;
    this.difference = null;
    this.pointers = new Map();
    this.isMetric = false;
    // of a recording: [{name, points: [[time_s, x_m, y_m, is_online]]}]
    this.tracks = [];
    this.pending = 0;
    this.frames = 0;
    this.readColors();
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(event.deltaY < 0 ? 1.15 : 1 / 1.15, event.offsetX, event.offsetY); }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => this.#up(event, end === "pointerup"));
    canvas.addEventListener("pointerleave", () => { this.tip.hidden = true; });
    canvas.addEventListener("keydown", (event) => this.#key(event));
  }

  readColors() {
    const style = getComputedStyle(document.documentElement);
    this.colors = {};
    for (const name of ["--bg", "--text", "--muted", "--good", "--fair", "--poor", "--accent", "--cut", "--stale", "--grid", "--path", "--panel", "--line"]) this.colors[name] = style.getPropertyValue(name).trim();
    this.request();
  }

  get room() { return { x: Math.max(50, this.width - 2 * MARGIN.x), y: Math.max(50, this.height - MARGIN.top - this.bottom) }; }

  // Room for labels and the legend.
  get bottom() { return (this.canvas.parentElement.querySelector(".legend")?.offsetHeight ?? 0) + 44; }

  get isPortrait() { return this.height > this.width * 1.1; }

  resize() {
    const box = this.canvas.getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    this.width = box.width;
    this.height = box.height;
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
    this.ratio = ratio;
    this.onResize?.();
    if (this.isFitted) this.fit();
    this.request();
  }

  show(view, points, isMetric, difference) {
    const wasMetric = this.isMetric;
    this.view = view;
    this.isMetric = isMetric;
    this.difference = difference;
    const isStill = this.drawn.size === 0 || wasMetric !== isMetric || matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.from = isStill ? new Map() : new Map([...this.drawn].map(([name, at]) => [name, { ...at }]));
    this.points = points;
    this.movedAt = performance.now();
    if (this.isFitted || wasMetric !== isMetric) this.fit();
    this.canvas.setAttribute("aria-label", summaryOf(view));
    this.request();
  }

  select(name) {
    this.selected = name;
    this.request();
  }

  request() {
    if (this.pending === 0) this.pending = requestAnimationFrame((now) => { this.pending = 0; this.draw(now); });
  }

  fit() {
    this.isFitted = true;
    if (this.points.size === 0 || !this.width) return;
    const ways = this.isMetric ? this.tracks.flatMap((track) => track.points) : [];
    const xs = [...this.points.values()].map((point) => point.x).concat(ways.map((at) => at[1]));
    const ys = [...this.points.values()].map((point) => point.y).concat(ways.map((at) => -at[2]));
    const [left, right, top, bottom] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const room = this.room;
    const most = this.isMetric ? 40 : 1.25;
    const scale = Math.min(most, room.x / Math.max(1, right - left), room.y / Math.max(1, bottom - top));
    this.camera = { scale, x: this.width / 2 - ((left + right) / 2) * scale, y: MARGIN.top + room.y / 2 - ((top + bottom) / 2) * scale };
    this.request();
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) {
    if (this.camera === null) return;
    this.isFitted = false;
    const scale = Math.min(200, Math.max(0.02, this.camera.scale * factor));
    const by = scale / this.camera.scale;
    this.camera = { scale, x: x - (x - this.camera.x) * by, y: y - (y - this.camera.y) * by };
    this.request();
  }

  // The device drawn nearest to a place on the canvas, if one is near enough.
  at(x, y) {
    let best = null;
    let distance = HIT_PX;
    for (const [name, point] of this.drawn) {
      const away = Math.hypot(point.x * this.camera.scale + this.camera.x - x, point.y * this.camera.scale + this.camera.y - y);
      if (away < distance) { best = name; distance = away; }
    }
    return best;
  }

  #down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
    this.travel = 0;
  }

  #move(event) {
    const last = this.pointers.get(event.pointerId);
    if (last === undefined) { this.#hover(event); return; }
    const now = { x: event.offsetX, y: event.offsetY };
    if (this.camera !== null && this.pointers.size === 1) {
      this.camera = { ...this.camera, x: this.camera.x + now.x - last.x, y: this.camera.y + now.y - last.y };
      this.travel += Math.hypot(now.x - last.x, now.y - last.y);
      if (this.travel > 4) this.isFitted = false;
    } else if (this.pointers.size === 2) {
      const [other] = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, point]) => point);
      const before = Math.hypot(last.x - other.x, last.y - other.y);
      const after = Math.hypot(now.x - other.x, now.y - other.y);
      this.travel += 5;
      if (before > 0) this.zoom(after / before, (now.x + other.x) / 2, (now.y + other.y) / 2);
    }
    this.pointers.set(event.pointerId, now);
    this.request();
  }

  #up(event, isClick) {
    this.pointers.delete(event.pointerId);
    if (isClick && this.travel < 5 && this.camera !== null) this.onSelect(this.at(event.offsetX, event.offsetY));
  }

  #hover(event) {
    if (this.camera === null || this.view === null) return;
    const name = this.at(event.offsetX, event.offsetY);
    this.canvas.style.cursor = name === null ? "grab" : "pointer";
    this.tip.hidden = name === null;
    if (name === null) return;
    this.tip.textContent = tipOf(this.view, name);
    const left = Math.min(event.offsetX + 18, this.width - 270);
    this.tip.style.left = `${Math.max(0, left)}px`;
    this.tip.style.top = `${Math.min(event.offsetY + 18, this.height - 130)}px`;
  }

  #key(event) {
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (event.key === "+" || event.key === "=") this.zoom(1.25);
    else if (event.key === "-") this.zoom(0.8);
    else if (event.key === "0") this.fit();
    else if (event.key in ways && this.drawn.size > 0) {
      const from = this.drawn.get(this.selected) ?? this.drawn.values().next().value;
      const [dx, dy] = ways[event.key];
      let best = this.selected === null ? this.drawn.keys().next().value : null;
      let least = Infinity;
      for (const [name, point] of this.drawn) {
        const along = (point.x - from.x) * dx + (point.y - from.y) * dy;
        const across = Math.abs((point.x - from.x) * dy) + Math.abs((point.y - from.y) * dx);
        if (this.selected !== null && name !== this.selected && along > 0 && along + 2 * across < least) { least = along + 2 * across; best = name; }
      }
      if (best !== null) this.onSelect(best);
    } else return;
    event.preventDefault();
    event.stopPropagation();
  }

  draw(now) {
    this.frames += 1;
    const { context: c, colors } = this;
    c.setTransform(this.ratio ?? 1, 0, 0, this.ratio ?? 1, 0, 0);
    c.fillStyle = colors["--bg"];
    c.fillRect(0, 0, this.width, this.height);
    if (this.view === null || this.points.size === 0) {
      drawText(c, "No device reported yet", this.width / 2, this.height / 2, { size: 20, color: colors["--muted"], align: "center" });
      return;
    }
    if (this.camera === null) this.fit();
    if (this.camera === null) return;
    const share = Math.min(1, (now - (this.movedAt ?? 0)) / MOVE_MS);
    const eased = 1 - (1 - share) ** 3;
    this.drawn = new Map();
    for (const [name, to] of this.points) {
      const from = this.from?.get(name) ?? to;
      this.drawn.set(name, { x: from.x + (to.x - from.x) * eased, y: from.y + (to.y - from.y) * eased, isGuess: to.isGuess });
    }
    this.radius = this.#radius();
    if (this.isMetric) { this.#grid(); drawTracks(c, colors, this.camera, this.tracks, this.view.time_s); } else this.#columns();
    const path = this.selected === null ? [] : pathOf(this.view, this.selected);
    const onPath = new Set(path);
    this.#paths(onPath);
    for (const kind of ["stale", "unknown", "good", "fair", "poor"]) {
      for (const link of this.view.links) if (link.class === kind) this.#link(link);
    }
    this.#changes();
    for (const device of this.view.shown) this.#device(device);
    drawLabels(c, colors, { view: this.view, selected: this.selected, radius: this.radius, isMetric: this.isMetric, scale: this.camera.scale, screen: (name) => this.#screen(name) });
    if (share < 1) this.request();
  }

  // Smaller signs where devices are close to each other.
  #radius() {
    const key = `${this.camera.scale} ${this.points.size} ${this.movedAt}`;
    if (this.radiusKey !== key) {
      const points = [...this.points.values()];
      const nearest = points.map((p) => Math.min(...points.map((q) => (p === q ? Infinity : Math.hypot(p.x - q.x, p.y - q.y))))).sort((x, y) => x - y);
      const typical = points.length < 2 ? Infinity : nearest[Math.floor(nearest.length / 3)] * this.camera.scale;
      this.radiusKey = key;
      this.radiusValue = Math.min(MAX_RADIUS, Math.max(MIN_RADIUS, 0.36 * typical));
    }
    return this.radiusValue;
  }

  #screen(name) {
    const point = this.drawn.get(name);
    return point === undefined ? null : { x: point.x * this.camera.scale + this.camera.x, y: point.y * this.camera.scale + this.camera.y };
  }

  #grid() {
    const { context: c, colors } = this;
    const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 5000].find((meters) => meters * this.camera.scale >= 70) ?? 10000;
    const px = step * this.camera.scale;
    c.strokeStyle = colors["--grid"];
    c.lineWidth = 1;
    c.beginPath();
    for (let x = this.camera.x % px; x < this.width; x += px) { c.moveTo(x, 0); c.lineTo(x, this.height); }
    for (let y = this.camera.y % px; y < this.height; y += px) { c.moveTo(0, y); c.lineTo(this.width, y); }
    c.stroke();
    const right = this.width - 24;
    c.strokeStyle = colors["--muted"];
    c.lineWidth = 2;
    c.beginPath();
    c.moveTo(right - px, 26); c.lineTo(right - px, 34); c.lineTo(right, 34); c.lineTo(right, 26);
    c.stroke();
    drawText(c, `${step} m`, right - px / 2, 20, { size: 14, color: colors["--muted"], align: "center" });
  }

  #columns() {
    const { context: c, colors } = this;
    const places = new Map();
    for (const device of this.view.shown) {
      const at = this.#screen(device.name);
      const hop = isKnown(device.hops) ? device.hops : "none";
      const along = this.isPortrait ? at.y : at.x;
      const list = places.get(hop) ?? [];
      list.push(along);
      places.set(hop, list);
    }
    let last = -Infinity;
    for (const [hop, list] of [...places].sort((x, y) => mean(x[1]) - mean(y[1]))) {
      const along = mean(list);
      const label = hop === "none" ? "no path" : hop === 0 ? "base" : hop === 1 ? "1 hop" : `${hop} hops`;
      if (this.isPortrait) {
        if (along - last < 22) continue;
        drawText(c, label, this.width - 12, along, { size: 14, color: colors["--muted"], align: "right" });
      } else {
        if (along - last < 62) continue;
        drawText(c, label, along, 76, { size: 14, color: colors["--muted"], align: "center" });
      }
      last = along;
    }
  }

  // Paths to the base as a light band below the links; the selected device's path is solid.
  #paths(onPath) {
    const { context: c, colors } = this;
    for (const [keys, alpha, width] of [[this.view.tree, 0.2, 11], [onPath, 0.95, 11]]) {
      c.globalAlpha = alpha;
      c.strokeStyle = colors["--path"];
      c.lineWidth = width;
      c.lineCap = "round";
      c.beginPath();
      for (const key of keys) {
        const [a, b] = key.split("\u0000").map((name) => this.#screen(name));
        if (a === null || b === null) continue;
        c.moveTo(a.x, a.y); c.lineTo(b.x, b.y);
      }
      c.stroke();
    }
    c.globalAlpha = 1;
  }

  #link(link) {
    const { context: c, colors } = this;
    const a = this.#screen(link.a);
    const b = this.#screen(link.b);
    if (a === null || b === null) return;
    const isTree = this.view.tree.has(link.key);
    const style = LINK[link.class];
    const crowded = this.view.links.length > 250;
    const isNear = link.a === this.selected || link.b === this.selected;
    c.globalAlpha = isTree || isNear || link.isOneWay ? 1 : crowded ? 0.25 : 0.45;
    c.strokeStyle = colors[style.color];
    c.lineWidth = isTree ? style.width + 1 : crowded ? 1.5 : isNear ? style.width : style.width / 1.6;
    c.lineCap = "butt";
    c.setLineDash(link.isOneWay ? [9, 7] : link.class === "stale" ? [2, 5] : []);
    c.beginPath();
    c.moveTo(a.x, a.y); c.lineTo(b.x, b.y);
    c.stroke();
    if (style.isHollow && c.lineWidth >= 3) {
      c.globalAlpha = 1;
      c.strokeStyle = colors["--bg"];
      c.lineWidth *= HOLLOW;
      c.stroke();
    }
    c.setLineDash([]);
    if (link.isOneWay) drawArrow(c, link.forward !== null ? a : b, link.forward !== null ? b : a, colors[style.color]);
    c.globalAlpha = 1;
    link.isLabeled = isNear || (!crowded && (isTree || link.isOneWay || link.class === "stale"));
  }

  #changes() {
    const { context: c, colors } = this;
    for (const change of this.difference ?? []) {
      const link = change.lost ?? (change.isNew ? this.view.byKey.get(change.key) : null);
      if (!link) continue;
      const a = this.#screen(link.a);
      const b = this.#screen(link.b);
      if (a === null || b === null) continue;
      if (change.lost) {
        c.strokeStyle = colors["--cut"];
        c.lineWidth = 2;
        c.setLineDash([3, 6]);
        c.beginPath(); c.moveTo(a.x, a.y); c.lineTo(b.x, b.y); c.stroke();
        c.setLineDash([]);
      }
      drawText(c, change.lost ? "✕" : "+", (a.x + b.x) / 2, (a.y + b.y) / 2, { size: 18, color: colors["--cut"], align: "center", isBold: true, halo: colors["--bg"] });
    }
  }

  #device(device) {
    const { context: c, colors } = this;
    const at = this.#screen(device.name);
    if (at === null) return;
    const isSmall = this.radius < 9;
    const radius = device.role === "base" ? this.radius + 3 : device.role === "robot" ? this.radius + 1 : this.radius;
    const answers = device.health === "ok" || device.health === "degraded";
    if (device.isCut) {
      c.strokeStyle = colors["--cut"];
      c.lineWidth = 3;
      c.beginPath(); c.arc(at.x, at.y, radius + 7, 0, 2 * Math.PI); c.stroke();
    }
    if (device.name === this.selected) {
      c.strokeStyle = colors["--accent"];
      c.lineWidth = 4;
      c.beginPath(); c.arc(at.x, at.y, radius + 12, 0, 2 * Math.PI); c.stroke();
    }
    shape(c, device.role, at.x, at.y, radius);
    c.fillStyle = device.health === "degraded" ? colors["--fair"] : answers ? colors["--text"] : colors["--bg"];
    c.fill();
    c.lineWidth = 3;
    c.strokeStyle = device.health === "unreachable" ? colors["--poor"] : device.health === "degraded" ? colors["--fair"] : answers ? colors["--text"] : colors["--stale"];
    if (this.drawn.get(device.name).isGuess) c.setLineDash([3, 3]);
    c.stroke();
    c.setLineDash([]);
    if (device.health === "unreachable") drawText(c, "✕", at.x, at.y + 0.5, { size: isSmall ? 11 : 15, color: colors["--poor"], align: "center", isBold: true });
    else if (device.health === "degraded") drawText(c, "!", at.x, at.y + 0.5, { size: isSmall ? 10 : 15, color: "#160800", align: "center", isBold: true });
  }
}

const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
