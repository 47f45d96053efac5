// What meshctl offers for a device, behind the confirmation that the command line asks for: the page shows what will
// happen, and the operator types the device's name.

import { byId, el } from "./dom.js";

const POLL_MS = 700;

export function actionButtons(device, meta, source) {
  if (!meta.actions || device.role === undefined) return [];
  const run = (action) => () => openAction(action, device, source);
  const buttons = [
    el("button", { type: "button", onclick: run("provision") }, "Plan and provision…"),
    el("button", { type: "button", onclick: run("reboot") }, "Reboot…"),
  ];
  if (device.role === "beacon") {
    const isDeployed = device.state === "deployed";
    buttons.push(el("button", { type: "button", onclick: run(isDeployed ? "carried" : "deployed") }, isDeployed ? "Mark as carried…" : "Mark as deployed…"));
  }
  return buttons;
}

const TITLES = { provision: "Plan and provision", reboot: "Reboot", deployed: "Mark as deployed", carried: "Mark as carried" };

async function openAction(action, device, source) {
  const dialog = byId("action");
  const output = el("pre", { tabindex: "0" }, "Preparing…");
  const question = el("div", {});
  dialog.replaceChildren(el("h2", {}, `${TITLES[action]}: ${device.name}`), output, question, el("div", { class: "buttons" }, el("button", { type: "button", onclick: () => dialog.close() }, "Close")));
  dialog.showModal();
  try {
    const prepared = await finished(await source.post(`api/actions/${action}`, { device: device.name }), source, output);
    if (!prepared.is_confirmable) return;
    const typed = el("input", { id: "typed", autocomplete: "off", autocapitalize: "off", spellcheck: "false" });
    const send = el("button", { type: "button", disabled: true }, TITLES[action]);
    typed.addEventListener("input", () => { send.disabled = typed.value !== device.name; });
    send.addEventListener("click", async () => {
      send.disabled = true;
      try {
        await finished(await source.post("api/actions/confirm", { id: prepared.id, confirmation: typed.value }), source, output);
        question.replaceChildren();
      } catch (error) { output.textContent += `\n${error.message}`; }
    });
    question.replaceChildren(el("label", { for: "typed" }, `Type ${device.name} to confirm`), typed, el("div", { class: "buttons" }, send));
    typed.focus();
  } catch (error) {
    output.textContent = error.message;
  }
}

// Follow a job until it ends; shows what it prints.
async function finished(job, source, output) {
  let now = job;
  for (;;) {
    output.textContent = now.output === "" ? "Working…" : now.output;
    output.scrollTop = output.scrollHeight;
    if (now.exit_code !== null) return now;
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    now = await source.post("api/actions/job", { id: now.id });
  }
}

const SILENCE_S = [["1 hour", 3600], ["4 hours", 14400], ["1 day", 86400], ["until it is ended", null]];

// Ask for a reason and a time; `send(reason, for_s)` silences.
export function openSilence(alarm, send) {
  const dialog = byId("action");
  const reason = el("input", { id: "reason", maxlength: "200", autocomplete: "off" });
  const time = el("select", { id: "silence-time" }, ...SILENCE_S.map(([text], index) => el("option", { value: index }, text)));
  const problem = el("p", { role: "alert" });
  const button = el("button", { type: "button", disabled: true }, "Silence");
  reason.addEventListener("input", () => { button.disabled = reason.value.trim() === ""; });
  button.addEventListener("click", async () => {
    button.disabled = true;
    try {
      await send(reason.value, SILENCE_S[Number(time.value)][1]);
      dialog.close();
    } catch (error) {
      problem.textContent = error.message;
      button.disabled = false;
    }
  });
  dialog.replaceChildren(el("h2", {}, `Silence ${alarm.code} of ${alarm.device === "" ? "the fleet" : alarm.device}`), el("label", { for: "reason" }, "Reason"), reason, el("label", { for: "silence-time" }, "For"), time, problem, el("div", { class: "buttons" }, button, el("button", { type: "button", onclick: () => dialog.close() }, "Close")));
  dialog.showModal();
  reason.focus();
}
