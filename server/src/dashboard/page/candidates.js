// Candidates: action sequences to imagine. Held ones come from sliders, others are drawn, were done, or lie in a file.

import { h, number, put } from "./dom.js";

const MOST = 16;

export class Candidates {
  /** `done(horizon)` gives the actions that were done last, `changed()` is called when the list changes. */
  constructor(model, done, changed) {
    Object.assign(this, { model, done, changed, list: [], made: 0 });
    this.rows = h("ul", { className: "candidates", "aria-label": "Candidates" });
    this.said = h("p", { className: "soft", role: "status" });
    const add = (text, onclick) => h("button", { type: "button", onclick }, text);
    const choose = h("input", { type: "file", accept: ".json,.csv", className: "unseen", "aria-label": "Candidates from a file", onchange: () => this.load(choose) });
    this.element = h(
      "fieldset",
      { className: "stack" },
      h("legend", {}, "Candidates"),
      this.rows,
      h(
        "p",
        { className: "row" },
        add("Hold an action", () => this.hold()),
        add("Draw 3 at random", () => this.draw(3)),
        add("Repeat what was done", () => this.repeat()),
        h("label", { className: "button" }, "From a file", choose),
      ),
      this.said,
    );
    this.hold("Rest");
    this.draw(2);
  }

  /** Sequences `[N][H][A]` of the same length. */
  sequences(horizon) {
    return this.list.map(({ at }) => Array.from({ length: horizon }, (_, step) => at(step)));
  }

  names() {
    return this.list.map(({ name }) => name);
  }

  /** Adds a sequence; after its end its last action goes on. */
  add(name, steps) {
    return this.put({ name, at: (step) => steps[Math.min(step, steps.length - 1)] });
  }

  put(candidate, details) {
    if (this.list.length >= MOST) return this.say(`There are ${MOST} candidates already, which is what fits side by side.`);
    this.list.push(candidate);
    const remove = () => {
      this.list.splice(this.list.indexOf(candidate), 1);
      row.remove();
      this.changed();
    };
    const name = h("span", { className: "name" }, candidate.name);
    const button = h("button", { type: "button", className: "quiet", "aria-label": `Remove ${candidate.name}`, onclick: remove }, "✕");
    const row = h("li", {}, details ? h("details", { open: details.open }, h("summary", {}, name), details.body) : name, button);
    this.rows.append(row);
    this.changed();
  }

  hold(name = `Held ${++this.made}`) {
    const action = this.model.actions.map(({ offset }) => offset);
    const slider = ({ name, unit, offset, scale }, at) => {
      const value = h("output", {}, number(offset, 2));
      const input = h("input", {
        type: "range",
        min: offset - 2 * scale,
        max: offset + 2 * scale,
        step: scale / 25,
        value: offset,
        oninput: () => {
          action[at] = Number(input.value);
          put(value, number(action[at], 2));
          this.changed();
        },
      });
      return h("label", { className: "slider" }, h("span", {}, name, h("small", {}, ` ${unit}`)), input, value);
    };
    const body = h("div", { className: "sliders" }, this.model.actions.map(slider));
    this.put({ name, at: () => [...action] }, { body, open: name !== "Rest" });
  }

  draw(count) {
    for (let i = 0; i < count; i++) {
      const steps = [];
      const one = () => this.model.actions.map(({ offset, scale }) => offset + scale * (4 * Math.random() - 2));
      this.put({ name: `Random ${++this.made}`, at: (step) => (steps[step] ??= one()) });
    }
  }

  repeat() {
    const actions = this.done();
    if (!actions.length) return this.say("No action was seen yet: this page knows those that came while it was open.");
    this.say("");
    this.add(`As the last ${actions.length} steps`, actions);
  }

  async load(choose) {
    const file = choose.files[0];
    choose.value = "";
    if (!file) return;
    try {
      const sequences = read(await file.text(), file.name, this.model.actions.length);
      sequences.forEach((steps, at) => this.add(sequences.length > 1 ? `${file.name} ${at + 1}` : file.name, steps));
      this.say("");
    } catch (error) {
      this.say(`${file.name}: ${error.message}`);
    }
  }

  say(text) {
    put(this.said, text);
  }
}

/** Sequences from JSON, `[H][A]` or `[N][H][A]`, or CSV: a step a line, an empty line between two sequences. */
function read(text, name, width) {
  let sequences;
  if (name.endsWith(".json")) {
    const value = JSON.parse(text);
    sequences = Array.isArray(value?.[0]?.[0]) ? value : [value];
  } else {
    sequences = text.trim().split(/\n\s*\n/).map((part) => part.trim().split("\n").map((line) => line.split(",").map(Number)));
  }
  for (const steps of sequences) {
    if (!Array.isArray(steps) || !steps.length) throw new Error("expected lists of actions");
    steps.forEach((action, step) => {
      const good = Array.isArray(action) && action.length === width && action.every(Number.isFinite);
      if (!good) throw new Error(`action ${step + 1} is ${JSON.stringify(action)}, expected ${width} numbers`);
    });
  }
  return sequences;
}
