// What the map says in words: links' labels, a device's tip, and a summary for screen readers.

import { clockTime, duration, isKnown, percent, withUnit } from "./format.js";

export function linkLabel(link) {
  if (link.isStale) return duration(link.age_s);
  if (isKnown(link.snr_db)) return `${Math.round(link.snr_db)} dB`;
  return isKnown(link.quality) ? percent(link.quality) : "";
}

export function tipOf(view, name) {
  const device = view.devices.get(name);
  const lines = [device.name, `${device.role}, ${device.health}${device.reason ? `: ${device.reason}` : ""}`];
  if (isKnown(device.hops)) lines.push(device.hops === 0 ? "is the base" : `${device.hops} hops to base by ${device.via}, ${percent(device.quality)}`);
  if (device.isCut) lines.push("single point of failure");
  const near = [...view.linksOf.get(name)].sort((x, y) => (y.snr_db ?? y.quality ?? 0) - (x.snr_db ?? x.quality ?? 0));
  for (const link of near.slice(0, 4)) lines.push(`${link.a === name ? link.b : link.a}: ${withUnit(isKnown(link.snr_db) ? Math.round(link.snr_db) : null, "dB SNR")}, ${percent(link.quality)}${link.isOneWay ? ", one-way" : ""}`);
  return lines.join("\n");
}

export function summaryOf(view) {
  const bad = view.shown.filter((device) => device.health === "unreachable").map((device) => device.name);
  const poor = view.links.filter((link) => link.class === "poor").length;
  return `Mesh at ${clockTime(view.time_s)}: ${view.shown.length} devices, ${view.links.length} links, ${poor} of them poor. ${bad.length === 0 ? "All required devices answer." : `No answer: ${bad.join(", ")}.`} Arrow keys select a device, plus and minus zoom.`;
}
