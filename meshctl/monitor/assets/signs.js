// Signs of the map: links' colors, devices' shapes, arrows, texts, and samples of them for the legend.

// Good thick, fair thinner, poor hollow: to tell without color, and a poor link of a path is seen from afar.
export const LINK = { good: { width: 4.5, color: "--good" }, fair: { width: 3, color: "--fair" }, poor: { width: 5, color: "--poor", isHollow: true }, stale: { width: 2, color: "--stale" }, unknown: { width: 2, color: "--muted" } };

// The part of a hollow line's width that is empty.
export const HOLLOW = 0.42;

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

export function drawArrow(c, from, to, color) {
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

// `halo` is the color behind the text, null for none.
export function drawText(c, text, x, y, { size, color, align, isBold = false, halo = null }) {
  c.font = `${isBold ? 700 : 500} ${size}px system-ui, "Noto Sans", "DejaVu Sans", sans-serif`;
  c.textAlign = align;
  c.textBaseline = "middle";
  if (halo !== null) {
    c.lineWidth = 5;
    c.lineJoin = "round";
    c.strokeStyle = halo;
    c.strokeText(text, x, y);
  }
  c.fillStyle = color;
  c.fillText(text, x, y);
}

// A sample of each sign, drawn as on the map.
export function drawSample(canvas, kind, colors) {
  const c = canvas.getContext("2d");
  const ratio = window.devicePixelRatio || 1;
  canvas.width = 30 * ratio;
  canvas.height = 16 * ratio;
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  const line = (color, width, dash = []) => { c.strokeStyle = color; c.lineWidth = width; c.setLineDash(dash); c.beginPath(); c.moveTo(0, 8); c.lineTo(30, 8); c.stroke(); };
  if (kind in LINK) {
    line(colors[LINK[kind].color], LINK[kind].width, kind === "stale" ? [2, 5] : []);
    if (LINK[kind].isHollow) line(colors["--bg"], LINK[kind].width * HOLLOW);
  }
  else if (kind === "one-way") line(colors["--text"], 3, [9, 5]);
  else if (kind === "track") line(colors["--accent"], 3);
  else if (kind === "lost-track") line(colors["--stale"], 2, [2, 4]);
  else if (kind === "path") { c.globalAlpha = 0.35; line(colors["--path"], 11); }
  else if (kind === "cut") { c.strokeStyle = colors["--cut"]; c.lineWidth = 2.5; c.beginPath(); c.arc(15, 8, 6.5, 0, 2 * Math.PI); c.stroke(); }
  else { shape(c, kind, 15, 8, 5.5); c.fillStyle = colors["--text"]; c.fill(); }
}
