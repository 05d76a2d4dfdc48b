// The picture under the hand: points that are put, dragged and taken away, and the curves through them.

import { Overlay, guideCurve } from "../page/overlays.js";
import { CURVES, fit } from "./curves.js";

const SVG = "http://www.w3.org/2000/svg";
const REACH_PX = 12;

export class Board {
  /**
   * @param {SVGSVGElement} svg
   * @param {{curves: () => number[][][], active: () => number, put(place: number[]): number, move(point: number, place: number[]): void,
   *   seen(place: number[]): void}} hands what the board asks and tells; places are centred, points counted in the active curve.
   */
  constructor(svg, hands) {
    this.svg = svg;
    this.hands = hands;
    this.overlay = new Overlay(svg);
    this.cursor = null;
    this.dragged = null;
    svg.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      event.preventDefault();
      svg.focus({ preventScroll: true });
      svg.setPointerCapture(event.pointerId);
      const place = this.place(event);
      this.cursor = null;
      this.dragged = this.near(place) ?? hands.put(place);
    });
    svg.addEventListener("pointermove", (event) => {
      const place = this.place(event);
      hands.seen(place);
      if (this.dragged !== null && event.buttons & 1) hands.move(this.dragged, place);
    });
    for (const name of ["pointerup", "pointercancel"]) svg.addEventListener(name, () => { this.dragged = null; });
  }

  place(event) {
    const box = this.svg.getBoundingClientRect();
    const limit = (value) => Math.min(Math.max(value, -1), 1);
    return [limit((2 * (event.clientX - box.left)) / box.width - 1), limit((2 * (event.clientY - box.top)) / box.height - 1)];
  }

  near([x, y]) {
    const points = this.hands.curves()[this.hands.active()];
    const at = points.findLastIndex((point) => Math.hypot(
      ((point[0] - x) / 2) * this.overlay.width, ((point[1] - y) / 2) * this.overlay.height,
    ) < REACH_PX);
    return at < 0 ? null : at;
  }

  /** Moves the crosshair of the keyboard by CSS pixels. */
  steer(dx, dy) {
    const [x, y] = this.cursor ?? [0, 0], limit = (value) => Math.min(Math.max(value, -1), 1);
    this.cursor = [limit(x + (2 * dx) / this.overlay.width), limit(y + (2 * dy) / this.overlay.height)];
    this.hands.seen(this.cursor);
    this.draw();
  }

  draw() {
    this.overlay.clear();
    const active = this.hands.active();
    this.hands.curves().forEach((points, n) => {
      const { family } = CURVES[n], kind = `${family} ${n === active ? "active" : "waiting"}`;
      const coefficients = fit(points, family);
      if (coefficients && points.length > 1) this.overlay.path(guideCurve({ coefficients }, family, 97), kind);
      for (const point of points) this.dot(point, kind, n === active ? 5 : 3.5);
    });
    if (this.cursor) this.crosshair(this.cursor);
  }

  at([x, y]) {
    return [((x + 1) / 2) * this.overlay.width, ((y + 1) / 2) * this.overlay.height];
  }

  dot(place, kind, radius) {
    const [x, y] = this.at(place), circle = document.createElementNS(SVG, "circle");
    for (const [name, value] of Object.entries({ cx: x, cy: y, r: radius, class: `point ${kind}` })) circle.setAttribute(name, value);
    this.svg.append(circle);
  }

  crosshair(place) {
    const [x, y] = this.at(place), path = document.createElementNS(SVG, "path");
    path.setAttribute("d", `M${x - 14} ${y}h10m8 0h10M${x} ${y - 14}v10m0 8v10`);
    path.setAttribute("class", "crosshair");
    this.svg.append(path);
  }
}
