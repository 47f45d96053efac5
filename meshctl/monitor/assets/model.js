// A frame -> what the page shows: devices, links by quality class, paths to the base, robots, differences. Pure functions.

import { isKnown } from "./format.js";

// A link without news for longer cannot be trusted.
export const STALE_S = 10;
// Classes by the weaker direction's SNR; where no radio reports it, by the mesh's own link quality.
export const SNR_GOOD_DB = 20;
export const SNR_FAIR_DB = 10;
export const QUALITY_GOOD = 0.8;
export const QUALITY_FAIR = 0.5;
// Shadowing alone moves a link by less than this.
export const CHANGE_DB = 6;
// Queued packets of one priority at one robot.
export const QUEUE_FAIR = 10;
export const QUEUE_POOR = 100;
const HEALTH_ORDER = ["ok", "off", "degraded", "unreachable"];

export function viewOf(frame, meta) {
  const status = frame.status ?? {};
  const nodes = (status.nodes ?? []).map((node) => deviceOf(node, frame));
  const devices = new Map(nodes.map((device) => [device.name, device]));
  const links = linksOf(frame, devices);
  for (const link of links) {
    // a device that only others report
    for (const name of [link.a, link.b]) if (!devices.has(name)) devices.set(name, strangerOf(name));
  }
  const view = { time_s: frame.time_s, frame, devices, links, byKey: new Map(links.map((link) => [link.key, link])) };
  view.linksOf = new Map([...devices.keys()].map((name) => [name, []]));
  for (const link of links) for (const name of [link.a, link.b]) view.linksOf.get(name).push(link);
  view.shown = [...devices.values()].filter((device) => device.health !== "off" || view.linksOf.get(device.name).length > 0);
  view.tree = new Set();
  for (const device of devices.values()) if (device.via) view.tree.add(pairKey(device.name, device.via));
  view.robots = (status.robots ?? []).map((robot) => robotOf(robot, status, devices, meta, frame.meters));
  view.entry = status.entry ?? null;
  return view;
}

export const pairKey = (a, b) => (a < b ? `${a}\u0000${b}` : `${b}\u0000${a}`);

function deviceOf(node, frame) {
  return {
    name: node.name, role: node.role, robot: node.robot, state: node.state, health: node.health, answers: node.answers,
    age_s: node.age_s, hops: node.hops, quality: node.quality, via: node.via, isCut: node.is_cut_vertex === true,
    alarms: node.alarms ?? [], raw: node, radios: frame.radios?.[node.name] ?? [], position: positionOf(node, frame),
    reason: node.silent_because,
  };
}

function strangerOf(name) {
  return { name, role: "unknown", robot: null, state: null, health: "unknown", answers: null, age_s: null, hops: null, quality: null, via: null, isCut: false, alarms: [], raw: {}, radios: [], position: null, reason: null };
}

function positionOf(node, frame) {
  const positions = frame.positions ?? {};
  const own = positions[node.name];
  // a carried radio is where its robot is
  const found = own ?? (node.robot && node.role !== "beacon" ? positions[node.robot] : undefined);
  return found !== undefined && found !== null && isKnown(found.x_m) && isKnown(found.y_m) ? found : null;
}

function reported(frame, devices) {
  if (Array.isArray(frame.links)) return frame.links;
  const found = [];
  for (const device of devices.values()) {
    for (const near of device.raw.neighbours ?? []) {
      found.push({ from: near.name, to: device.name, mesh: "", quality: near.quality, signal_dbm: near.signal_dbm, noise_dbm: null, snr_db: null, mcs: null, bitrate_kbit_s: null, age_s: near.age_s });
    }
  }
  return found;
}

function linksOf(frame, devices) {
  const pairs = new Map();
  for (const way of reported(frame, devices)) {
    const key = pairKey(way.from, way.to);
    let link = pairs.get(key);
    if (link === undefined) {
      const [a, b] = key.split("\u0000");
      link = { key, a, b, mesh: way.mesh, forward: null, back: null };
      pairs.set(key, link);
    }
    // several radios of one pair: the better one counts
    const side = way.from === link.a ? "forward" : "back";
    const other = link[side];
    if (other === null || (way.quality ?? -1) > (other.quality ?? -1)) link[side] = way;
  }
  for (const link of pairs.values()) classify(link, devices);
  return [...pairs.values()];
}

const least = (values) => {
  const known = values.filter(isKnown);
  return known.length === 0 ? null : Math.min(...known);
};

function classify(link, devices) {
  const ways = [link.forward, link.back].filter((way) => way !== null);
  link.snr_db = least(ways.map((way) => way.snr_db));
  link.quality = least(ways.map((way) => way.quality));
  link.age_s = least(ways.map((way) => way.age_s));
  link.isStale = isKnown(link.age_s) && link.age_s > STALE_S;
  const bothAnswer = [link.a, link.b].every((name) => devices.get(name)?.answers === true);
  // the other direction is missing although the device that would report it answers
  link.isOneWay = ways.length === 1 && bothAnswer;
  link.class = link.isStale ? "stale" : classOf(link.snr_db, link.quality);
}

export function classOf(snr_db, quality) {
  if (isKnown(snr_db)) return snr_db > SNR_GOOD_DB ? "good" : snr_db >= SNR_FAIR_DB ? "fair" : "poor";
  if (isKnown(quality)) return quality >= QUALITY_GOOD ? "good" : quality >= QUALITY_FAIR ? "fair" : "poor";
  return "unknown";
}

// The keys of the links from `name` to the base, in order; empty without a path.
export function pathOf(view, name) {
  const keys = [];
  const seen = new Set();
  let at = view.devices.get(name);
  while (at?.via && !seen.has(at.name)) {
    seen.add(at.name);
    keys.push(pairKey(at.name, at.via));
    at = view.devices.get(at.via);
  }
  return keys;
}

function robotOf(robot, status, devices, meta, meters) {
  const baseName = (status.robots ?? []).find((one) => one.is_base)?.name;
  // what an offline peer had last is not what it has now
  const toBase = (robot.peers ?? []).find((peer) => peer.name === baseName && peer.online) ?? null;
  const radios = (robot.radios ?? []).map((name) => devices.get(name)).filter((device) => device !== undefined && device.role !== "beacon");
  // a robot that told nothing itself: as the base sees it
  const fromBase = ((status.robots ?? []).find((one) => one.is_base)?.peers ?? []).find((peer) => peer.name === robot.name && peer.online) ?? null;
  const best = radios.filter((device) => isKnown(device.hops)).sort((x, y) => x.hops - y.hops || (y.quality ?? 0) - (x.quality ?? 0))[0] ?? null;
  const beacons = [...devices.values()].filter((device) => device.role === "beacon" && device.robot === robot.name);
  const peers = robot.peers;
  const sum = (values) => values.reduce((total, value) => total + value, 0);
  return {
    name: robot.name, isBase: robot.is_base === true, health: robot.health, answers: robot.answers, age_s: robot.age_s,
    alarms: robot.alarms ?? [], reason: robot.silent_because, raw: robot,
    hops: best?.hops ?? null, pathQuality: best?.quality ?? null, radio: best?.name ?? radios[0]?.name ?? null,
    queues: robot.queues ?? null, meter: meters?.[robot.name] ?? null,
    roundTrip_s: toBase?.round_trip_s ?? fromBase?.round_trip_s ?? null, loss: toBase?.loss ?? null,
    capacity: toBase?.capacity_bits_per_s ?? null,
    outbox: peers === null || peers === undefined ? null : peers.every((peer) => isKnown(peer.outbox_messages)) ? sum(peers.map((peer) => peer.outbox_messages)) : null,
    peersOnline: peers === null || peers === undefined ? null : peers.filter((peer) => peer.online).length,
    peerCount: peers === null || peers === undefined ? null : peers.length,
    telemetry_s: lastOf(robot, meta, "telemetry"), artifact_s: lastOf(robot, meta, "artifact"),
    beacons: beacons.length === 0 ? null : {
      left: beacons.filter((device) => device.state === "carried").length,
      deployed: beacons.filter((device) => device.state === "deployed").length,
    },
  };
}

// Seconds since the robot last sent a message of this class; at the base, since one last arrived there.
function lastOf(robot, meta, topicClass) {
  const ages = (robot.topics ?? [])
    .filter((topic) => (meta.topic_classes?.[topic.name] ?? null) === topicClass)
    .map((topic) => (robot.is_base ? topic.received_ago_s : topic.sent_ago_s));
  return least(ages);
}

export const queueClass = (messages) => (messages === 0 ? "" : messages < QUEUE_FAIR ? "good" : messages <= QUEUE_POOR ? "fair" : "poor");

// What differs from the reference, the most important first: [{kind: worse|better|other, text, name | key}].
export function differences(view, reference) {
  const found = [];
  for (const [name, before] of reference.devices) {
    const now = view.devices.get(name);
    if (now === undefined) { found.push({ kind: "worse", name, text: `${name} is gone from the mesh` }); continue; }
    if (now.health !== before.health) {
      const isWorse = HEALTH_ORDER.indexOf(now.health) > HEALTH_ORDER.indexOf(before.health);
      found.push({ kind: isWorse ? "worse" : "better", name, text: `${name}: ${before.health} → ${now.health}` });
    }
    if (isKnown(before.hops) && isKnown(now.hops) && before.hops !== now.hops) {
      found.push({ kind: now.hops > before.hops ? "worse" : "better", name, text: `${name}: ${before.hops} → ${now.hops} hops` });
    }
    if (now.isCut !== before.isCut && now.answers && before.answers) {
      found.push({ kind: now.isCut ? "worse" : "better", name, text: now.isCut ? `${name} is now a single point of failure` : `${name} is no longer a single point of failure` });
    }
  }
  for (const name of view.devices.keys()) if (!reference.devices.has(name)) found.push({ kind: "other", name, text: `${name} is new` });
  for (const [key, before] of reference.byKey) {
    const now = view.byKey.get(key);
    if (now === undefined) found.push({ kind: "worse", key, lost: before, text: `link ${before.a} – ${before.b} is gone` });
    else if (isKnown(now.snr_db) && isKnown(before.snr_db) && Math.abs(now.snr_db - before.snr_db) >= CHANGE_DB) {
      const by = Math.round(now.snr_db - before.snr_db);
      found.push({ kind: by < 0 ? "worse" : "better", key, text: `link ${now.a} – ${now.b}: ${by > 0 ? "+" : "−"}${Math.abs(by)} dB (now ${Math.round(now.snr_db)} dB)` });
    } else if (now.isOneWay && !before.isOneWay) found.push({ kind: "worse", key, text: `link ${now.a} – ${now.b} is one-way` });
  }
  for (const [key, now] of view.byKey) if (!reference.byKey.has(key)) found.push({ kind: "better", key, isNew: true, text: `link ${now.a} – ${now.b} is new` });
  const rank = { worse: 0, other: 1, better: 2 };
  return found.sort((x, y) => rank[x.kind] - rank[y.kind]);
}
