// Rollouts side by side, depth by depth, and beside them what really happened once it has.

import { bitmap } from "./api.js";
import { calm, colour, h, number, put } from "./dom.js";
import { coloursOf } from "./palette.js";
import { box, difference, present } from "./scene.js";

const FRAME_MS = 220;

export class Compare {
  constructor(signal) {
    this.tiles = [];
    this.depth = 1;
    this.horizon = 1;
    this.real = new Map();
    this.grid = h("div", { className: "rollouts" });
    this.slider = h("input", { type: "range", min: 1, max: 1, value: 1, "aria-label": "Step ahead", oninput: () => (this.stop(), this.show(Number(this.slider.value))) });
    this.play = h("button", { type: "button", "aria-pressed": "false", onclick: () => (this.timer ? this.stop() : this.start()) }, "Play");
    this.where = h("output", { "aria-live": "off" });
    this.boxes = h("input", { type: "checkbox", checked: true, onchange: () => this.show(this.depth) });
    this.summary = h("p", { className: "soft", role: "status" });
    this.element = h(
      "div",
      { className: "stack", hidden: true },
      h("div", { className: "row player" }, this.play, this.slider, this.where, h("label", { className: "check" }, this.boxes, " Boxes")),
      this.grid,
      this.summary,
    );
    signal.addEventListener("abort", () => this.stop());
  }

  /** Begins with the rollouts of some belief. */
  begin(atStep, horizon, names) {
    Object.assign(this, { atStep, horizon, tiles: [] });
    this.real.clear();
    this.grid.replaceChildren();
    this.happened = this.tile("What happened", true);
    names.forEach((name) => this.tile(name));
    this.slider.max = horizon;
    this.element.hidden = false;
    put(this.summary, "");
    this.show(1);
  }

  tile(name, real = false) {
    const tile = { name, real, frames: new Map(), errors: new Map() };
    tile.canvas = h("canvas", { width: 192, height: 192, role: "img", "aria-label": name });
    tile.cost = h("span", { className: "badge", hidden: true });
    tile.error = h("span", { className: "soft" });
    tile.element = h("figure", { className: real ? "rollout real" : "rollout" }, tile.canvas, h("figcaption", {}, h("strong", {}, name), tile.cost, tile.error));
    this.grid.append(tile.element);
    if (!real) this.tiles.push(tile);
    return tile;
  }

  /** Adds a chunk of a rollout; its candidates begin with tile `from`. */
  async chunk(chunk, from = 0) {
    const output = (name) => chunk.outputs.find((value) => value.output === name);
    const pictures = await Promise.all(output("OUTPUT_FRAME").images.png.map(bitmap));
    const tracks = output("OUTPUT_OBJECTS")?.tracks;
    pictures.forEach((picture, at) => {
      const depths = chunk.depths.length;
      const tile = this.tiles[from + chunk.first_candidate + Math.floor(at / depths)];
      const depth = chunk.depths[at % depths];
      tile.frames.set(depth, { picture, objects: tracks ? objects(tracks, at, pictures.length) : [] });
      if (depth === this.depth) this.draw(tile);
      this.measure(tile, depth);
    });
  }

  costs(costs, best) {
    this.tiles.slice(0, costs.length).forEach((tile, at) => {
      tile.cost.hidden = false;
      put(tile.cost, `cost ${number(costs[at], 3)}${at === best ? " · best" : ""}`);
      tile.cost.classList.toggle("good", at === best);
    });
  }

  /** Something was observed; it is kept if it is one of the steps that were imagined. */
  observed(event, pictures) {
    const depth = event.step - this.atStep;
    if (this.element.hidden || depth < 1 || depth > this.horizon || !pictures.camera) return;
    this.real.set(depth, event.action);
    this.happened.frames.set(depth, { picture: pictures.camera, objects: event.objects });
    this.tiles.forEach((tile) => this.measure(tile, depth));
    if (depth === this.depth) this.draw(this.happened);
    this.sum();
  }

  /** The actions that were really done, as far as they are known without a gap. */
  doneActions() {
    const actions = [];
    while (this.real.has(actions.length + 1)) actions.push(this.real.get(actions.length + 1));
    return actions;
  }

  measure(tile, depth) {
    const [imagined, real] = [tile.frames.get(depth), this.happened.frames.get(depth)];
    if (!imagined || !real || imagined.picture.width !== real.picture.width) return;
    tile.errors.set(depth, difference(imagined.picture, real.picture));
    put(tile.error, `differs by ${number(mean(tile.errors), 3)}`);
  }

  sum() {
    const compared = this.tiles.filter((tile) => tile.errors.size);
    if (!compared.length) return;
    const nearest = compared.reduce((best, tile) => (mean(tile.errors) < mean(best.errors) ? tile : best));
    const steps = this.happened.frames.size;
    const all = steps === this.horizon;
    put(this.summary, `${all ? "All" : `${steps} of`} ${this.horizon} imagined steps have happened. Nearest to it: ${nearest.name} (root mean squared difference ${number(mean(nearest.errors), 3)}, colours from 0 to 1).`);
  }

  show(depth) {
    this.depth = depth;
    this.slider.value = depth;
    put(this.where, `+${depth} of ${this.horizon}`);
    [this.happened, ...this.tiles].forEach((tile) => tile && this.draw(tile));
  }

  draw({ canvas, frames, real }) {
    const pen = canvas.getContext("2d");
    const frame = frames.get(this.depth);
    pen.imageSmoothingEnabled = false;
    pen.fillStyle = colour("--well");
    pen.fillRect(0, 0, canvas.width, canvas.height);
    if (!frame) {
      pen.fillStyle = colour("--soft");
      pen.font = "13px ui-sans-serif, system-ui, sans-serif";
      pen.textAlign = "center";
      return pen.fillText(real ? "not yet" : "…", canvas.width / 2, canvas.height / 2);
    }
    pen.drawImage(frame.picture, 0, 0, canvas.width, canvas.height);
    pen.lineWidth = 1.5;
    if (!this.boxes.checked) return;
    const there = present(frame.objects);
    const colours = coloursOf(there.map((object) => object.id));
    for (const object of there) box(pen, object, colours.get(object.id), { side: canvas.width, line: 1.5 });
  }

  start() {
    this.timer = setInterval(() => this.show((this.depth % this.horizon) + 1), FRAME_MS);
    this.told();
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.told();
  }

  told() {
    put(this.play, this.timer ? "Pause" : "Play");
    this.play.setAttribute("aria-pressed", String(Boolean(this.timer)));
  }

  /** Plays by itself, unless the person wants nothing to move. */
  autoplay() {
    if (!calm() && !this.timer) this.start();
  }
}

const mean = (errors) => [...errors.values()].reduce((sum, error) => sum + error, 0) / errors.size;

/** The objects of one row of a table that comes as tensors. */
function objects({ ids, values }, row, rows) {
  const decode = (tensor) => Uint8Array.from(atob(tensor.data), (letter) => letter.charCodeAt(0)).buffer;
  const all = new BigInt64Array(decode(ids));
  const numbers = new Float32Array(decode(values));
  const slots = all.length / rows;
  const found = [];
  for (let at = row * slots; at < (row + 1) * slots; at++) {
    if (all[at] < 0n) continue;
    const [presence, x, y, width, height, depth] = numbers.slice(at * 6, at * 6 + 6);
    found.push({ id: Number(all[at]), presence, x, y, width, height, depth });
  }
  return found;
}
