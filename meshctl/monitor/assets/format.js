// Values as text. An unknown value is MISSING, never 0.

export const MISSING = "–";
export const isKnown = (value) => value !== null && value !== undefined && !Number.isNaN(value);

export function duration(seconds) {
  if (!isKnown(seconds)) return MISSING;
  const s = Math.max(0, seconds);
  if (s < 9.95) return `${s.toFixed(1)} s`;
  if (s < 99.5) return `${Math.round(s)} s`;
  if (s < 5970) return `${Math.round(s / 60)} min`;
  if (s < 48 * 3600) return `${Math.floor(s / 3600)} h ${String(Math.floor((s % 3600) / 60)).padStart(2, "0")}`;
  return `${Math.round(s / 86400)} days`;
}

export const percent = (share) => (isKnown(share) ? `${Math.round(share * 100)} %` : MISSING);
export const milliseconds = (seconds) => (isKnown(seconds) ? `${Math.round(seconds * 1000)} ms` : MISSING);
export const withUnit = (value, unit) => (isKnown(value) ? `${value} ${unit}` : MISSING);

export function bitRate(bitsPerSecond) {
  if (!isKnown(bitsPerSecond)) return MISSING;
  if (bitsPerSecond >= 1e6) return `${(bitsPerSecond / 1e6).toFixed(1)} Mb/s`;
  return `${Math.round(bitsPerSecond / 1e3)} kb/s`;
}

export function byteCount(bytes) {
  if (!isKnown(bytes)) return MISSING;
  if (bytes >= 1e6) return `${(bytes / 1e6).toFixed(1)} MB`;
  return bytes >= 1e3 ? `${Math.round(bytes / 1e3)} kB` : `${bytes} B`;
}

export function clockTime(time_s) {
  const date = new Date(time_s * 1000);
  return [date.getHours(), date.getMinutes(), date.getSeconds()].map((part) => String(part).padStart(2, "0")).join(":");
}

// Three digits, as a chart can show.
export const shortNumber = (value) => (Math.abs(value) >= 100 ? String(Math.round(value)) : String(Number(value.toPrecision(3))));

export const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
