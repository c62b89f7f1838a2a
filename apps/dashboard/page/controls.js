// The controls, from the table in the server's `hello`. Rule: this module knows a control's kind, not its effect. A
// control that needs a new run says so before its use. A refusal is shown beside its control.

import { element, isNumber, setText, words } from "./text.js";

const KILLS = "kill";
const SLIDER_STEPS = 200;
const AHEAD_MS = 700;

export class Controls {
  // send(name, value) sends the value of a control; restart(changes) requests a new run with all changes.
  // homes: {live, restart, actions}, the elements that contain the controls.
  constructor(homes, send, restart) {
    this.homes = homes;
    this.send = send;
    this.restart = restart;
    this.table = new Map();
  }

  // Replaces all controls. If a control has the focus, the new control of the same name gets it.
  build(table) {
    const focused = document.activeElement?.closest("[data-control]")?.dataset.control;
    this.table = new Map(table.map((control) => [control.name, { ...control, usedAt: -Infinity }]));
    for (const home of Object.values(this.homes)) home.replaceChildren();
    for (const control of this.table.values()) {
      const made = this.#make(control);
      if (made) this.#home(control).append(made);
    }
    const restarts = this.homes.restart.children.length > 0;
    this.homes.restart.closest("section").hidden = !restarts;
    this.applies = restarts ? this.#applies() : null;
    this.applies?.show();
    if (focused) document.querySelector(`[data-control=${CSS.escape(focused)}] :is(select, input, button)`)?.focus();
  }

  // Makes one bar for all pending choices: their text, a button for the restart, and a button that discards them.
  #applies() {
    const apply = element("button", { type: "button", class: "primary", "data-action": "apply", text: "Apply and restart" });
    const discard = element("button", { type: "button", text: "Discard" });
    const text = element("span", { class: "hint", role: "status" });
    const problem = element("p", { class: "problem", role: "alert", hidden: true });
    apply.addEventListener("click", () => {
      for (const [name] of this.#pending()) this.refused(name, "");
      this.refused("restart", "");
      if (this.restart(Object.fromEntries(this.#pending()))) setText(text, "asked for; the run ends its frames in flight");
    });
    discard.addEventListener("click", () => {
      for (const [name] of this.#pending()) this.table.get(name).show(this.table.get(name).value);
    });
    this.table.set("restart", { name: "restart", problem });
    this.homes.restart.append(element("div", { class: "pair apply" }, apply, discard, text), problem);
    const show = () => {
      const pending = this.#pending();
      apply.disabled = discard.disabled = pending.length === 0;
      const told = pending.map(([name, value]) => `${words(name)} ${words(value)}`).join(", ");
      setText(text, told || "nothing chosen that is not in force");
    };
    return { show };
  }

  // Returns [name, value] of each choice that is not in force.
  #pending() {
    const chosen = [...this.table.values()].filter((control) => control.isPending);
    return chosen.map((control) => [control.name, control.field.value]);
  }

  #home(control) {
    if (control.kind === "action" && control.live) return this.homes.actions;
    return control.live ? this.homes.live : this.homes.restart;
  }

  use(name, value = null) {
    const control = this.table.get(name);
    if (!control || control.why_not) return;
    this.refused(name, "");
    this.send(name, value);
    if (control.kind !== "number") return;
    control.usedAt = performance.now();
    this.#inForce(control, value);
  }

  // Uses the control with `factor` times its present value, kept within its range.
  scale(name, factor) {
    const control = this.table.get(name);
    if (!control) return;
    const value = (isNumber(control.value) ? control.value : 1) * factor;
    this.use(name, Math.min(Math.max(value, control.min ?? -Infinity), control.max ?? Infinity));
  }

  // Shows the values in force, by name. A number that the person has just moved is skipped: the page is ahead of the
  // server.
  config(values) {
    for (const [name, value] of Object.entries(values ?? {})) {
      const control = this.table.get(name);
      if (control && !(performance.now() - control.usedAt < AHEAD_MS)) this.#inForce(control, value);
    }
  }

  // A choice that the person has not applied yet stays chosen.
  #inForce(control, value) {
    control.value = value;
    if (control.isPending) control.compare();
    else control.show?.(value);
  }

  refused(name, why) {
    const control = this.table.get(name);
    if (!control?.problem) return false;
    setText(control.problem, why ? `refused: ${why}` : "");
    control.problem.hidden = !why;
    control.field?.setAttribute("aria-invalid", why ? "true" : "false");
    if (why) control.usedAt = -Infinity;
    if (why) control.show?.(control.value);
    return true;
  }

  #make(control) {
    const makers = {
      choice: () => (this.#actsAtOnce(control) ? this.#buttons(control) : this.#list(control)),
      number: () => this.#number(control),
      action: () => this.#action(control),
      drag: () => this.#drag(control),
    };
    const made = makers[control.kind]?.();
    if (made && control.why_not) made.classList.add("off");
    return made;
  }

  // A choice without a present value, such as a unit to kill, is an action: it gets a button for each value.
  #actsAtOnce(control) {
    return control.live && (control.value === null || control.value === undefined);
  }

  #shell(control, ...children) {
    const id = `control-${control.name}`;
    control.problem = element("p", { class: "problem", id: `${id}-problem`, role: "alert", hidden: true });
    const why = control.why_not ? element("p", { class: "hint", text: `not now: ${control.why_not}` }) : "";
    return element("div", { class: "control", "data-control": control.name }, ...children, why, control.problem);
  }

  #label(control) {
    const text = words(control.name);
    return text[0].toUpperCase() + text.slice(1);
  }

  #list(control) {
    const id = `control-${control.name}`;
    const select = element(
      "select",
      { id, disabled: Boolean(control.why_not), "aria-describedby": `${id}-problem` },
      ...(control.choices ?? []).map((choice) => element("option", { value: String(choice), text: words(String(choice)) })),
    );
    const label = element("label", { for: id, text: this.#label(control) });
    control.field = select;
    const chosen = () => (control.choices ?? []).find((choice) => String(choice) === select.value);
    if (control.live) {
      select.addEventListener("change", () => this.use(control.name, chosen()));
      control.show = (value) => this.#select(select, value);
      control.show(control.value);
      return this.#shell(control, label, select);
    }
    control.compare = () => {
      control.isPending = !select.disabled && select.value !== String(control.value);
      this.applies?.show();
    };
    select.addEventListener("change", control.compare);
    control.show = (value) => {
      this.#select(select, value);
      control.compare();
    };
    control.show(control.value);
    return this.#shell(control, label, select);
  }

  // A value in force that is no choice, because the command line set it, is also listed.
  #select(select, value) {
    const text = String(value);
    if (value !== null && value !== undefined && ![...select.options].some((option) => option.value === text)) {
      select.append(element("option", { value: text, text: `${words(text)} (as started)`, disabled: true }));
    }
    select.value = text;
  }

  #buttons(control) {
    const buttons = (control.choices ?? []).map((choice) => {
      const verb = control.name === KILLS ? "Kill" : this.#label(control);
      const button = element("button", {
        type: "button",
        class: control.name === KILLS ? "danger" : null,
        "data-choice": choice,
        disabled: Boolean(control.why_not),
        text: `${verb} ${choice}`,
      });
      button.addEventListener("click", () => this.use(control.name, choice));
      return button;
    });
    const group = element("div", { class: "buttons", role: "group", "aria-label": this.#label(control) }, ...buttons);
    return this.#shell(control, element("span", { class: "label", text: this.#label(control) }), group);
  }

  #number(control) {
    const id = `control-${control.name}`;
    const [min, max] = [control.min ?? 0, control.max ?? 1];
    const input = element("input", {
      id,
      type: "range",
      min,
      max,
      step: (max - min) / SLIDER_STEPS,
      disabled: Boolean(control.why_not),
      "aria-describedby": `${id}-problem`,
    });
    const shown = element("output", { for: id });
    control.field = input;
    control.show = (value) => {
      input.value = value;
      setText(shown, isNumber(value) ? Number(value.toPrecision(3)).toString() : "");
    };
    control.show(control.value);
    const event = control.live ? "input" : "change";
    input.addEventListener(event, () => this.use(control.name, Number(input.value)));
    return this.#shell(control, element("label", { for: id }, this.#label(control), " ", shown), input);
  }

  #action(control) {
    const button = element("button", { type: "button", disabled: Boolean(control.why_not), text: this.#label(control) });
    button.dataset.action = control.name;
    button.addEventListener("click", () => this.use(control.name));
    return this.#shell(control, button);
  }

  // The person drags the picture. Here are only a hint and the place for refusals.
  #drag(control) {
    const hint = element("p", { class: "hint", text: `${this.#label(control)}: drag the picture, or use the arrow keys` });
    return this.#shell(control, hint);
  }
}
