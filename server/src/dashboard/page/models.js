// The models that are served, each with its card.

import { ask } from "./api.js";
import { empty, failure, h, number } from "./dom.js";
import { markdown } from "./markdown.js";

export async function models(main, signal) {
  const place = h("div", { className: "stack" }, h("p", { className: "soft" }, "Asking for models …"));
  main.append(h("h1", {}, "Models"), place);
  try {
    const { models } = await ask("/v1/models", { signal });
    const none = () => empty("No model is served", "Load one over the administration listener, or start the server with --checkpoint.");
    place.replaceChildren(...(models.length ? models.map(card) : [none()]));
  } catch (problem) {
    if (problem.name === "AbortError") return;
    place.replaceChildren(failure(problem, () => (main.replaceChildren(), models(main, signal))));
  }
}

function card(model) {
  const fact = (name, value) => h("div", {}, h("dt", {}, name), h("dd", {}, value));
  const facts = [
    fact("Image", `${model.image_size} × ${model.image_size}`),
    fact("Step", model.frame_period_seconds ? `${number(model.frame_period_seconds, 2)} s` : "–"),
    fact("Slots", number(model.slots)),
    fact("Agent", model.agent_slot === undefined || model.agent_slot === null ? "none" : `slot ${model.agent_slot}`),
    fact("Objects", `up to ${model.max_objects}`),
    fact("Keypoints", model.keypoints ? number(model.keypoints) : "none"),
    fact("Trained", model.trained_steps ? `${number(model.trained_steps)} steps` : "not at all"),
    fact("Belief", `${number(model.state_bytes / 1024)} KiB`),
    fact("Computes on", model.device),
  ];
  const actions = h(
    "table",
    {},
    h("caption", {}, "Actions"),
    h("thead", {}, h("tr", {}, ["dimension", "unit", "offset", "scale"].map((name) => h("th", { scope: "col" }, name)))),
    h("tbody", {}, model.actions.map((action) => h("tr", {}, h("th", { scope: "row" }, action.name), h("td", {}, action.unit), h("td", {}, number(action.offset, 3)), h("td", {}, number(action.scale, 3))))),
  );
  return h(
    "article",
    { className: "panel stack" },
    h("h2", {}, model.name),
    h("p", { className: "soft hash" }, model.hash),
    h("dl", { className: "facts" }, facts),
    model.actions.length ? h("div", { className: "scroll", tabIndex: 0, role: "region", "aria-label": `Actions of ${model.name}` }, actions) : null,
    model.card ? h("details", { open: true }, h("summary", {}, "Card"), h("div", { className: "prose" }, markdown(model.card.replace(`# ${model.name}\n`, "")))) : h("p", { className: "soft" }, "It has no card."),
  );
}
