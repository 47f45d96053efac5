// Where devices are drawn: in meters where positions are known, else in columns by hops from the base.

import { isKnown } from "./format.js";

const COLUMN = 170;
const ROW = 64;
const MAX_STRETCH = 2.6;

// `view.shown` -> Map name -> {x, y, isGuess}; y grows downwards. Keeps its points, so that a change moves few devices.
export class Layout {
  constructor() {
    this.byHops = new Map();
    this.byMeters = new Map();
    this.signature = "";
    this.lastPlaces = new Map();
  }

  // Learn where a device was from an older state; whether it had a position then.
  learn(view, name) {
    const place = view.devices.get(name)?.position ?? null;
    if (place !== null) this.lastPlaces.set(name, { x: place.x_m, y: -place.y_m, time_s: view.time_s });
    return place !== null;
  }

  // `room` is the canvas's {x, y} in pixels: columns are stretched across to use it.
  hops(view, isPortrait, room) {
    const links = view.links.filter((link) => !link.isStale);
    // a link that comes or goes moves nothing: only devices whose distance changed get a new place
    const signature = JSON.stringify([isPortrait, view.shown.map((device) => [device.name, device.hops])]);
    if (signature !== this.signature) {
      this.byHops = this.#arrange(view, links, isPortrait);
      this.signature = signature;
    }
    return stretched(this.byHops, isPortrait, room);
  }

  #arrange(view, links, isPortrait) {
    const farthest = Math.max(0, ...view.shown.map((d) => d.hops ?? 0));
    const order = rowsOf(view);
    const points = view.shown.map((device) => {
      const hop = isKnown(device.hops) ? device.hops : farthest + 1;
      const known = this.byHops.get(device.name);
      const isSame = known !== undefined && known.hop === hop && known.isPortrait === isPortrait;
      const column = hop * COLUMN;
      const row = order.get(device.name) * ROW;
      const turned = isPortrait ? { x: row, y: column } : { x: column, y: row };
      const kept = isSame ? { x: known.x, y: known.y, fx: known.x, fy: known.y } : {};
      return { name: device.name, hop, isPortrait, isGuess: false, column, ...turned, ...kept };
    });
    const index = new Map(points.map((point) => [point.name, point]));
    const pulls = links.filter((link) => index.has(link.a) && index.has(link.b)).map((link) => ({ source: index.get(link.a), target: index.get(link.b), strength: view.tree.has(link.key) ? 0.35 : 0.02 }));
    const crowded = points.length > 60;
    const [along, across] = isPortrait ? [d3.forceY, d3.forceX] : [d3.forceX, d3.forceY];
    const simulation = d3.forceSimulation(points)
      .force("along", along((point) => point.column).strength(crowded ? 0.5 : 0.9))
      .force("across", across(0).strength(0.03))
      .force("link", d3.forceLink(pulls).distance(COLUMN * 0.8).strength((pull) => pull.strength))
      .force("charge", d3.forceManyBody().strength(-260).distanceMax(500))
      .force("collide", d3.forceCollide(crowded ? 30 : 38))
      .stop();
    simulation.tick(points.some((point) => point.fx !== undefined) ? 40 : 220);
    return index;
  }

  // Devices without a position are placed beside a neighbor that has one.
  meters(view) {
    const points = new Map();
    for (const device of view.shown) {
      if (device.position === null) continue;
      const place = { x: device.position.x_m, y: -device.position.y_m };
      this.lastPlaces.set(device.name, { ...place, time_s: view.time_s });
      points.set(device.name, { ...place, isGuess: false });
    }
    for (const device of view.shown) {
      const last = this.lastPlaces.get(device.name);
      if (!points.has(device.name) && last !== undefined && last.time_s <= view.time_s) points.set(device.name, { x: last.x, y: last.y, isGuess: true });
    }
    spread(points);
    let open = view.shown.filter((device) => !points.has(device.name));
    for (let round = 0; open.length > 0 && round < view.shown.length; round += 1) {
      for (const device of open) {
        const near = view.linksOf.get(device.name).find((link) => points.has(link.a === device.name ? link.b : link.a));
        const anchor = near === undefined ? undefined : points.get(near.a === device.name ? near.b : near.a);
        if (anchor === undefined) continue;
        const angle = angleOf(device.name);
        points.set(device.name, { x: anchor.x + 12 * Math.cos(angle), y: anchor.y + 12 * Math.sin(angle), isGuess: true });
      }
      const left = open.filter((device) => !points.has(device.name));
      if (left.length === open.length) break;
      open = left;
    }
    const bottom = Math.max(0, ...[...points.values()].map((point) => point.y));
    view.shown.filter((device) => !points.has(device.name)).forEach((device, i) => points.set(device.name, { x: i * 15, y: bottom + 30, isGuess: true }));
    return points;
  }
}

function stretched(points, isPortrait, room) {
  const [along, across] = isPortrait ? ["y", "x"] : ["x", "y"];
  const extent = (axis) => Math.max(...[...points.values()].map((point) => point[axis])) - Math.min(...[...points.values()].map((point) => point[axis]));
  if (points.size < 3) return points;
  const factor = Math.min(MAX_STRETCH, Math.max(1, (extent(along) / Math.max(1, extent(across))) * (room[across] / room[along]) * 0.9));
  return new Map([...points].map(([name, point]) => [name, { ...point, [across]: point[across] * factor }]));
}

// Two radios of one robot have one position: draw them a little apart.
function spread(points) {
  const taken = new Map();
  for (const point of points.values()) {
    const place = `${point.x.toFixed(1)} ${point.y.toFixed(1)}`;
    const count = taken.get(place) ?? 0;
    taken.set(place, count + 1);
    if (count > 0) { point.x += 3 * count; point.y += 3 * (count % 2 === 0 ? -1 : 1); }
  }
}

function angleOf(name) {
  let hash = 7;
  for (const letter of name) hash = (hash * 31 + letter.codePointAt(0)) % 3600;
  return (hash / 1800) * Math.PI;
}

// The row of each device in a tidy tree of paths: leaves one below the other, others between their children.
function rowsOf(view) {
  const children = new Map();
  for (const device of view.shown) {
    const parent = device.via && view.devices.has(device.via) ? device.via : "";
    if (!children.has(parent)) children.set(parent, []);
    children.get(parent).push(device.name);
  }
  const rows = new Map();
  let next = 0;
  const place = (name, depth) => {
    const below = depth > view.shown.length ? [] : (children.get(name) ?? []).filter((child) => !rows.has(child));
    if (below.length === 0) { rows.set(name, next); next += 1; return rows.get(name); }
    rows.set(name, 0);
    const placed = below.map((child) => place(child, depth + 1));
    rows.set(name, (placed[0] + placed.at(-1)) / 2);
    return rows.get(name);
  };
  for (const root of children.get("") ?? []) place(root, 0);
  for (const device of view.shown) if (!rows.has(device.name)) place(device.name, 0);
  const middle = Math.max(0, next - 1) / 2;
  for (const [name, row] of rows) rows.set(name, row - middle);
  return rows;
}

