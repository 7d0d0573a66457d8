// The page: which view is shown, whether the server is there, and the key. Every view is a file of its own and gets an
// element to fill and a signal that is aborted when it is left.

import { events, key } from "./api.js";
import { put } from "./dom.js";
import { engine } from "./engine.js";
import { models } from "./models.js";
import { session } from "./session.js";
import { sessions } from "./sessions.js";

const main = document.getElementById("view");
const connection = document.getElementById("connection");
const lost = document.getElementById("lost");
let leaving = new AbortController();

function route() {
  const [view = "", ...rest] = location.hash.replace(/^#\/?/, "").split("/");
  if (view === "models") return ["models", "Models", models];
  if (view === "engine") return ["engine", "Engine", engine];
  if (view === "sessions" && rest[0]) return ["sessions", "Session", (...to) => session(...to, rest[0])];
  return ["sessions", "Sessions", sessions];
}

function show(focus) {
  leaving.abort();
  leaving = new AbortController();
  const [name, title, view] = route();
  document.title = `${title} – gatsbi`;
  for (const link of document.querySelectorAll("nav [data-view]")) {
    if (link.dataset.view === name) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  main.replaceChildren();
  lost.hidden = true;
  view(main, leaving.signal);
  if (focus) {
    main.focus({ preventScroll: true });
    scrollTo(0, 0);
  }
}

events.addEventListener("connection", ({ detail: { state, seconds } }) => {
  connection.dataset.state = state;
  put(connection, { live: "Live", connecting: "Connecting", lost: "Connection lost" }[state]);
  if (state === "live") lost.hidden = true;
  if (state === "lost") {
    // The words change by the second, which nobody wants read out: the status says once that the connection is lost.
    const next = seconds ? `trying again in ${seconds} s` : "trying again";
    put(lost, `Connection lost. What you see is the last that came; ${next}.`);
    lost.hidden = false;
  }
});

const dialog = document.getElementById("key-dialog");
const field = document.getElementById("key-field");
const why = document.getElementById("key-why");
const button = document.getElementById("key");

function askForKey(reason) {
  if (dialog.open) return;
  field.value = key.get();
  if (reason) put(why, reason);
  dialog.showModal();
  field.select();
}

button.addEventListener("click", () => askForKey());
events.addEventListener("key", ({ detail }) => askForKey(detail));
dialog.addEventListener("close", () => {
  if (dialog.returnValue === "save") key.set(field.value.trim());
  if (dialog.returnValue === "forget") key.set("");
  button.dataset.set = key.get() !== "";
  if (dialog.returnValue !== "cancel" && dialog.returnValue !== "") show(false);
  dialog.returnValue = "";
});

button.dataset.set = key.get() !== "";
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault();
  main.focus();
});
addEventListener("hashchange", () => show(true));
show(false);
