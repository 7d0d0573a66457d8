// All sessions, with what their cameras see, and how busy the server is.

import { follow } from "./api.js";
import { ago, empty, failure, h, number, put, short, shell } from "./dom.js";
import { Rates } from "./engine.js";

/** Sessions that this page keeps for itself are named like this. */
export const OWN = "imagined from ";

export function sessions(main, signal) {
  const tiles = ["Open sessions", "Observed", "Imagined", "Model busy"].map((name) => {
    const value = h("dd", {}, "–");
    return { value, element: h("div", {}, h("dt", {}, name), value) };
  });
  const place = h("div", {}, h("p", { className: "soft" }, "Looking for sessions …"));
  const more = h("p", { className: "soft", hidden: true });
  main.append(
    h("h1", {}, "Sessions"),
    h("dl", { className: "tiles" }, tiles.map((tile) => tile.element)),
    place,
    more,
  );
  const cards = new Map();
  const grid = h("ul", { className: "cards", "aria-label": "Open sessions" });
  const rates = new Rates();
  let shown = null;

  follow("/v1/live?thumbnails=true", signal, (name, overview) => {
    if (name !== "overview") return;
    const rate = rates.next(overview);
    const open = overview.sessions.filter((session) => !session.label.startsWith(OWN));
    const kept = overview.sessions.length - open.length;
    put(tiles[0].value, number(overview.open_sessions - kept));
    put(tiles[1].value, rate ? `${number(rate.observed, 1)} steps/s` : "–");
    put(tiles[2].value, rate ? `${number(rate.imagined)} row-steps/s` : "–");
    put(tiles[3].value, rate ? `${number(100 * rate.busy)} %` : "–");
    const next = open.length ? grid : none();
    if (shown !== open.length > 0) {
      shown = open.length > 0;
      place.replaceChildren(next);
    }
    const ids = new Set(open.map((session) => session.id));
    for (const [id, card] of cards) {
      if (!ids.has(id)) {
        card.element.remove();
        cards.delete(id);
      }
    }
    for (const session of open) {
      if (!cards.has(session.id)) {
        const card = new Card(session);
        cards.set(session.id, card);
        grid.append(card.element);
      }
      cards.get(session.id).show(session, overview.at);
    }
    const left = overview.open_sessions - overview.sessions.length;
    more.hidden = left <= 0;
    put(more, `${number(left)} more that were used longer ago are not shown.`);
  }, (problem) => place.replaceChildren(failure(problem)));
}

function none() {
  return empty(
    "No session is open",
    "A session is one robot's stream of frames and actions. Open one, and it appears here:",
    shell(`curl -s ${location.origin}/v1/sessions -H 'content-type: application/json' -d '{}'`),
    "Or replay a recorded robot with the command line:",
    shell("id=$(gatsbi --json session new | jq -r .id)\ngatsbi observe --session $id --episode episodes/samples/push1-heldout.parquet"),
  );
}

class Card {
  constructor(session) {
    this.picture = h("img", { alt: "", width: 64, height: 64, hidden: true });
    this.step = h("span", {});
    this.used = h("span", {});
    this.dot = h("i", { className: "dot", "aria-hidden": "true" });
    this.steps = [];
    const name = session.label || short(session.id);
    this.element = h(
      "li",
      {},
      h(
        "a",
        { className: "card", href: `#/sessions/${session.id}` },
        h("span", { className: "thumbnail" }, this.picture, h("span", { className: "soft" }, "No picture yet")),
        h("strong", {}, this.dot, name),
        h("span", { className: "soft" }, session.model),
        h("span", { className: "row soft" }, this.step, this.used),
      ),
    );
  }

  show({ next_step, idle_millis, thumbnail }, at) {
    if (thumbnail) {
      this.picture.src = `data:image/png;base64,${thumbnail}`;
      this.picture.hidden = false;
    }
    this.steps.push({ at, next_step });
    this.steps = this.steps.filter((step) => at - step.at < 4000);
    const [first, last] = [this.steps[0], this.steps.at(-1)];
    const rate = ((last.next_step - first.next_step) / (last.at - first.at)) * 1000;
    const live = rate > 0;
    this.dot.dataset.live = live;
    put(this.step, next_step ? `step ${next_step - 1}` : "nothing observed");
    put(this.used, live ? `${number(rate, 1)} Hz` : ago(idle_millis));
  }
}
