// The guides under the hand: curves that can be chosen, control points that can be dragged or moved with the arrow keys.

import { coefficientsOf, controlPositions, valuesOf } from "../geometry/guides.js";
import { Overlay, guideCurve } from "./overlays.js";
import { announce } from "./accessibility.js";
import { state, update } from "./state.js";

const SVG = "http://www.w3.org/2000/svg";
const FAR = 1.6;
const UNDO_STEPS = 200;

export class Editor {
  constructor(svg) {
    this.svg = svg;
    this.overlay = new Overlay(svg);
    this.history = [];
    this.drag = null;
    svg.addEventListener("pointerdown", (event) => this.take(event));
    svg.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) svg.addEventListener(name, () => { this.drag = null; });
    svg.addEventListener("keydown", (event) => this.press(event));
    svg.addEventListener("focusin", (event) => this.focus(event.target));
  }

  get count() {
    return state.guides.rows.length + state.guides.columns.length;
  }

  forget() {
    this.history = [];
    this.drag = null;
  }

  name({ family, index } = state.active) {
    return `${family === "rows" ? "Row" : "Column"} ${index + 1} of ${state.guides[family].length}`;
  }

  step(by) {
    const { rows } = state.guides, { family, index } = state.active;
    const at = ((family === "rows" ? 0 : rows.length) + index + by + this.count) % this.count;
    update({ active: at < rows.length ? { family: "rows", index: at } : { family: "columns", index: at - rows.length } });
  }

  /** Draws all guides and the control points of the chosen one; keeps the focus where it was. */
  draw() {
    const focused = this.svg.contains(document.activeElement) ? document.activeElement.dataset.point : undefined;
    this.overlay.clear();
    for (const family of ["rows", "columns"]) {
      state.guides[family].forEach((guide, index) => {
        const active = family === state.active.family && index === state.active.index;
        this.overlay.path(guideCurve(guide, family), `${family} ${active ? "active" : "waiting"}`);
      });
    }
    const { family, index } = state.active, guide = state.guides[family][index];
    const values = valuesOf(guide.coefficients), at = controlPositions(guide.coefficients.length - 1);
    values.forEach((value, point) => this.handle(family, at[point], value, point, values.length));
    if (focused !== undefined) this.svg.querySelector(`[data-point="${focused}"]`)?.focus();
  }

  handle(family, along, across, point, count) {
    const handle = document.createElementNS(SVG, "g");
    const [x, y] = family === "rows" ? [along, across] : [across, along];
    handle.setAttribute("transform", `translate(${((x + 1) / 2) * this.overlay.width} ${((y + 1) / 2) * this.overlay.height})`);
    handle.setAttribute("class", `handle ${family}`);
    const attributes = {
      tabindex: 0, role: "slider", "aria-label": `${this.name()}, point ${point + 1} of ${count}`,
      "aria-orientation": family === "rows" ? "vertical" : "horizontal",
      "aria-valuemin": -160, "aria-valuemax": 160, "aria-valuenow": Math.round(across * 100),
      "aria-valuetext": `${this.pixels(family, across).toFixed(1)} pixels from the ${family === "rows" ? "top" : "left"}`,
    };
    for (const [name, value] of Object.entries(attributes)) handle.setAttribute(name, value);
    handle.dataset.point = point;
    for (const [kind, radius] of [["reach", 18], ["dot", 7]]) {
      const circle = document.createElementNS(SVG, "circle");
      circle.setAttribute("r", radius);
      circle.setAttribute("class", kind);
      handle.append(circle);
    }
    this.svg.append(handle);
  }

  pixels(family, across) {
    return ((across + 1) / 2) * (family === "rows" ? state.picture.height : state.picture.width);
  }

  place(event) {
    const box = this.svg.getBoundingClientRect();
    return [(2 * (event.clientX - box.left)) / box.width - 1, (2 * (event.clientY - box.top)) / box.height - 1];
  }

  take(event) {
    if (event.button) return;
    const place = this.place(event), handle = event.target.closest(".handle");
    const nearest = handle ? state.active : this.nearest(place);
    if (!nearest) return;
    event.preventDefault();
    this.svg.setPointerCapture(event.pointerId);
    if (!handle) update({ active: nearest });
    const guide = state.guides[nearest.family][nearest.index], axis = nearest.family === "rows" ? 1 : 0;
    this.remember();
    this.drag = { axis, from: place[axis], values: valuesOf(guide.coefficients), point: handle ? Number(handle.dataset.point) : null };
    if (handle) this.svg.querySelector(`[data-point="${handle.dataset.point}"]`)?.focus();
  }

  move(event) {
    if (!this.drag) return;
    const { axis, from, values, point } = this.drag, by = this.place(event)[axis] - from;
    this.change(values.map((value, n) => (point === null || n === point ? value + by : value)));
  }

  /** The guide whose curve runs within 14 CSS pixels of a place. */
  nearest([x, y]) {
    let best = null, least = 14;
    for (const family of ["rows", "columns"]) {
      state.guides[family].forEach((guide, index) => {
        const curve = guideCurve(guide, family, 97);
        for (let i = 0; i < curve.length; i += 2) {
          const distance = Math.hypot(((curve[i] - x) / 2) * this.overlay.width, ((curve[i + 1] - y) / 2) * this.overlay.height);
          if (distance < least) [best, least] = [{ family, index }, distance];
        }
      });
    }
    return best;
  }

  press(event) {
    const handle = event.target.closest?.(".handle");
    if (!handle) return;
    const [back, on] = state.active.family === "rows" ? ["ArrowUp", "ArrowDown"] : ["ArrowLeft", "ArrowRight"];
    const along = state.active.family === "rows" ? ["ArrowLeft", "ArrowRight"] : ["ArrowUp", "ArrowDown"];
    const point = Number(handle.dataset.point);
    if (along.includes(event.key)) {
      event.preventDefault();
      this.svg.querySelector(`[data-point="${point + (event.key === along[0] ? -1 : 1)}"]`)?.focus();
      return;
    }
    if (event.key !== back && event.key !== on) return;
    event.preventDefault();
    const guide = state.guides[state.active.family][state.active.index], values = valuesOf(guide.coefficients);
    const pixel = 2 / (state.active.family === "rows" ? state.picture.height : state.picture.width);
    if (!event.repeat) this.remember();
    values[point] += (event.key === back ? -1 : 1) * pixel * (event.shiftKey ? 10 : 1);
    this.change(values);
  }

  focus(target) {
    const handle = target.closest?.(".handle");
    if (handle) announce(`${handle.getAttribute("aria-label")}, ${handle.getAttribute("aria-valuetext")}`);
  }

  change(values) {
    const { family, index } = state.active;
    const guides = structuredClone(state.guides);
    guides[family][index].coefficients = coefficientsOf(values.map((value) => Math.min(Math.max(value, -FAR), FAR)));
    update({ guides, edited: true });
  }

  remember() {
    this.history.push({ guides: state.guides, edited: state.edited, active: state.active });
    if (this.history.length > UNDO_STEPS) this.history.shift();
  }

  undo() {
    const before = this.history.pop();
    if (before) update(before);
    announce(before ? "Undone" : "Nothing to undo");
  }

  reset() {
    this.remember();
    update({ guides: structuredClone(state.record.guides), edited: false });
    announce("The guides are as they were estimated");
  }
}
