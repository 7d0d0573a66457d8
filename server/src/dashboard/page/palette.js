// Colours of the agent and of objects, the same as in the server's pictures, with the same rule.

/** The colour of the agent, in every picture. */
export const AGENT = "#224afa";

const OBJECTS = ["#ff9703", "#67fec7", "#ec22aa", "#f8e919", "#6b8afc", "#b4741e", "#faa3ff", "#9eb79d"];

/**
 * The colours of the objects in one picture, by id: from the lowest to the highest, each takes the one at its id modulo
 * the palette's size, or the next one that is free; when all are taken, all are free again.
 */
export function coloursOf(ids) {
  const colours = new Map();
  let taken = new Set();
  for (const id of [...new Set(ids)].sort((a, b) => a - b)) {
    if (taken.size === OBJECTS.length) taken = new Set();
    let at = id % OBJECTS.length;
    while (taken.has(at)) at = (at + 1) % OBJECTS.length;
    taken.add(at);
    colours.set(id, OBJECTS[at]);
  }
  return colours;
}

/** Red, green and blue of `#rrggbb`. */
export const rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
