// Lines and stacked areas over the last steps or moments, drawn on a canvas in the colours of the style sheet.

import { colour, h, put } from "./dom.js";

const POINTS = 240;

/**
 * A chart of one or more series: `series` is a list of `[name, colour variable]`, `format` writes a value.
 * With `stacked` the series add up. `floor` is the least that the axis reaches to.
 */
export class Chart {
  constructor(title, { series, format, stacked = false, floor = 0, points = POINTS, unit = "steps" }) {
    Object.assign(this, { title, series, format, stacked, floor, points, unit, rows: [], said: -Infinity, waiting: false });
    this.now = h("output", { className: "now", "aria-live": "off" }, "–");
    this.canvas = h("canvas", { role: "img", "aria-label": `${title}: nothing yet` });
    const legend = series.length < 2 ? [] : series.map(([name, variable]) => {
      const mark = h("i", { className: "mark" });
      mark.style.background = `var(${variable})`;
      return h("span", {}, mark, name);
    });
    this.element = h(
      "figure",
      { className: "chart" },
      h("figcaption", {}, h("span", { className: "name" }, title), this.now),
      this.canvas,
      legend.length ? h("p", { className: "legend" }, legend) : null,
    );
    this.observer = new ResizeObserver(() => this.draw());
    this.observer.observe(this.canvas);
  }

  /** Adds a row of one value a series; `at` is where it lies on the axis. */
  push(at, ...values) {
    const last = this.rows.at(-1);
    if (last && at <= last.at) this.rows = this.rows.filter((row) => row.at < at);
    this.rows.push({ at, values });
    if (this.rows.length > this.points) this.rows.shift();
    this.later();
  }

  clear() {
    this.rows = [];
    this.later();
  }

  /** Draws at the next frame of the screen, once. */
  later() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  draw() {
    const { width, height } = this.canvas.getBoundingClientRect();
    if (!width) return;
    const ratio = devicePixelRatio || 1;
    if (this.canvas.width !== Math.round(width * ratio)) this.canvas.width = Math.round(width * ratio);
    if (this.canvas.height !== Math.round(height * ratio)) this.canvas.height = Math.round(height * ratio);
    const pen = this.canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const total = ({ values }) => (this.stacked ? values.reduce((sum, value) => sum + (value || 0), 0) : Math.max(...values.filter(Number.isFinite)));
    const highest = Math.max(this.floor, ...this.rows.map(total).filter(Number.isFinite));
    const top = nice(highest || 1);
    const left = 4, right = width - 4, low = height - 16, high = 6;
    const first = this.rows[0]?.at ?? 0;
    const span = Math.max((this.rows.at(-1)?.at ?? 0) - first, 1);
    const x = (at) => left + ((at - first) / span) * (right - left);
    const y = (value) => low - (value / top) * (low - high);
    pen.font = `11px ${getComputedStyle(document.body).fontFamily}`;
    pen.lineWidth = 1;
    pen.strokeStyle = colour("--line");
    pen.fillStyle = colour("--soft");
    for (const share of [0, 0.5, 1]) {
      const at = Math.round(y(top * share)) + 0.5;
      pen.beginPath();
      pen.moveTo(left, at);
      pen.lineTo(right, at);
      pen.stroke();
      if (share) pen.fillText(this.format(top * share), left, at + 11);
    }
    if (this.rows.length) {
      pen.textAlign = "left";
      pen.fillText(this.label(first), left, height - 3);
      if (this.rows.length > 1) {
        pen.textAlign = "right";
        pen.fillText(this.label(this.rows.at(-1).at), right, height - 3);
        pen.textAlign = "left";
      }
      this.lines(pen, x, y, first);
    }
    const last = this.rows.at(-1);
    put(this.now, last ? this.format(total(last)) : "–");
    this.tell(last ? this.format(total(last)) : null, this.format(highest));
  }

  label(at) {
    if (this.unit === "steps") return `step ${at}`;
    return new Date(at).toLocaleTimeString("en-GB");
  }

  lines(pen, x, y, first) {
    const below = this.rows.map(() => 0);
    this.series.forEach(([, variable], which) => {
      pen.strokeStyle = pen.fillStyle = colour(variable);
      const heights = this.rows.map(({ values }, at) => (this.stacked ? below[at] : 0) + (values[which] ?? NaN));
      pen.beginPath();
      let open = false;
      heights.forEach((value, at) => {
        if (!Number.isFinite(value)) return (open = false);
        pen[open ? "lineTo" : "moveTo"](x(this.rows[at].at), y(value));
        open = true;
      });
      pen.lineWidth = 1.75;
      pen.lineJoin = "round";
      pen.stroke();
      if (this.rows.length === 1 && Number.isFinite(heights[0])) {
        // A single point is no line.
        pen.beginPath();
        pen.arc(x(first), y(heights[0]), 2.5, 0, 2 * Math.PI);
        pen.fill();
        pen.beginPath();
      }
      if (this.stacked || this.series.length === 1) {
        for (let at = this.rows.length - 1; at >= 0; at--) pen.lineTo(x(this.rows[at].at), y(below[at]));
        pen.globalAlpha = this.stacked ? 0.35 : 0.1;
        pen.fill();
        pen.globalAlpha = 1;
      }
      if (this.stacked) heights.forEach((value, at) => (below[at] = value || 0));
    });
  }

  /** Tells readers of the screen what is drawn, now and then. */
  tell(now, highest) {
    if (!now || performance.now() - this.said < 5000) return;
    this.said = performance.now();
    this.canvas.setAttribute("aria-label", `${this.title}: now ${now}, highest of the last ${this.rows.length} ${highest}`);
  }
}

/** The next number of the form 1, 2, 2.5 or 5 times a power of ten. */
function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 2.5, 5, 10].map((step) => step * power).find((step) => step >= value * 0.999);
}
