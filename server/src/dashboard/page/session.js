// One session, step by step: what the camera sees with what the model makes of it, its objects, and what it costs.

import { ask, file, follow } from "./api.js";
import { Chart } from "./chart.js";
import { empty, failure, h, millis, number, put, short } from "./dom.js";
import { Imagine } from "./imagine.js";
import { coloursOf } from "./palette.js";
import { decode, LAYERS, PRESENT, present, SceneCanvas } from "./scene.js";

const KEPT = 100;
const TRAIL = 30;

export async function session(main, signal, id) {
  main.append(h("p", { className: "soft" }, "Looking for the session …"));
  let about, model;
  try {
    ({ session: about } = await ask(`/v1/sessions/${id}`, { signal }));
    // The session may be on a model that is not served under its name any more; then there is nothing to imagine with.
    model = (await ask(`/v1/models/${encodeURIComponent(about.model)}`, { signal }).catch(() => ({}))).model;
  } catch (problem) {
    if (problem.name === "AbortError") return;
    const again = () => (main.replaceChildren(), session(main, signal, id));
    return main.replaceChildren(problem.status === 404 ? gone() : failure(problem, again));
  }
  if (signal.aborted) return;
  const view = new View(about, model, signal);
  main.replaceChildren(view.element);
  const path = `/v1/sessions/${id}/live?pictures=camera,belief,masks`;
  follow(path, signal, (name, event) => {
    if (name === "belief") view.hear(event);
    if (name === "closed") main.replaceChildren(gone());
  }, (problem) => main.replaceChildren(problem.status === 404 ? gone() : failure(problem)));
}

const gone = () =>
  empty("This session is closed", "It was closed by its client, or lay unused for too long.", h("p", {}, h("a", { href: "#/" }, "All sessions")));

class View {
  constructor(about, model, signal) {
    this.steps = new Map();
    this.trails = new Map();
    this.newest = -1;
    this.of = "camera";
    this.layers = new Set(["agent", "objects", "boxes", "trails"]);
    this.canvas = h("canvas", { className: "scene", role: "img", "aria-label": "Nothing observed yet" });
    this.scene = new SceneCanvas(this.canvas);
    this.wait = h("p", { className: "over" }, about.next_step ? "Drawing the newest step …" : "Waiting for the first observation …");
    this.stepText = h("span", {}, about.next_step ? `step ${about.next_step - 1}` : "no step yet");
    this.rateText = h("span", {}, "");
    this.note = h("span", { className: "badge warn", hidden: true });
    this.surprise = new Chart("Surprise", { series: [["surprise", "--accent"]], format: (nats) => `${number(nats, nats < 10 ? 1 : 0)} nats` });
    this.timing = new Chart("Time of a step", {
      series: [["queue", "--queue"], ["compute", "--observe"], ["encode", "--encode"]],
      format: (micros) => millis(micros),
      stacked: true,
    });
    this.table = new Objects();
    this.imagine = model?.actions.length ? new Imagine(about, model, this, signal) : null;
    this.element = this.layout(about, model);
    this.canvas.addEventListener("click", (event) => {
      const { left, top, width, height } = this.canvas.getBoundingClientRect();
      this.imagine?.aim(((event.clientX - left) / width) * 2 - 1, ((event.clientY - top) / height) * 2 - 1);
    });
    const observer = new ResizeObserver(() => this.draw());
    observer.observe(this.canvas);
    const scheme = matchMedia("(prefers-color-scheme: dark)");
    scheme.addEventListener("change", () => this.redraw(), { signal });
    signal.addEventListener("abort", () => [observer, this.surprise.observer, this.timing.observer].forEach((one) => one.disconnect()));
  }

  layout(about, model) {
    const radio = (value, text) => h("label", {}, h("input", { type: "radio", name: "of", value, checked: value === this.of, onchange: () => ((this.of = value), this.draw()) }), h("span", {}, text));
    const none = { agent: model && (model.agent_slot ?? null) === null, keypoints: model && !model.keypoints };
    const check = ([name, text]) => {
      const change = ({ target }) => {
        this.layers[target.checked ? "add" : "delete"](name);
        this.draw();
      };
      const box = h("input", { type: "checkbox", name, checked: this.layers.has(name) && !none[name], disabled: none[name], onchange: change });
      return h("label", { title: none[name] ? `This model has no ${name}` : "" }, box, h("span", {}, text));
    };
    const picture = h(
      "section",
      { className: "panel stack", "aria-label": "Picture" },
      h("div", { className: "frame" }, this.canvas, this.wait),
      h(
        "div",
        { className: "row controls" },
        h("fieldset", { className: "segments" }, h("legend", { className: "unseen" }, "Picture"), radio("camera", "Camera"), radio("belief", "Belief")),
        h("fieldset", { className: "chips" }, h("legend", { className: "unseen" }, "Overlays"), LAYERS.map(check)),
      ),
    );
    const aside = h(
      "div",
      { className: "stack" },
      h("section", { className: "panel" }, this.table.element),
      h("section", { className: "panel charts one", "aria-label": "Charts" }, this.surprise.element, this.timing.element),
    );
    return h(
      "div",
      { className: "stack" },
      h("p", { className: "crumb" }, h("a", { href: "#/" }, "Sessions")),
      h("h1", {}, about.label || `Session ${short(about.id)}`),
      h("p", { className: "row soft facts-line" }, h("span", { className: "hash", title: about.id }, about.id), h("a", { href: "#/models" }, about.model), this.stepText, this.rateText, this.note),
      h("div", { className: "pair" }, picture, aside),
      this.imagine ? this.imagine.element : h("p", { className: "soft" }, model ? "This model takes no actions, so there is nothing to choose." : "The session's model is not served any more, so nothing can be imagined here."),
      files(about.id),
    );
  }

  async hear(event) {
    const pictures = await decode(event);
    // A session that was rewound begins anew where it was rewound to.
    if (event.step < this.newest - 1) this.forget(event.step);
    else if (event.step < this.newest) return;
    this.newest = event.step;
    this.steps.set(event.step, { event, pictures });
    for (const step of this.steps.keys()) if (step <= event.step - KEPT) this.steps.delete(step);
    for (const { id, presence, x, y } of event.objects) {
      const places = this.trails.get(id) ?? [];
      if (presence > PRESENT && places.at(-1)?.step !== event.step) places.push({ step: event.step, x, y });
      this.trails.set(id, places.filter((place) => place.step > event.step - TRAIL));
    }
    this.wait.hidden = true;
    this.surprise.push(event.step, event.surprise);
    this.timing.push(event.step, event.timing.queue_micros, event.timing.compute_micros, event.timing.encode_micros);
    this.redraw();
    this.imagine?.observed(event, pictures);
  }

  forget(step) {
    for (const known of this.steps.keys()) if (known >= step) this.steps.delete(known);
    this.trails.clear();
  }

  /** Draws at the next frame of the screen, once. */
  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
      this.tell();
    });
  }

  draw() {
    const newest = this.steps.get(this.newest);
    if (!newest) return;
    const { event, pictures } = newest;
    this.scene.draw(event, pictures, { of: this.of, layers: this.layers, trails: this.trails, target: this.imagine?.target });
    if (this.drawn !== event.step) {
      this.drawn = event.step;
      performance.mark("belief drawn", { detail: { step: event.step, at: event.at } });
      if (event.step % 200 === 0) performance.clearMarks("belief drawn");
    }
  }

  tell() {
    const { event } = this.steps.get(this.newest);
    put(this.stepText, `step ${event.step}`);
    const times = [...this.steps.values()].slice(-12).map((step) => step.event);
    const seconds = (times.at(-1).at - times[0].at) / 1000;
    const steps = times.at(-1).step - times[0].step;
    put(this.rateText, seconds > 0 && Date.now() - event.at < 3000 ? `${number(steps / seconds, 1)} Hz` : "");
    this.note.hidden = !event.predicted;
    put(this.note, event.image_skipped ? "image passed over" : "no image: predicted");
    this.table.show(event);
    if (performance.now() - (this.said ?? -9999) > 5000) {
      this.said = performance.now();
      this.canvas.setAttribute("aria-label", `Step ${event.step}: ${present(event.objects).length} objects; they are in the table`);
    }
  }
}

/** The table of objects. */
class Objects {
  constructor() {
    this.body = h("tbody", {});
    this.rows = new Map();
    const columns = ["id", "presence", "x", "y", "width", "height", "depth"];
    this.none = h("p", { className: "soft" }, "No object yet.");
    const table = h("table", { className: "objects" }, h("thead", {}, h("tr", {}, columns.map((name) => h("th", { scope: "col" }, name)))), this.body);
    this.element = h("div", {}, h("h2", {}, "Objects"), h("div", { className: "scroll", tabIndex: 0, role: "region", "aria-label": "Objects" }, table), this.none);
  }

  show(event) {
    const ids = new Set(event.objects.map((object) => object.id));
    for (const [id, { row }] of this.rows) {
      if (!ids.has(id)) {
        row.remove();
        this.rows.delete(id);
      }
    }
    const colours = coloursOf(present(event.objects).map((object) => object.id));
    for (const object of event.objects) {
      if (!this.rows.has(object.id)) this.rows.set(object.id, this.row(object.id));
      const { row, mark, bar, cells } = this.rows.get(object.id);
      // What is not in the picture has no colour there.
      mark.style.background = colours.get(object.id) ?? "none";
      row.classList.toggle("faint", object.presence <= PRESENT);
      bar.value = object.presence;
      bar.title = number(object.presence, 2);
      [object.x, object.y, object.width, object.height, object.depth].forEach((value, at) => put(cells[at], number(value, 2)));
    }
    this.none.hidden = event.objects.length > 0;
  }

  row(id) {
    const mark = h("i", { className: "mark", "aria-hidden": "true" });
    const bar = h("meter", { min: 0, max: 1, "aria-label": `presence of object ${id}` });
    const cells = Array.from({ length: 5 }, () => h("td", {}));
    const row = h("tr", {}, h("th", { scope: "row" }, mark, String(id)), h("td", {}, bar), cells);
    this.body.append(row);
    return { row, mark, bar, cells };
  }
}

/** The same as files, for slides and notebooks. */
function files(id) {
  const names = ["frame.png", "overlay.png", "masks.png", "rollout.png?random=4&overlay=true", "rollout.gif?random=4&overlay=true"];
  const said = h("p", { className: "soft", role: "status" });
  const save = async (name) => {
    put(said, `Making ${name.split("?")[0]} …`);
    try {
      const address = URL.createObjectURL(await file(`/v1/sessions/${id}/${name}`));
      h("a", { href: address, download: name.split("?")[0] }).click();
      setTimeout(() => URL.revokeObjectURL(address), 10000);
      put(said, `${name.split("?")[0]} is saved.`);
    } catch (problem) {
      put(said, problem.message);
    }
  };
  return h(
    "section",
    { className: "panel" },
    h("h2", {}, "As files"),
    h("p", { className: "soft" }, "For slides and notebooks; the API page says what else they can show."),
    h("p", { className: "row" }, names.map((name) => h("button", { type: "button", onclick: () => save(name) }, name.split("?")[0]))),
    said,
  );
}
