// The strip at the top: go or no-go, totals and the clock; notices, and the counts on the tabs.

import { byId, el, setText } from "./dom.js";
import { clockTime, duration, isKnown, percent } from "./format.js";
import { alarmsAt } from "./panels.js";
import { interval_s, now_s, shown_s, state } from "./state.js";

// Data older than this many intervals is late.
const LATE_INTERVALS = 3;

export function count(tab, items) {
  const button = byId(tab);
  let badge = button.querySelector(".count");
  if (items.length === 0) { badge?.remove(); return; }
  if (badge === null) { badge = el("span", { class: "count" }); button.append(badge); }
  badge.dataset.level = items.some((item) => item.level === "error") ? "error" : items.some((item) => item.level === "warning") ? "warning" : "";
  setText(badge, String(items.length));
}

export function showStrip(view) {
  const isOfRobots = isRecordedByRobots(view.frame);
  const verdict = view.frame.verdict ?? (isOfRobots ? contactOf(view) : { go: null, text: "NOT ASSESSED", reasons: [] });
  const box = byId("verdict");
  box.dataset.go = isOfRobots ? "contact" : String(verdict.go);
  const [word, rest] = splitVerdict(verdict);
  setText(box.querySelector(".verdict-mark"), verdict.go === true ? "✓" : verdict.go === false ? "✕" : isOfRobots ? "" : "?");
  const text = box.querySelector(".verdict-text");
  const signature = `${word}|${rest}`;
  if (text.dataset.signature !== signature) {
    text.dataset.signature = signature;
    text.replaceChildren(word, ...(rest === "" ? [] : [" ", el("span", { class: "verdict-sub" }, rest)]));
  }
  setText(byId("fleet"), view.frame.fleet ?? state.meta.fleet);
  const reasons = verdict.reasons ?? [];
  setText(byId("reasons"), reasons.length > 0 ? reasons.join(" · ") : verdict.go === true ? "All checks pass." : "");
  byId("reasons").title = reasons.join("\n");
  const total = (term, ...text) => el("div", {}, el("dt", {}, term), el("dd", {}, ...text));
  const totals = isOfRobots ? totalsOfRobots(view) : totalsOf(view);
  const key = JSON.stringify(totals);
  if (byId("totals").dataset.signature !== key) {
    byId("totals").dataset.signature = key;
    byId("totals").replaceChildren(...totals.map(([term, large, small]) => total(term, large, el("small", {}, small))));
  }
  showClock();
  document.title = `${verdict.text} · ${view.frame.fleet ?? "meshctl"}`;
}

function totalsOf(view) {
  const nodes = [...view.devices.values()].filter((device) => device.health !== "off" && device.health !== "unknown");
  const answering = (list) => list.filter((one) => one.health === "ok" || one.health === "degraded").length;
  const robots = view.robots.filter((robot) => robot.health !== "off");
  const open = alarmsAt(state.alarms, shown_s()).open;
  const level = (name) => open.filter((alarm) => alarm.level === name).length;
  const airtime = view.frame.airtime;
  return [
    ["radios", `${answering(nodes)}`, `/${nodes.length}`], ["robots", robots.length === 0 ? "–" : `${answering(robots)}`, robots.length === 0 ? "" : `/${robots.length}`],
    ["errors", `▲${level("error")}`, ""], ["warnings", `◆${level("warning")}`, ""],
    ["watching", airtime && isKnown(airtime.share) ? percentOf(airtime.share) : "–", " air"],
  ];
}

// Recordings of robots alone have no checks and no alarms: no monitor watched.
const isRecordedByRobots = (frame) => state.meta.mode === "replay" && !frame.verdict && !frame.airtime;

function totalsOfRobots(view) {
  const recording = view.robots.filter((robot) => robot.raw.recorded === true).length;
  return [["robots recorded", `${recording}`, `/${view.robots.length}`]];
}

// In place of go or no-go: how many robots the base had at that moment, or had each other.
function contactOf(view) {
  const base = view.robots.find((robot) => robot.isBase);
  const linked = new Set(view.links.flatMap((link) => [link.a, link.b]));
  const others = view.robots.filter((robot) => robot !== base);
  const reached = others.filter((robot) => (base === undefined ? linked.has(robot.name) : isKnown(robot.hops)));
  const missing = others.filter((robot) => !reached.includes(robot)).map((robot) => robot.name).sort();
  const where = base === undefined ? "in contact" : "with the base";
  const out = missing.length === 0 ? [] : [`Out of ${base === undefined ? "contact" : "its reach"}: ${missing.join(", ")}`];
  return { go: null, text: `${reached.length}/${others.length} ${where}`, reasons: [...out, "As the robots recorded it; radios were not watched, so there is no go or no-go"] };
}

const percentOf = (share) => (share < 0.0995 ? `${(share * 100).toFixed(1)} %` : percent(share));

function splitVerdict(verdict) {
  const found = /^([A-Z-]+(?: ASSESSED)?|\d+\/\d+)\s*(.*)$/.exec(verdict.text ?? "");
  return found === null ? [verdict.text ?? "?", ""] : [found[1], found[2]];
}

export function showClock() {
  if (state.frame === null) return;
  const isLive = state.at_s === null;
  const age_s = Math.max(0, now_s() - state.frame.time_s);
  setText(byId("clock"), clockTime(isLive ? now_s() : state.at_s));
  const isLate = isLive && age_s > LATE_INTERVALS * interval_s() + (state.frame.took_s ?? 0);
  const back_s = state.at_s === null ? 0 : (state.span?.[1] ?? state.at_s) - state.at_s;
  setText(byId("freshness"), isLive ? `data ${duration(age_s)} old${isLate ? ", late" : ""}` : `data of ${clockTime(state.frame.time_s)}${back_s < 0.05 ? "" : `, −${duration(back_s)}`}`);
  byId("freshness").classList.toggle("is-late", isLate);
  const mode = byId("mode");
  const kind = state.link === "lost" || state.link === "refused" ? "lost" : state.meta.mode === "replay" ? "replay" : isLive ? "live" : "past";
  mode.dataset.state = kind;
  setText(mode, { live: "● live", past: "◀ past", replay: "▶ recording", lost: "✕ no connection" }[kind]);
  byId("live").setAttribute("aria-pressed", String(isLive));
}

export function notice(text) {
  byId("notice").hidden = text === "";
  setText(byId("notice"), text);
}
