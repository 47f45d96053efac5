// The names of devices and the labels of links on the map.

import { duration, isKnown } from "./format.js";
import { drawText } from "./signs.js";
import { linkLabel } from "./words.js";

// Names of ordinary beacons in a large fleet appear from this zoom on.
const CROWDED = 80;

// Names, the most important first; those that would overlap are left out, as are links' labels. `screen` gives a device's
// place on the canvas; `radius` is that of the signs, and `scale` is in pixels per unit of the places.
export function drawLabels(c, colors, { view, selected, radius, isMetric, scale, screen }) {
  const isCrowded = view.shown.length > CROWDED;
  const taken = [];
  const signs = view.shown.map((device) => {
    const at = screen(device.name);
    const half = radius * 0.8;
    return { left: at.x - half, right: at.x + half, top: at.y - half, bottom: at.y + half };
  });
  const isClear = (box, boxes) => boxes.every((other) => box.right < other.left || box.left > other.right || box.bottom < other.top || box.top > other.bottom);
  const free = (box, isImportant = false) => isClear(box, taken) && (isImportant || isClear(box, signs));
  const rank = (device) => (device.name === selected ? 0 : device.health === "unreachable" ? 1 : device.role === "base" ? 2 : device.role === "robot" ? 3 : device.health === "degraded" ? 4 : device.isCut ? 5 : 6);
  const size = isCrowded ? 14 : 16;
  for (const device of [...view.shown].sort((x, y) => rank(x) - rank(y))) {
    if (isCrowded && rank(device) > 5 && scale < (isMetric ? 3 : 0.9)) continue;
    const at = screen(device.name);
    const age = device.answers === true || !isKnown(device.age_s) ? "" : ` ${duration(device.age_s)}`;
    const label = device.name.length > 22 ? `${device.name.slice(0, 21)}…` : device.name;
    const width = (label.length + age.length) * size * 0.6;
    // below, above, and for important devices beside; in the end over the sign of another, rather than not at all
    const below = radius + size * 0.9;
    const beside = radius + width / 2 + 4;
    const sides = [[0, below, false], [0, -radius - size * 0.8, false]];
    if (rank(device) < 4) sides.push([-beside, 0, false], [beside, 0, false], [0, below, true], [0, -radius - size * 0.8, true]);
    for (const [dx, dy, isImportant] of sides) {
      const box = { left: at.x + dx - width / 2, right: at.x + dx + width / 2, top: at.y + dy - size * 0.6, bottom: at.y + dy + size * 0.6 };
      if (!free(box, isImportant) && !(isImportant && device.name === selected)) continue;
      taken.push(box);
      drawText(c, label + age, at.x + dx, at.y + dy, { size, color: device.answers === false ? colors["--muted"] : colors["--text"], align: "center", isBold: rank(device) < 4, halo: colors["--bg"] });
      break;
    }
  }
  for (const link of view.links) {
    if (!link.isLabeled) continue;
    const a = screen(link.a);
    const b = screen(link.b);
    const text = linkLabel(link);
    if (a === null || b === null || text === "" || Math.hypot(a.x - b.x, a.y - b.y) < 70) continue;
    const at = { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 };
    const width = text.length * 8.4;
    const box = { left: at.x - width / 2, right: at.x + width / 2, top: at.y - 9, bottom: at.y + 9 };
    if (!free(box)) continue;
    taken.push(box);
    drawText(c, text, at.x, at.y, { size: 14, color: colors["--text"], align: "center", halo: colors["--bg"] });
  }
}
