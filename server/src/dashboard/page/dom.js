// Elements and words: small helpers that every view uses.

/** An element with properties, listeners (`onclick`), ARIA and data attributes, and children. */
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name in element && !name.startsWith("aria") && name !== "list") element[name] = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

/** Replaces text only where it differs, so that nothing is laid out anew for nothing. */
export function put(element, text) {
  const next = String(text);
  if (element.textContent !== next) element.textContent = next;
}

/** A number with so many digits after the point; a dash where there is none. */
export function number(value, digits = 0) {
  if (value === undefined || value === null || !Number.isFinite(value)) return "–";
  return value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
}

/** Microseconds as milliseconds. */
export const millis = (micros) => `${number(micros / 1000, micros < 10000 ? 1 : 0)} ms`;

/** A time that has passed, in words. */
export function ago(ms) {
  if (ms < 2000) return "now";
  if (ms < 120000) return `${Math.round(ms / 1000)} s ago`;
  if (ms < 7200000) return `${Math.round(ms / 60000)} min ago`;
  return `${Math.round(ms / 3600000)} h ago`;
}

/** The beginning of an id. */
export const short = (id) => id.slice(0, 8);

/** Whether the person wants nothing to move by itself. */
export const calm = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

/** A colour of the style sheet, as it is now. */
export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** What a page says where there is nothing to show. */
export function empty(title, ...lines) {
  return h("section", { className: "empty" }, h("h2", {}, title), lines.map((line) => (typeof line === "string" ? h("p", {}, line) : line)));
}

/** What a page says where something went wrong. */
export function failure(error, again) {
  return h(
    "section",
    { className: "empty", role: "alert" },
    h("h2", {}, error.title ?? "That did not work"),
    h("p", {}, error.message),
    again ? h("p", {}, h("button", { type: "button", onclick: again }, "Try again")) : null,
  );
}

/** A line that can be copied into a shell. */
export function shell(text) {
  return h("pre", { className: "shell", tabIndex: 0 }, h("code", {}, text));
}
