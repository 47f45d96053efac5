// The mesh on a canvas: links by class, paths, shapes by role, labels that do not overlap; pan, zoom, selection.

import { clockTime, duration, isKnown, percent, withUnit } from "./format.js";
import { pathOf } from "./model.js";

const LINK = { good: { width: 4, color: "--good" }, fair: { width: 3, color: "--fair" }, poor: { width: 2.5, color: "--poor" }, stale: { width: 2, color: "--stale" }, unknown: { width: 2, color: "--muted" } };
const MAX_RADIUS = 11;
const MIN_RADIUS = 5;
// Names of ordinary beacons in a large fleet appear from this zoom on.
const CROWDED = 80;
// Room for labels, the buttons above and the legend below.
const MARGIN = { x: 90, top: 100, bottom: 84 };
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

  get room() { return { x: Math.max(50, this.width - 2 * MARGIN.x), y: Math.max(50, this.height - MARGIN.top - MARGIN.bottom) }; }

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
    const xs = [...this.points.values()].map((point) => point.x);
    const ys = [...this.points.values()].map((point) => point.y);
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
      this.#text("No device reported yet", this.width / 2, this.height / 2, { size: 20, color: colors["--muted"], align: "center" });
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
    if (this.isMetric) this.#grid(); else this.#columns();
    const path = this.selected === null ? [] : pathOf(this.view, this.selected);
    const onPath = new Set(path);
    this.#paths(onPath);
    for (const kind of ["stale", "unknown", "good", "fair", "poor"]) {
      for (const link of this.view.links) if (link.class === kind) this.#link(link);
    }
    this.#changes();
    for (const device of this.view.shown) this.#device(device);
    this.#labels();
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
    this.#text(`${step} m`, right - px / 2, 20, { size: 14, color: colors["--muted"], align: "center" });
  }

  #columns() {
    const { colors } = this;
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
        this.#text(label, this.width - 12, along, { size: 14, color: colors["--muted"], align: "right" });
      } else {
        if (along - last < 62) continue;
        this.#text(label, along, 76, { size: 14, color: colors["--muted"], align: "center" });
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
    c.setLineDash([]);
    if (link.isOneWay) this.#arrow(link.forward !== null ? a : b, link.forward !== null ? b : a, colors[style.color]);
    c.globalAlpha = 1;
    link.isLabeled = isNear || (!crowded && (isTree || link.isOneWay || link.class === "stale"));
  }

  #arrow(from, to, color) {
    const { context: c } = this;
    const angle = Math.atan2(to.y - from.y, to.x - from.x);
    const x = from.x + (to.x - from.x) * 0.62;
    const y = from.y + (to.y - from.y) * 0.62;
    c.fillStyle = color;
    c.beginPath();
    c.moveTo(x + 10 * Math.cos(angle), y + 10 * Math.sin(angle));
    c.lineTo(x + 8 * Math.cos(angle + 2.5), y + 8 * Math.sin(angle + 2.5));
    c.lineTo(x + 8 * Math.cos(angle - 2.5), y + 8 * Math.sin(angle - 2.5));
    c.fill();
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
      this.#text(change.lost ? "✕" : "+", (a.x + b.x) / 2, (a.y + b.y) / 2, { size: 18, color: colors["--cut"], align: "center", isBold: true, halo: true });
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
    if (device.health === "unreachable") this.#text("✕", at.x, at.y + 0.5, { size: isSmall ? 11 : 15, color: colors["--poor"], align: "center", isBold: true });
    else if (device.health === "degraded") this.#text("!", at.x, at.y + 0.5, { size: isSmall ? 10 : 15, color: "#160800", align: "center", isBold: true });
  }

  // Names, the most important first; those that would overlap are left out, as are links' labels.
  #labels() {
    const { colors } = this;
    const isCrowded = this.view.shown.length > CROWDED;
    const taken = [];
    const signs = this.view.shown.map((device) => {
      const at = this.#screen(device.name);
      const radius = this.radius * 0.8;
      return { left: at.x - radius, right: at.x + radius, top: at.y - radius, bottom: at.y + radius };
    });
    const isClear = (box, boxes) => boxes.every((other) => box.right < other.left || box.left > other.right || box.bottom < other.top || box.top > other.bottom);
    const free = (box, isImportant = false) => isClear(box, taken) && (isImportant || isClear(box, signs));
    const rank = (device) => (device.name === this.selected ? 0 : device.health === "unreachable" ? 1 : device.role === "base" ? 2 : device.role === "robot" ? 3 : device.health === "degraded" ? 4 : device.isCut ? 5 : 6);
    const size = isCrowded ? 14 : 16;
    for (const device of [...this.view.shown].sort((x, y) => rank(x) - rank(y))) {
      if (isCrowded && rank(device) > 5 && this.camera.scale < (this.isMetric ? 3 : 0.9)) continue;
      const at = this.#screen(device.name);
      const age = device.answers === true || !isKnown(device.age_s) ? "" : ` ${duration(device.age_s)}`;
      const label = device.name.length > 22 ? `${device.name.slice(0, 21)}…` : device.name;
      const width = (label.length + age.length) * size * 0.6;
      for (const dy of [this.radius + size * 0.9, -this.radius - size * 0.8]) {
        const box = { left: at.x - width / 2, right: at.x + width / 2, top: at.y + dy - size * 0.6, bottom: at.y + dy + size * 0.6 };
        if (device.name !== this.selected && !free(box, isCrowded && rank(device) < 4)) continue;
        taken.push(box);
        this.#text(label + age, at.x, at.y + dy, { size, color: device.answers === false ? colors["--muted"] : colors["--text"], align: "center", isBold: rank(device) < 4, halo: true });
        break;
      }
    }
    for (const link of this.view.links) {
      if (!link.isLabeled) continue;
      const a = this.#screen(link.a);
      const b = this.#screen(link.b);
      const text = linkLabel(link);
      if (a === null || b === null || text === "" || Math.hypot(a.x - b.x, a.y - b.y) < 70) continue;
      const at = { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 };
      const width = text.length * 8.4;
      const box = { left: at.x - width / 2, right: at.x + width / 2, top: at.y - 9, bottom: at.y + 9 };
      if (!free(box)) continue;
      taken.push(box);
      this.#text(text, at.x, at.y, { size: 14, color: colors["--text"], align: "center", halo: true });
    }
  }

  #text(text, x, y, { size, color, align, isBold = false, halo = false }) {
    const { context: c } = this;
    c.font = `${isBold ? 700 : 500} ${size}px system-ui, "Noto Sans", "DejaVu Sans", sans-serif`;
    c.textAlign = align;
    c.textBaseline = "middle";
    if (halo) {
      c.lineWidth = 5;
      c.lineJoin = "round";
      c.strokeStyle = this.colors["--bg"];
      c.strokeText(text, x, y);
    }
    c.fillStyle = color;
    c.fillText(text, x, y);
  }
}

const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

// Shapes besides color: base a square, robots circles, beacons diamonds, others triangles.
export function shape(c, role, x, y, radius) {
  c.beginPath();
  if (role === "base") c.rect(x - radius, y - radius, 2 * radius, 2 * radius);
  else if (role === "robot") c.arc(x, y, radius, 0, 2 * Math.PI);
  else {
    const corners = role === "unknown" ? 3 : 4;
    for (let i = 0; i < corners; i += 1) {
      const angle = -Math.PI / 2 + (2 * Math.PI * i) / corners;
      c.lineTo(x + radius * 1.25 * Math.cos(angle), y + radius * 1.25 * Math.sin(angle));
    }
    c.closePath();
  }
}

export function linkLabel(link) {
  if (link.isStale) return duration(link.age_s);
  if (isKnown(link.snr_db)) return `${Math.round(link.snr_db)} dB`;
  return isKnown(link.quality) ? percent(link.quality) : "";
}

function tipOf(view, name) {
  const device = view.devices.get(name);
  const lines = [device.name, `${device.role}, ${device.health}${device.reason ? `: ${device.reason}` : ""}`];
  if (isKnown(device.hops)) lines.push(device.hops === 0 ? "is the base" : `${device.hops} hops to base by ${device.via}, ${percent(device.quality)}`);
  if (device.isCut) lines.push("single point of failure");
  const near = [...view.linksOf.get(name)].sort((x, y) => (y.snr_db ?? y.quality ?? 0) - (x.snr_db ?? x.quality ?? 0));
  for (const link of near.slice(0, 4)) lines.push(`${link.a === name ? link.b : link.a}: ${withUnit(isKnown(link.snr_db) ? Math.round(link.snr_db) : null, "dB SNR")}, ${percent(link.quality)}${link.isOneWay ? ", one-way" : ""}`);
  return lines.join("\n");
}

function summaryOf(view) {
  const bad = view.shown.filter((device) => device.health === "unreachable").map((device) => device.name);
  const poor = view.links.filter((link) => link.class === "poor").length;
  return `Mesh at ${clockTime(view.time_s)}: ${view.shown.length} devices, ${view.links.length} links, ${poor} of them poor. ${bad.length === 0 ? "All required devices answer." : `No answer: ${bad.join(", ")}.`} Arrow keys select a device, plus and minus zoom.`;
}

// A sample of each sign, drawn as on the map.
export function drawSample(canvas, kind, colors) {
  const c = canvas.getContext("2d");
  const ratio = window.devicePixelRatio || 1;
  canvas.width = 30 * ratio;
  canvas.height = 16 * ratio;
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  const line = (color, width, dash = []) => { c.strokeStyle = color; c.lineWidth = width; c.setLineDash(dash); c.beginPath(); c.moveTo(0, 8); c.lineTo(30, 8); c.stroke(); };
  if (kind in LINK) line(colors[LINK[kind].color], LINK[kind].width, kind === "stale" ? [2, 5] : []);
  else if (kind === "one-way") line(colors["--text"], 3, [9, 5]);
  else if (kind === "path") { c.globalAlpha = 0.35; line(colors["--path"], 11); }
  else if (kind === "cut") { c.strokeStyle = colors["--cut"]; c.lineWidth = 2.5; c.beginPath(); c.arc(15, 8, 6.5, 0, 2 * Math.PI); c.stroke(); }
  else { shape(c, kind, 15, 8, 5.5); c.fillStyle = colors["--text"]; c.fill(); }
}
