// How busy the engine is: what it computed between two overviews, and what waits.

import { follow } from "./api.js";
import { Chart } from "./chart.js";
import { failure, h, millis, number, put } from "./dom.js";

/** What happened between two overviews, per second. */
export class Rates {
  next(overview) {
    const before = this.before;
    // A server that was started anew counts from nothing again.
    this.before = overview;
    if (!before || overview.engine.ticks < before.engine.ticks) return null;
    const seconds = (overview.at - before.at) / 1000;
    if (seconds <= 0) return null;
    const delta = (kind, what) => overview.engine[kind][what] - before.engine[kind][what];
    const fill = (kind) => (delta(kind, "lanes") ? delta(kind, "rows") / delta(kind, "lanes") : null);
    return {
      ticks: (overview.engine.ticks - before.engine.ticks) / seconds,
      observed: delta("observe", "rows") / seconds,
      imagined: delta("imagine", "rows") / seconds,
      observeFill: fill("observe"),
      imagineFill: fill("imagine"),
      busy: (delta("observe", "micros") + delta("imagine", "micros")) / 1e6 / seconds,
      refused: (overview.engine.refused - before.engine.refused) / seconds,
    };
  }
}

export function engine(main, signal) {
  const percent = (value) => (Number.isFinite(value) ? `${number(100 * value)} %` : "–");
  const plain = (value) => number(value, value < 10 ? 1 : 0);
  const chart = (title, series, format, more) => new Chart(title, { series, format, unit: "time", ...more });
  const charts = {
    steps: chart("Steps a second", [["observed", "--observe"], ["imagined", "--imagine"]], plain, { stacked: true }),
    busy: chart("Model busy", [["busy", "--accent"]], percent, { floor: 1 }),
    fill: chart("Batch fill", [["observed", "--observe"], ["imagined", "--imagine"]], percent, { floor: 1 }),
    ticks: chart("Ticks a second", [["ticks", "--accent"]], plain),
    queue: chart("Waiting", [["observations", "--observe"], ["rows of rollouts", "--imagine"]], plain, { stacked: true, floor: 4 }),
    refused: chart("Refused a second", [["refused", "--bad"]], plain, { floor: 1 }),
  };
  const cells = {};
  const row = (name, ...keys) => h("tr", {}, h("th", { scope: "row" }, name), keys.map((key) => (cells[key] = h("td", {}, "–"))));
  const table = h(
    "table",
    {},
    h("caption", {}, "Since the server started"),
    h("thead", {}, h("tr", {}, ["", "observed steps", "imagined steps"].map((name) => h("th", { scope: "col" }, name)))),
    h(
      "tbody",
      {},
      row("rows", "observe.rows", "imagine.rows"),
      row("blocks", "observe.blocks", "imagine.blocks"),
      row("batch fill", "observe.fill", "imagine.fill"),
      row("time of a block", "observe.time", "imagine.time"),
    ),
  );
  const facts = h("p", { className: "soft" });
  const place = h("div", { className: "stack" }, h("div", { className: "charts" }, Object.values(charts).map((chart) => chart.element)), h("div", { className: "panel scroll", tabIndex: 0, role: "region", "aria-label": "Totals" }, table), facts);
  main.append(h("h1", {}, "Engine"), h("p", { className: "lead" }, "One thread owns the models. At each tick it computes one step of every waiting observation, and of as many rows of rollouts as fit."), place);
  const rates = new Rates();
  follow("/v1/live?sessions=0&every_millis=500", signal, (name, overview) => {
    if (name !== "overview") return;
    const rate = rates.next(overview);
    const { observe, imagine, waiting, ticks, refused } = overview.engine;
    if (rate) {
      charts.steps.push(overview.at, rate.observed, rate.imagined);
      charts.busy.push(overview.at, rate.busy);
      charts.fill.push(overview.at, rate.observeFill, rate.imagineFill);
      charts.ticks.push(overview.at, rate.ticks);
      charts.queue.push(overview.at, waiting.observations, waiting.rows);
      charts.refused.push(overview.at, rate.refused);
    }
    for (const [name, kind] of Object.entries({ observe, imagine })) {
      put(cells[`${name}.rows`], number(kind.rows));
      put(cells[`${name}.blocks`], number(kind.blocks));
      put(cells[`${name}.fill`], kind.lanes ? percent(kind.rows / kind.lanes) : "–");
      put(cells[`${name}.time`], kind.blocks ? millis(kind.micros / kind.blocks) : "–");
    }
    put(facts, `Ticks: ${number(ticks)}. Requests refused: ${number(refused)}. What waits now is predicted to take ${millis(waiting.predicted_micros)}.`);
  }, (problem) => place.replaceChildren(failure(problem)));
  signal.addEventListener("abort", () => Object.values(charts).forEach((chart) => chart.observer.disconnect()));
}
