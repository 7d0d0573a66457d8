// One step on a canvas: the camera's picture or the model's, masks as tints, and lines over them. Pictures have few
// pixels, and are enlarged without blur; lines are drawn as fine as the screen is.

import { bitmap } from "./api.js";
import { colour } from "./dom.js";
import { AGENT, coloursOf, rgb } from "./palette.js";

const TINT = 0.55;
/** How surely an object must be there to be shown. */
export const PRESENT = 0.5;

/** Decodes the pictures of an event, all at once. */
export async function decode(event) {
  const [camera, belief, masks] = await Promise.all(
    [event.camera, event.belief, event.masks?.png].map((png) => (png ? bitmap(png) : null)),
  );
  return { camera, belief, masks: masks ? unstack(masks, event) : new Map() };
}

/** Masks lie one below the other: bytes by whose they are. */
function unstack(picture, event) {
  const size = event.image_size;
  const canvas = new OffscreenCanvas(size, picture.height);
  const pen = canvas.getContext("2d", { willReadFrequently: true });
  pen.drawImage(picture, 0, 0);
  const pixels = pen.getImageData(0, 0, size, picture.height).data;
  const masks = new Map();
  event.masks.order.forEach((whose, row) => {
    if (whose === null) return;
    const mask = new Uint8Array(size * size);
    for (let at = 0; at < mask.length; at++) mask[at] = pixels[4 * (row * mask.length + at)];
    masks.set(whose === "agent" ? "agent" : `object ${whose}`, mask);
  });
  return masks;
}

/** What of a step is drawn. */
export const LAYERS = [
  ["agent", "Agent"],
  ["objects", "Objects"],
  ["background", "Background"],
  ["boxes", "Boxes and ids"],
  ["trails", "Trails"],
  ["keypoints", "Keypoints"],
];

export class SceneCanvas {
  constructor(canvas) {
    this.canvas = canvas;
    this.small = new OffscreenCanvas(1, 1);
  }

  /** Draws a step; `layers` is a set of names, `trails` gives the last places of each object, `target` a point. */
  draw(event, pictures, { of, layers, trails, target }) {
    const { width } = this.canvas.getBoundingClientRect();
    const side = Math.max(Math.round(width * (devicePixelRatio || 1)), 1);
    if (this.canvas.width !== side) this.canvas.width = this.canvas.height = side;
    const pen = this.canvas.getContext("2d");
    pen.imageSmoothingEnabled = false;
    const picture = (of === "camera" && pictures.camera) || pictures.belief || pictures.camera;
    pen.fillStyle = colour("--well");
    pen.fillRect(0, 0, side, side);
    if (picture) pen.drawImage(picture, 0, 0, side, side);
    const there = present(event.objects);
    const colours = coloursOf(there.map((object) => object.id));
    this.tint(pen, side, event, pictures.masks, { layers, colours });
    const line = Math.max(side / 256, 1.5);
    pen.lineWidth = line;
    pen.lineJoin = pen.lineCap = "round";
    const at = (value) => ((value + 1) / 2) * side;
    if (layers.has("trails")) {
      for (const { id } of there) {
        const places = trails.get(id) ?? [];
        pen.strokeStyle = colours.get(id);
        for (let i = 1; i < places.length; i++) {
          pen.globalAlpha = 0.15 + (0.85 * i) / places.length;
          pen.beginPath();
          pen.moveTo(at(places[i - 1].x), at(places[i - 1].y));
          pen.lineTo(at(places[i].x), at(places[i].y));
          pen.stroke();
        }
        pen.globalAlpha = 1;
      }
    }
    if (layers.has("boxes")) for (const object of there) box(pen, object, colours.get(object.id), { side, line });
    if (layers.has("keypoints")) {
      for (const [x, y, strength] of event.keypoints ?? []) {
        pen.globalAlpha = Math.max(0.1, Math.min(strength, 1));
        pen.strokeStyle = "#000";
        pen.fillStyle = "#7cff6b";
        pen.beginPath();
        pen.arc(at(x), at(y), line * 2.2, 0, 2 * Math.PI);
        pen.fill();
        pen.stroke();
      }
      pen.globalAlpha = 1;
    }
    if (target) cross(pen, at(target.x), at(target.y), line);
  }

  tint(pen, side, event, masks, { layers, colours }) {
    const size = event.image_size;
    if (this.small.width !== size) this.small = new OffscreenCanvas(size, size);
    const image = new ImageData(size, size);
    const pixels = image.data;
    let any = false;
    const paint = (mask, [r, g, b]) => {
      any = true;
      for (let at = 0; at < mask.length; at++) {
        if (!mask[at]) continue;
        const share = (mask[at] / 255) * TINT, before = pixels[4 * at + 3] / 255, whole = share + before;
        [r, g, b].forEach((value, channel) => {
          pixels[4 * at + channel] = (value * share + pixels[4 * at + channel] * before) / whole;
        });
        pixels[4 * at + 3] = Math.min(whole, 1) * 255;
      }
    };
    if (layers.has("background")) paint(rest(masks, size), [150, 110, 255]);
    for (const [whose, mask] of masks) {
      if (whose === "agent" ? layers.has("agent") : layers.has("objects")) {
        paint(mask, rgb(whose === "agent" ? AGENT : colours.get(Number(whose.slice(7)))));
      }
    }
    if (!any) return;
    this.small.getContext("2d").putImageData(image, 0, 0);
    pen.drawImage(this.small, 0, 0, side, side);
  }
}

/** What is neither agent nor object. */
function rest(masks, size) {
  const left = new Uint8Array(size * size).fill(255);
  for (const mask of masks.values()) {
    for (let at = 0; at < left.length; at++) left[at] = Math.max(left[at] - mask[at], 0);
  }
  return left;
}

/** The objects that are there. */
export const present = (objects) => objects.filter((object) => object.presence > PRESENT);

/** An object's box with its identity above. */
export function box(pen, object, colour, { side, line }) {
  const width = object.width * side, height = object.height * side;
  const left = ((object.x + 1) / 2) * side - width / 2, top = ((object.y + 1) / 2) * side - height / 2;
  if (![left, top, width, height].every(Number.isFinite)) return;
  // Dark beside light, so that it is seen on any picture.
  for (const [style, wide] of [["rgb(0 0 0 / 45%)", line * 2], [colour, line]]) {
    pen.strokeStyle = style;
    pen.lineWidth = wide;
    pen.strokeRect(left, top, width, height);
  }
  const text = String(object.id), letter = line * 8;
  pen.font = `600 ${letter}px ui-sans-serif, system-ui, sans-serif`;
  const wide = pen.measureText(text).width + letter * 0.6;
  const above = Math.max(top - letter * 1.25, 0);
  pen.fillStyle = colour;
  pen.fillRect(left - line / 2, above, wide, letter * 1.25);
  pen.fillStyle = "#16181b";
  pen.fillText(text, left + letter * 0.3 - line / 2, above + letter);
}

function cross(pen, x, y, line) {
  for (const [style, width] of [["#000", line * 3], ["#fff", line]]) {
    pen.strokeStyle = style;
    pen.lineWidth = width;
    pen.beginPath();
    pen.arc(x, y, line * 5, 0, 2 * Math.PI);
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(x + dx * line * 3, y + dy * line * 3);
      pen.lineTo(x + dx * line * 8, y + dy * line * 8);
    }
    pen.stroke();
  }
}

/** Root mean squared difference of two pictures of one size, values in [0, 1]. */
export function difference(one, other) {
  const pixels = (picture) => {
    const pen = new OffscreenCanvas(picture.width, picture.height).getContext("2d", { willReadFrequently: true });
    pen.drawImage(picture, 0, 0);
    return pen.getImageData(0, 0, picture.width, picture.height).data;
  };
  const [a, b] = [pixels(one), pixels(other)];
  let sum = 0;
  for (let at = 0; at < a.length; at++) if (at % 4 !== 3) sum += (a[at] - b[at]) ** 2;
  return Math.sqrt(sum / (a.length * 0.75)) / 255;
}
