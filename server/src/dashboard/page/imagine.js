// Imagine from here: candidates are rolled out from the belief as it is now, scored, and kept to be compared with what
// then really happens. The belief is kept as a session of its own for a while, so that everything starts from the same.

import { actions, ask, floats, lines } from "./api.js";
import { Candidates } from "./candidates.js";
import { Compare } from "./compare.js";
import { h, number, put, short } from "./dom.js";
import { OWN } from "./sessions.js";

const TTL = "600s";

export class Imagine {
  constructor(about, model, view, signal) {
    Object.assign(this, { about, model, view, signal, target: null, kept: null });
    const most = Math.min(model.limits?.max_horizon ?? 30, 40);
    this.length = h("output", {}, "12");
    this.horizon = h("input", { type: "range", min: 1, max: most, value: Math.min(12, most), oninput: () => put(this.length, this.horizon.value) });
    this.subject = h("select", { onchange: () => this.retarget() });
    this.x = h("input", { type: "number", min: -1, max: 1, step: 0.05, value: 0, oninput: () => this.retarget() });
    this.y = h("input", { type: "number", min: -1, max: 1, step: 0.05, value: 0, oninput: () => this.retarget() });
    this.go = h("button", { type: "button", className: "primary", onclick: () => this.run() }, "Imagine");
    this.plan = h("button", { type: "button", disabled: true, onclick: () => this.search() }, "Find a plan");
    this.again = h("button", { type: "button", hidden: true, onclick: () => this.redo() }, "Imagine what was done");
    this.said = h("p", { className: "soft", role: "status" });
    this.compare = new Compare(signal);
    this.candidates = new Candidates(model, () => this.done(), () => {});
    this.subjects([]);
    this.element = this.layout();
    signal.addEventListener("abort", () => this.letGo());
  }

  layout() {
    const field = (text, ...inputs) => h("label", { className: "field" }, h("span", {}, text), ...inputs);
    return h(
      "section",
      { className: "panel stack", "aria-labelledby": "imagine-title" },
      h("h2", { id: "imagine-title" }, "Imagine from here"),
      h("p", { className: "soft" }, "What will happen under these actions, from the belief as it is at this moment? The robot does not move, and the session is left as it is."),
      h(
        "div",
        { className: "pair even" },
        this.candidates.element,
        h(
          "div",
          { className: "stack" },
          h("fieldset", { className: "stack" }, h("legend", {}, "How far"), field("Steps ahead", this.horizon, this.length)),
          h(
            "fieldset",
            { className: "stack" },
            h("legend", {}, "Where to"),
            h("p", { className: "row" }, field("Who", this.subject), field("x", this.x), field("y", this.y)),
            h("p", { className: "soft" }, "With a target, candidates get costs: the distance to it at the last step. A click on the picture sets it; x goes right and y down, from -1 to 1."),
          ),
        ),
      ),
      h("p", { className: "row" }, this.go, this.plan, this.again),
      this.said,
      this.compare.element,
    );
  }

  /** A point on the picture was chosen. */
  aim(x, y) {
    this.x.value = x.toFixed(2);
    this.y.value = y.toFixed(2);
    if (!this.subject.value) this.subject.selectedIndex = Math.min(1, this.subject.options.length - 1);
    this.retarget();
  }

  retarget() {
    const who = this.subject.value;
    this.target = who ? { x: Number(this.x.value), y: Number(this.y.value) } : null;
    this.plan.disabled = !who;
    this.view.draw();
  }

  /** Who can be sent somewhere: the objects that are there, and the agent. */
  subjects(objects) {
    const names = [["", "nobody"], ...objects.map(({ id }) => [`object ${id}`, `object ${id}`])];
    if ((this.model.agent_slot ?? null) !== null) names.push(["agent", "the agent"]);
    const told = names.map(([value]) => value).join();
    if (told === this.told) return;
    this.told = told;
    const before = this.subject.value;
    this.subject.replaceChildren(...names.map(([value, text]) => h("option", { value }, text)));
    this.subject.value = names.some(([value]) => value === before) ? before : "";
    if (this.subject.value !== before) this.retarget();
  }

  observed(event, pictures) {
    this.subjects(event.objects.filter((object) => object.presence > 0.5));
    this.compare.observed(event, pictures);
    this.again.hidden = !this.kept || this.redone || this.compare.doneActions().length < 1;
    this.again.disabled = this.compare.doneActions().length < Math.min(3, this.compare.horizon);
  }

  /** The actions that were done last, oldest first, as far as the page has seen them. */
  done() {
    const steps = [];
    for (let step = this.view.newest; steps.length < Number(this.horizon.value); step--) {
      const known = this.view.steps.get(step);
      if (!known || step === 0) break;
      steps.unshift(known.event.action);
    }
    return steps;
  }

  costs() {
    if (!this.target) return undefined;
    const who = this.subject.value;
    const subject = who === "agent" ? { agent: true } : { object_id: Number(who.slice(7)) };
    return { terms: [{ name: "target", when: "WHEN_LAST_STEP", to_target: { subject, target: this.target } }] };
  }

  /** Does something that takes a while, and says how it went. */
  async while(doing, work) {
    this.go.disabled = this.plan.disabled = true;
    put(this.said, doing);
    const began = performance.now();
    try {
      put(this.said, `${await work()} It took ${number((performance.now() - began) / 1000, 1)} s.`);
    } catch (problem) {
      if (problem.name === "AbortError") return;
      put(this.said, `That did not work: ${problem.message}.`);
    } finally {
      this.go.disabled = false;
      this.plan.disabled = !this.target;
    }
  }

  /** Keeps the belief as it is now. */
  async keep() {
    this.letGo();
    const { session, snapshot } = await ask(`/v1/sessions/${this.about.id}/snapshot`, { signal: this.signal });
    const step = session.next_step - 1;
    const label = `${OWN}${short(this.about.id)} at ${step}`;
    const kept = await ask("/v1/snapshots", { body: { snapshot, label, ttl: TTL }, signal: this.signal });
    this.kept = kept.session.id;
    return step;
  }

  letGo() {
    // It would be closed anyhow when it has lain unused.
    if (this.kept) ask(`/v1/sessions/${this.kept}`, { method: "DELETE", keepalive: true }).catch(() => {});
    this.kept = null;
  }

  run() {
    return this.while("Imagining …", async () => {
      if (!this.candidates.list.length) throw new Error("there is no candidate yet");
      const horizon = Number(this.horizon.value);
      const sequences = this.candidates.sequences(horizon);
      const step = await this.keep();
      this.redone = false;
      this.compare.begin(step, horizon, this.candidates.names());
      for (const { event, pictures } of this.view.steps.values()) this.compare.observed(event, pictures);
      await this.roll(sequences);
      const costs = this.costs();
      if (costs) {
        const body = { actions: actions(sequences), sampling: { mode: "MODE_MEAN" }, costs };
        const scores = await ask(`/v1/sessions/${this.kept}/scores`, { body, signal: this.signal });
        this.compare.costs(floats(scores.costs), scores.best);
      }
      this.compare.autoplay();
      return `${sequences.length} candidates over ${horizon} steps from step ${step}.`;
    });
  }

  /** Rolls candidates out from the kept belief; the first of them goes to tile `from`. */
  async roll(sequences, from = 0) {
    const body = {
      actions: actions(sequences),
      sampling: { mode: "MODE_MEAN" },
      outputs: { outputs: ["OUTPUT_FRAME", "OUTPUT_OBJECTS"], encoding: "ENCODING_PNG" },
    };
    const chunks = lines(`/v1/sessions/${this.kept}/rollouts`, { method: "POST", body, signal: this.signal });
    for await (const { chunk } of chunks) await this.compare.chunk(chunk, from);
  }

  search() {
    return this.while("Searching for a plan …", async () => {
      const horizon = Number(this.horizon.value);
      const body = {
        horizon,
        costs: this.costs(),
        sampling: { mode: "MODE_MEAN" },
        icem: { cem: { candidates: 16, iterations: 3, elites: 4 } },
        budget_millis: 30000,
      };
      const plan = await ask(`/v1/sessions/${this.about.id}/plans`, { body, signal: this.signal });
      const numbers = floats(plan.actions);
      const width = this.model.actions.length;
      const steps = Array.from({ length: horizon }, (_, step) => [...numbers.slice(step * width, (step + 1) * width)]);
      this.candidates.add(`Plan of cost ${number(plan.cost, 3)}`, steps);
      return `A plan of cost ${number(plan.cost, 3)} after ${plan.candidates} candidates is among the candidates now; Imagine shows it.`;
    });
  }

  /** Imagines the actions that were really done, from where the other rollouts began. */
  redo() {
    return this.while("Imagining what was done …", async () => {
      const done = this.compare.doneActions();
      const from = this.compare.tiles.length;
      this.compare.tile(`As it was done (${done.length})`);
      this.redone = true;
      this.again.hidden = true;
      await this.roll([done], from);
      this.compare.sum();
      return "The actions that were really done are imagined beside the others.";
    });
  }
}
