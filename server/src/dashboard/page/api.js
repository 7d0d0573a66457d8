// The server: requests, feeds that come back after they were lost, and the key.

const KEY = "gatsbi-key";

/** Hears `connection` events (state, seconds until the next try) and `key` events (a key is wanted). */
export const events = new EventTarget();

export const key = {
  get: () => sessionStorage.getItem(KEY) ?? "",
  set: (value) => (value ? sessionStorage.setItem(KEY, value) : sessionStorage.removeItem(KEY)),
};

/** Why the server did not do what was asked. */
export class Problem extends Error {
  constructor(status, document) {
    super(document.detail ?? document.message ?? `The server answered ${status}`);
    this.status = status;
    this.reason = document.reason;
    this.title = document.title;
  }
}

function headers(more = {}) {
  return key.get() ? { ...more, authorization: `Bearer ${key.get()}` } : more;
}

/** What the server refuses; where a key is at fault, another one is asked for. */
function refusal(status, document) {
  if (status === 401 || status === 403) {
    events.dispatchEvent(new CustomEvent("key", { detail: document.detail }));
  }
  return new Problem(status, document);
}

async function answer(response) {
  if (response.ok) return response;
  throw refusal(response.status, await response.json().catch(() => ({})));
}

async function send(path, options = {}) {
  const { body, accept = "application/json", ...rest } = options;
  const request = { ...rest, headers: headers({ accept }) };
  if (body !== undefined) {
    request.method ??= "POST";
    request.headers["content-type"] = "application/json";
    request.body = JSON.stringify(body);
  }
  let response;
  try {
    response = await fetch(path, request);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    say("lost");
    throw new Problem(0, { title: "No connection", detail: "The server cannot be reached." });
  }
  say("live");
  return answer(response);
}

const say = (state, seconds) => events.dispatchEvent(new CustomEvent("connection", { detail: { state, seconds } }));

/** Asks for a JSON document. */
export const ask = async (path, options) => (await send(path, options)).json();

/** Asks for a file. */
export const file = async (path, options) => (await send(path, { accept: "*/*", ...options })).blob();

/** Asks for lines of JSON and gives them as they come. */
export async function* lines(path, options) {
  const response = await send(path, { accept: "application/x-ndjson", ...options });
  for await (const line of split(response.body, "\n")) {
    if (!line.trim()) continue;
    const value = JSON.parse(line);
    if (value.problem) throw refusal(value.problem.status ?? 0, value.problem);
    yield value;
  }
}

async function* split(stream, mark) {
  const decoder = new TextDecoder();
  const reader = stream.getReader();
  let rest = "";
  try {
    for (;;) {
      const { done, value } = await reader.read();
      rest += decoder.decode(value, { stream: !done });
      let at;
      while ((at = rest.indexOf(mark)) >= 0) {
        yield rest.slice(0, at);
        rest = rest.slice(at + mark.length);
      }
      if (done) break;
    }
    if (rest) yield rest;
  } finally {
    reader.cancel().catch(() => {});
  }
}

/**
 * Follows a feed of server-sent events until `signal` is aborted, and begins again when it is lost.
 * `heard(name, data)` gets every event, `refused(problem)` what cannot be mended by waiting.
 */
export async function follow(path, signal, heard, refused) {
  let wait = 0.5;
  while (!signal.aborted) {
    try {
      const response = await send(path, { accept: "text/event-stream", signal });
      for await (const event of split(response.body, "\n\n")) {
        wait = 0.5;
        const field = (name) => event.split("\n").find((line) => line.startsWith(`${name}:`))?.slice(name.length + 1).trim();
        const name = field("event");
        if (!name) continue;
        const data = JSON.parse(field("data"));
        // The feed ends with its key.
        if (name === "problem") throw refusal(data.status, data);
        heard(name, data);
        if (name === "closed") return;
      }
    } catch (error) {
      if (signal.aborted) return;
      // What waits for another key or another session is not mended by trying again.
      if (error.status && error.status < 500 && error.status !== 429) return refused(error);
    }
    if (signal.aborted) return;
    await pause(wait, signal);
    wait = Math.min(wait * 2, 8);
  }
}

/** Counts down aloud until the next try. */
async function pause(seconds, signal) {
  const end = performance.now() + seconds * 1000;
  for (;;) {
    const left = end - performance.now();
    if (left <= 0 || signal.aborted) break;
    say("lost", Math.ceil(left / 1000));
    await new Promise((done) => setTimeout(done, Math.min(left, 500)));
  }
  if (!signal.aborted) say("connecting");
}

/** Actions `[N][H][A]` as a tensor. */
export function actions(candidates) {
  const shape = [candidates.length, candidates[0].length, candidates[0][0].length];
  return { dtype: "DATA_TYPE_F32", shape, values: candidates.flat(2) };
}

/** The bytes of base64. */
export function bytes(base64) {
  const text = atob(base64);
  const numbers = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) numbers[i] = text.charCodeAt(i);
  return numbers;
}

/** 32-bit floats of a tensor. */
export const floats = (tensor) => new Float32Array(bytes(tensor.data).buffer);

/** A picture from a PNG file in base64. */
export const bitmap = (png) => createImageBitmap(new Blob([bytes(png)], { type: "image/png" }));
