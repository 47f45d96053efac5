// The panels beside the map: robots, alarms, radios, changes, details.

import { el, setText, syncChildren } from "./dom.js";
import { bitRate, clockTime, duration, isKnown, milliseconds, MISSING, percent, plural } from "./format.js";
import { classOf, queueClass } from "./model.js";
import { actionButtons } from "./actions.js";

export const MARKS = { error: "▲ ERROR", warning: "◆ WARNING", note: "● NOTE" };
const HEALTH_MARKS = { ok: "✓ ok", degraded: "! degraded", unreachable: "✕ no answer", off: "○ off", unknown: "? unknown" };
const CLASS_MARKS = { good: "●", fair: "◐", poor: "○", stale: "·", unknown: "?" };
// More robots get the small cards.
const MAX_FULL_CARDS = 6;

const healthMark = (health) => HEALTH_MARKS[health] ?? `? ${health}`;

function fact(term, text, isBad = false) {
  const classes = [text === MISSING ? "is-missing" : "", isBad ? "is-bad" : "", /^[\d–-]/.test(text) && text.length < 9 ? "" : text.length > 8 ? "is-text is-long" : "is-text"].join(" ").trim();
  // the unit after the last space is small
  const at = /^[\d.,–-]+ \S/.test(text) ? text.indexOf(" ") : -1;
  const parts = at < 0 ? [text] : [text.slice(0, at), el("small", {}, text.slice(at))];
  return el("div", {}, el("dt", {}, term), el("dd", { class: classes || null, title: text === MISSING ? `${term}: unknown` : `${term}: ${text}` }, ...parts));
}

export function showRobots(panel, view, selected, onSelect) {
  if (panel.list === undefined) {
    panel.heading = el("h2", {}, "Robots");
    panel.list = el("div", {});
    panel.empty = el("p", { class: "empty" });
    panel.replaceChildren(panel.heading, panel.empty, panel.list);
  }
  const robots = [...view.robots].sort((x, y) => Number(y.isBase) - Number(x.isBase));
  const note = (view.frame.status?.alarms ?? []).find((alarm) => alarm.code === "robots-unasked");
  setText(panel.empty, robots.length === 0 ? (note?.text ?? "The inventory has no robot with a computer.") : "");
  panel.empty.hidden = robots.length > 0;
  panel.list.className = robots.length > MAX_FULL_CARDS ? "is-compact" : "";
  const items = robots.map((robot) => ({ robot, isCompact: robots.length > MAX_FULL_CARDS, isSelected: robot.name === selected || robot.radio === selected }));
  syncChildren(panel.list, items, (item) => item.robot.name, () => el("article", { class: "card", tabindex: "0" }), (card, item) => fillRobot(card, item, onSelect));
}

function fillRobot(card, { robot, isCompact, isSelected }, onSelect) {
  card.dataset.health = robot.health;
  card.classList.toggle("is-selected", isSelected);
  card.setAttribute("aria-label", `${robot.name}: ${robot.health}`);
  card.onclick = () => onSelect(robot.radio ?? robot.name);
  card.onkeydown = (event) => { if (event.key === "Enter") onSelect(robot.radio ?? robot.name); };
  const path = robot.isBase ? "base station" : isKnown(robot.hops) ? `${plural(robot.hops, "hop")} · ${percent(robot.pathQuality)}` : MISSING;
  const parts = [
    el("div", { class: "card-head" }, el("h3", {}, robot.name), el("span", { class: "muted" }, path), el("span", { class: "health", "data-health": robot.health }, healthMark(robot.health))),
  ];
  if (robot.meter !== null) parts.push(meterOf(robot.meter));
  if (robot.raw.recorded && robot.answers === false) parts.push(el("p", { class: "muted" }, "did not answer; from its own recording"));
  if (robot.answers === false && !robot.raw.recorded) {
    parts.push(el("p", { class: "muted" }, `${robot.reason ?? "no answer"} · last seen ${isKnown(robot.age_s) ? `${duration(robot.age_s)} ago` : "never"}`));
  } else {
    const peers = fact("peers", isKnown(robot.peersOnline) ? `${robot.peersOnline}/${robot.peerCount}` : MISSING);
    const outbox = fact("outbox", isKnown(robot.outbox) ? String(robot.outbox) : MISSING);
    const last = [fact("telemetry", duration(robot.telemetry_s), (robot.telemetry_s ?? 0) > 10), fact("artifact", duration(robot.artifact_s))];
    parts.push(el("dl", { class: "facts" }, ...(robot.isBase ? [peers, outbox, ...last] : [
      fact("round trip", milliseconds(robot.roundTrip_s)), fact("loss", percent(robot.loss), (robot.loss ?? 0) > 0.1), fact("capacity", bitRate(robot.capacity)),
      ...(isCompact ? [outbox, ...last] : [peers, outbox, ...last, fact("seen", duration(robot.age_s))]),
    ])));
    parts.push(queuesOf(robot, isCompact));
  }
  if (robot.beacons !== null && isCompact) {
    parts[0].insertBefore(el("span", { class: "stock", title: `${robot.beacons.left} beacons left, ${robot.beacons.deployed} deployed` }, `◆${robot.beacons.left}`), parts[0].lastElementChild);
  } else if (robot.beacons !== null) {
    const { left, deployed } = robot.beacons;
    parts.push(el("div", { class: "beacons" }, el("span", { class: "stock", "aria-hidden": "true" }, "◆".repeat(Math.min(12, left)) + "◇".repeat(Math.min(12, deployed))), el("span", {}, el("strong", {}, String(left)), ` ${left === 1 ? "beacon" : "beacons"} left, ${deployed} deployed`)));
  }
  card.replaceChildren(...parts);
}

// The placement meter's advice, in the largest type of the card.
function meterOf(meter) {
  const advice = typeof meter.advice === "string" ? meter.advice : "no advice";
  const large = (value, unit) => el("span", { class: "meter-value" }, el("b", {}, isKnown(value) ? String(Math.floor(value)) : MISSING), ` ${unit}`);
  return el("div", { class: "meter", "data-advice": advice }, el("strong", {}, advice), large(meter.meters_left, "m left"), large(meter.margin_db, "dB margin"), meter.reason ? el("span", { class: "meter-reason" }, meter.reason) : null);
}

// One cell per priority, the most urgent first: messages and the age of the oldest.
function queuesOf(robot, isCompact) {
  const row = el("div", { class: "queues", role: "img", "aria-label": robot.queues === null ? "queues: unknown" : `queues: ${robot.queues.filter((q) => q.messages > 0).map((q) => `priority ${q.priority} ${q.messages} messages, oldest ${duration(q.oldest_s)}`).join("; ") || "empty"}` });
  if (robot.queues === null) {
    row.append(el("span", { class: "queue" }, `queues ${MISSING}`));
    return row;
  }
  const shown = isCompact ? robot.queues.filter((queue) => queue.messages > 0) : robot.queues;
  if (shown.length === 0) row.append(el("span", { class: "queue" }, "queues empty"));
  for (const queue of shown) {
    row.append(el("span", { class: "queue", "data-class": queueClass(queue.messages) }, `P${queue.priority}`, el("b", {}, String(queue.messages)), queue.messages > 0 ? duration(queue.oldest_s) : " "));
  }
  return row;
}

// Those of the shown moment, unacknowledged and severe first, then those that ended before it.
export function alarmsAt(alarms, at_s) {
  const rank = { error: 0, warning: 1, note: 2 };
  const known = alarms.filter((alarm) => alarm.first_s <= at_s + 0.001);
  const isOpen = (alarm) => alarm.ended_s === null || alarm.ended_s > at_s;
  const open = known.filter(isOpen).sort((x, y) => Number(isQuiet(x)) - Number(isQuiet(y)) || rank[x.level] - rank[y.level] || y.first_s - x.first_s);
  const ended = known.filter((alarm) => !isOpen(alarm)).sort((x, y) => y.ended_s - x.ended_s);
  return { open, ended };
}

export const isQuiet = (alarm) => alarm.acknowledged !== null || alarm.silenced !== null;
export const deviceLabel = (alarm) => (alarm.device === "" ? "fleet" : alarm.device.replace(/^robot:/, "robot "));

export function showAlarms(panel, alarms, at_s, handlers, canAcknowledge) {
  if (panel.open === undefined) {
    panel.open = el("div", {});
    panel.none = el("p", { class: "empty" }, "No open alarm.");
    panel.notesHead = el("h2", { class: "over" }, "Notes");
    panel.notes = el("ul", {});
    panel.endedHead = el("h2", { class: "over" }, "Ended");
    panel.ended = el("ul", {});
    panel.replaceChildren(el("h2", {}, "Open alarms"), panel.none, panel.open, panel.notesHead, panel.notes, panel.endedHead, panel.ended);
  }
  const { open, ended: everEnded } = alarmsAt(alarms, at_s);
  const ended = everEnded.filter((alarm) => alarm.level !== "note");
  const notes = open.filter((alarm) => alarm.level === "note");
  const serious = open.filter((alarm) => alarm.level !== "note");
  panel.none.hidden = serious.length > 0;
  panel.notesHead.hidden = notes.length === 0;
  panel.endedHead.hidden = ended.length === 0;
  const key = (item) => `${item.alarm.device}\u0000${item.alarm.code}\u0000${item.alarm.first_s}`;
  const items = (list, isOpen) => list.map((alarm) => ({ alarm, isOpen, canAcknowledge }));
  syncChildren(panel.open, items(serious, true), key, () => el("article", { class: "alarm" }), (card, one) => fillAlarm(card, one, handlers));
  const line = () => el("li", { class: "alarm-line" });
  syncChildren(panel.notes, items(notes, true), key, line, (row, one) => fillLine(row, one, handlers));
  syncChildren(panel.ended, items(ended.slice(0, 60), false), key, line, (row, one) => fillLine(row, one, handlers));
}

function fillAlarm(card, { alarm, canAcknowledge }, handlers) {
  card.dataset.level = alarm.level;
  card.classList.toggle("is-acknowledged", isQuiet(alarm));
  const times = [`since ${clockTime(alarm.first_s)}, last ${clockTime(alarm.last_s)}`];
  if (alarm.acknowledged !== null) times.push(`acknowledged by ${alarm.acknowledged.by} ${clockTime(alarm.acknowledged.at_s)}`);
  if (alarm.silenced !== null) times.push(`silenced by ${alarm.silenced.by}: ${alarm.silenced.reason}`);
  const buttons = [el("button", { type: "button", onclick: () => handlers.jump(alarm) }, "Jump to start")];
  if (canAcknowledge && alarm.silenced === null) buttons.unshift(el("button", { type: "button", onclick: () => handlers.silence(alarm) }, "Silence…"));
  if (canAcknowledge && alarm.acknowledged === null) buttons.unshift(el("button", { type: "button", onclick: () => handlers.acknowledge(alarm) }, "Acknowledge"));
  card.replaceChildren(
    el("h3", {}, el("span", { class: "level" }, MARKS[alarm.level] ?? alarm.level), deviceButton(alarm, handlers), el("code", {}, alarm.code)),
    el("p", {}, alarm.text),
    ...(alarm.hint ? [el("p", { class: "muted" }, alarm.hint)] : []),
    el("div", { class: "alarm-foot" }, el("span", { class: "times" }, times.join(" · ")), el("span", { class: "buttons" }, ...buttons)),
  );
}

function fillLine(row, { alarm, isOpen }, handlers) {
  row.dataset.level = alarm.level;
  row.replaceChildren(
    el("span", { class: "level" }, (MARKS[alarm.level] ?? "?").slice(0, 1)), deviceButton(alarm, handlers),
    el("span", { class: "muted" }, isOpen ? alarm.text : alarm.code),
    el("button", { type: "button", class: "when", title: "Jump to start", onclick: () => handlers.jump(alarm) }, isOpen ? clockTime(alarm.first_s) : `${clockTime(alarm.first_s)} – ${clockTime(alarm.ended_s)}`),
  );
}

function deviceButton(alarm, handlers) {
  if (alarm.device === "") return el("span", { class: "device" }, "fleet");
  return el("button", { type: "button", class: "device", title: "Show this device", onclick: () => handlers.select(alarm.device.replace(/^robot:/, "")) }, deviceLabel(alarm));
}

const worstSnr = (view, name) => {
  const own = view.linksOf.get(name).filter((link) => view.tree.has(link.key) && isKnown(link.snr_db));
  return own.length === 0 ? null : Math.min(...own.map((link) => link.snr_db));
};

export function showRadios(panel, view, selected, onSelect) {
  if (panel.body === undefined) {
    const head = (text, isNumber, title) => el("th", { scope: "col", class: isNumber ? "number" : null, title }, text);
    panel.body = el("tbody", {});
    panel.replaceChildren(el("table", {}, el("thead", {}, el("tr", {}, head("Radio"), head("State"), head("Hops", true), head("Path", true), head("SNR", true, "weakest link on a path to the base"), head("Busy", true, "share of time the channel is busy"), head("Seen", true))), panel.body));
  }
  const rows = [...view.devices.values()].map((device) => ({
    name: device.name, health: device.health, hops: device.hops, quality: device.quality, snr: worstSnr(view, device.name),
    busy: device.radios.find((radio) => isKnown(radio.busy_ratio))?.busy_ratio ?? null, age_s: isKnown(device.age_s) ? Math.round(device.age_s) : null,
    isSelected: device.name === selected,
  }));
  syncChildren(panel.body, rows, (row) => row.name, () => el("tr", { tabindex: "0" }), (row, item) => {
    row.classList.toggle("is-selected", item.isSelected);
    row.onclick = () => onSelect(item.name);
    row.onkeydown = (event) => { if (event.key === "Enter") onSelect(item.name); };
    const cell = (text, kind) => el("td", { class: [kind, text === MISSING ? "is-missing" : ""].join(" ").trim() || null }, text);
    const kind = classOf(item.snr, item.quality);
    row.replaceChildren(
      el("td", { class: "name", title: item.name }, item.name),
      el("td", {}, el("span", { class: "health", "data-health": item.health }, healthMark(item.health))),
      cell(isKnown(item.hops) ? String(item.hops) : MISSING, "number"),
      cell(percent(item.quality), "number"),
      el("td", { class: `number${isKnown(item.snr) ? "" : " is-missing"}` }, isKnown(item.snr) ? `${Math.round(item.snr)} ` : MISSING, isKnown(item.snr) ? el("span", { class: "bar", "data-class": kind, title: kind }, CLASS_MARKS[kind]) : null),
      cell(percent(item.busy), "number"),
      cell(isKnown(item.age_s) ? duration(item.age_s) : "never", "number"),
    );
  });
}

export function showChanges(panel, changes, reference_s, onSelect, onReference) {
  if (reference_s === null) {
    panel.replaceChildren(
      el("p", { class: "empty" }, "No reference yet. Mark the state before the run as the reference: the map and this list then show what changed since."),
      el("button", { type: "button", onclick: onReference }, "Mark the shown state"),
    );
    return;
  }
  const rows = changes.map((change) => el("p", { class: "change", "data-kind": change.kind }, el("b", {}, change.kind === "worse" ? "▼" : change.kind === "better" ? "▲" : "•"), change.text));
  panel.replaceChildren(
    el("h2", {}, `${plural(changes.length, "difference")} from ${clockTime(reference_s)}, ${changes.filter((change) => change.kind === "worse").length} worse`),
    ...(rows.length === 0 ? [el("p", { class: "empty" }, "Nothing changed.")] : rows),
    el("div", { class: "actions" }, el("button", { type: "button", onclick: () => onReference(null) }, "Forget the reference")),
  );
}

export function showDetails(panel, view, selected, context) {
  if (panel.facts === undefined) {
    panel.facts = el("div", {});
    panel.buttons = el("div", { class: "actions" });
    panel.charts = el("div", {});
    panel.tables = el("div", {});
    panel.replaceChildren(panel.facts, panel.buttons, panel.charts, panel.tables);
  }
  const device = selected === null ? undefined : view.devices.get(selected);
  const robot = view.robots.find((one) => one.name === selected || (device !== undefined && one.radio === selected));
  if (device === undefined && robot === undefined) {
    panel.facts.replaceChildren(el("p", { class: "empty" }, selected === null ? "Select a device on the map or in a list." : `${selected} is not in this state of the mesh.`));
    panel.buttons.replaceChildren();
    panel.tables.replaceChildren();
    return;
  }
  panel.facts.replaceChildren(...(device === undefined ? [robotHead(robot)] : radioFacts(device)));
  panel.tables.replaceChildren(
    ...(device === undefined ? [] : linkTable(device, view)),
    ...(robot === undefined ? [] : [el("h2", { class: "over" }, `Topics of ${robot.name}`), topicTable(robot)]),
  );
  if (panel.actionsOf !== selected) {
    panel.actionsOf = selected;
    panel.buttons.replaceChildren(...(device === undefined ? [] : actionButtons(device, context.meta, context.source)));
  }
}

const robotHead = (robot) => el("div", { class: "details-head" }, el("h2", {}, robot.name), el("span", { class: "health", "data-health": robot.health }, healthMark(robot.health)));

function radioFacts(device) {
  const raw = device.raw;
  const parts = [el("div", { class: "details-head" }, el("h2", {}, device.name), el("span", { class: "health", "data-health": device.health }, healthMark(device.health)))];
  if (device.reason) parts.push(el("p", { class: "muted" }, `${device.reason}; last seen ${isKnown(device.age_s) ? `${duration(device.age_s)} ago` : "never"}`));
  const radio = device.radios[0] ?? {};
  parts.push(el("dl", { class: "facts" },
    fact("role", device.role), fact("state", device.state ?? MISSING), fact("address", raw.address ?? MISSING), fact("hops", isKnown(device.hops) ? String(device.hops) : MISSING),
    fact("path", percent(device.quality)), fact("via", device.via ?? MISSING), fact("channel", raw.channels?.join(", ") ?? MISSING), fact("power", isKnown(raw.tx_power_dbm) ? `${raw.tx_power_dbm} dBm` : MISSING),
    fact("noise", isKnown(radio.noise_dbm) ? `${radio.noise_dbm} dBm` : MISSING), fact("busy", percent(radio.busy_ratio), (radio.busy_ratio ?? 0) > 0.8), fact("queue", isKnown(radio.queue_packets) ? String(radio.queue_packets) : MISSING, (radio.queue_packets ?? 0) > 100), fact("temp.", isKnown(radio.temperature_c) ? `${Math.round(radio.temperature_c)} °C` : MISSING),
    fact("up", duration(raw.uptime_s)), fact("load", percent(raw.load)), fact("release", raw.version ?? MISSING), fact("config", isKnown(raw.drift) ? (raw.drift.length === 0 ? "same" : "differs") : MISSING, (raw.drift?.length ?? 0) > 0),
  ));
  return parts;
}

function linkTable(device, view) {
  const own = [...view.linksOf.get(device.name)];
  if (own.length === 0) return [];
  const snr = (way) => (way === null ? "none" : isKnown(way.snr_db) ? `${Math.round(way.snr_db)}` : isKnown(way.signal_dbm) ? `${way.signal_dbm} dBm` : MISSING);
  const cell = (text) => el("td", { class: `number${text === MISSING ? " is-missing" : ""}` }, text);
  const rows = own.sort((x, y) => (y.snr_db ?? y.quality ?? 0) - (x.snr_db ?? x.quality ?? 0)).map((link) => {
    const [hears, isHeard] = link.b === device.name ? [link.forward, link.back] : [link.back, link.forward];
    return el("tr", {}, el("td", { class: "name" }, link.a === device.name ? link.b : link.a), el("td", {}, el("span", { class: "bar", "data-class": link.class, title: link.class }, CLASS_MARKS[link.class]), link.isOneWay ? " one-way" : link.isStale ? ` ${duration(link.age_s)}` : ""), cell(snr(hears)), cell(snr(isHeard)), cell(hears?.mcs ?? MISSING), cell(percent(link.quality)));
  });
  const head = (text, isNumber) => el("th", { scope: "col", class: isNumber ? "number" : null }, text);
  return [el("h2", { class: "over" }, "Links, SNR in dB"), el("table", {}, el("thead", {}, el("tr", {}, head("Neighbor"), head("Class"), head("hears", true), head("heard", true), head("MCS", true), head("Quality", true))), el("tbody", {}, ...rows))];
}

function topicTable(robot) {
  const topics = robot.raw.topics;
  if (topics === null || topics === undefined) return el("p", { class: "empty" }, "Topics: unknown, the daemon did not answer.");
  const head = (text, isNumber) => el("th", { scope: "col", class: isNumber ? "number" : null }, text);
  const cell = (text) => el("td", { class: `number${text === MISSING ? " is-missing" : ""}` }, text);
  return el("table", {}, el("thead", {}, el("tr", {}, head("Topic"), head("P", true), head("sent", true), head("received", true), head(""))), el("tbody", {}, ...topics.map((topic) => el("tr", {},
    el("td", { class: "name", title: topic.name }, topic.name), cell(isKnown(topic.priority) ? String(topic.priority) : MISSING), cell(duration(topic.sent_ago_s)), cell(duration(topic.received_ago_s)), el("td", {}, topic.trouble ?? "")))));
}
