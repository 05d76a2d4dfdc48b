// Guides, grid and movement drawn over both sides of the comparison: bent over the picture as it was, straight after.

import { polynomial } from "../geometry/guides.js";
import { targetLattice } from "../geometry/lattice.js";

const SVG = "http://www.w3.org/2000/svg";
const SAMPLES = 49;
const LINES = 17;
const ARROWS = 12;

/** Flat source points of a guide. */
export function guideCurve(guide, family, samples = SAMPLES) {
  const points = new Float64Array(2 * samples);
  for (let i = 0; i < samples; i++) {
    const along = -1 + (2 * i) / (samples - 1), across = polynomial(guide.coefficients, along)[0];
    points[2 * i] = family === "rows" ? along : across;
    points[2 * i + 1] = family === "rows" ? across : along;
  }
  return points;
}

/** Where a lattice puts flat source points: flat target points, by Newton's steps. NaN where none is near. */
export function forward(lattice, source) {
  const map = lattice.continued(2), at = source.slice(), probe = new Float64Array(6), shown = new Float64Array(6);
  const step = 1e-3;
  for (let i = 0; i < at.length; i += 2) {
    let x = source[i], y = source[i + 1], error = Infinity;
    for (let round = 0; round < 16 && error > 1e-5; round++) {
      probe.set([x, y, x + step, y, x, y + step]);
      map(probe, shown);
      const rx = shown[0] - source[i], ry = shown[1] - source[i + 1];
      error = Math.hypot(rx, ry);
      const a = (shown[2] - shown[0]) / step, b = (shown[4] - shown[0]) / step;
      const c = (shown[3] - shown[1]) / step, d = (shown[5] - shown[1]) / step;
      const determinant = a * d - b * c || 1e-6;
      const limit = (value) => Math.min(Math.max(value, -0.5), 0.5);
      x -= limit((rx * d - ry * b) / determinant);
      y -= limit((ry * a - rx * c) / determinant);
    }
    at[i] = error < 1e-3 ? x : NaN;
    at[i + 1] = error < 1e-3 ? y : NaN;
  }
  return at;
}

export class Overlay {
  /** @param {SVGSVGElement} svg that covers a pane; its user unit is a CSS pixel. */
  constructor(svg) {
    this.svg = svg;
    this.width = this.height = 1;
  }

  resize(width, height) {
    this.width = width;
    this.height = height;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  }

  clear() {
    this.svg.replaceChildren();
  }

  /** Two strokes, a dark one below: seen over any picture. */
  path(points, kind, closed = false) {
    let text = "", pen = "M";
    for (let i = 0; i < points.length; i += 2) {
      if (!Number.isFinite(points[i]) || Math.abs(points[i]) > 4 || Math.abs(points[i + 1]) > 4) { pen = "M"; continue; }
      text += `${pen}${(((points[i] + 1) / 2) * this.width).toFixed(2)} ${(((points[i + 1] + 1) / 2) * this.height).toFixed(2)}`;
      pen = "L";
    }
    if (closed) text += "Z";
    return ["casing", "line"].map((layer) => {
      const path = document.createElementNS(SVG, "path");
      path.setAttribute("d", text);
      path.setAttribute("class", `${layer} ${kind}`);
      this.svg.append(path);
      return path;
    });
  }
}

/** Draws what is switched on over the source and over the result. */
export function drawOverlays(before, after, state, derived) {
  before.clear();
  after.clear();
  const { fitted, blended, window } = derived;
  if (state.overlays.grid) drawGrid(before, after, fitted);
  if (state.overlays.arrows) drawArrows(before, after, blended, window);
  if (state.overlays.guides && state.guides) {
    for (const family of ["rows", "columns"]) {
      for (const guide of state.guides[family]) {
        const curve = guideCurve(guide, family);
        if (state.view === "compare") before.path(curve, family);
        after.path(forward(fitted, curve), family);
      }
    }
  }
}

function drawGrid(before, after, fitted) {
  const map = fitted.continued(1), lines = 2 * LINES;
  for (let i = 0; i < lines; i++) {
    const across = i < LINES, at = -1 + (2 * (i % LINES)) / (LINES - 1);
    const straight = new Float64Array(2 * SAMPLES);
    for (let k = 0; k < SAMPLES; k++) {
      const along = -1 + (2 * k) / (SAMPLES - 1);
      straight[2 * k] = across ? along : at;
      straight[2 * k + 1] = across ? at : along;
    }
    before.path(map(straight), "mesh");
    after.path([straight[0], straight[1], straight[2 * SAMPLES - 2], straight[2 * SAMPLES - 1]], "mesh");
  }
}

/** From where a point was to where it goes, the frame aside. */
function drawArrows(before, after, blended, window) {
  const target = targetLattice(ARROWS, ARROWS, 1 - 1 / ARROWS), source = blended.continued(1)(target);
  for (let i = 0; i < target.length; i += 2) {
    const from = [source[i], source[i + 1]], to = [target[i], target[i + 1]];
    arrow(before, from, to);
    const head = to.map((value, axis) => (value - [window.x, window.y][axis]) / window.half);
    arrow(after, head.map((value, axis) => value + (from[axis] - to[axis]) / window.half), head);
  }
}

function arrow(overlay, from, to) {
  const dx = ((to[0] - from[0]) / 2) * overlay.width, dy = ((to[1] - from[1]) / 2) * overlay.height;
  const length = Math.hypot(dx, dy);
  if (length < 0.75) return;
  overlay.path([...from, ...to], "arrow");
  const size = Math.min(7, 2 + length / 3) / length;
  const wing = (turn) => {
    const c = Math.cos(turn), s = Math.sin(turn);
    const x = (-dx * c + dy * s) * size, y = (-dx * s - dy * c) * size;
    return [to[0] + (2 * x) / overlay.width, to[1] + (2 * y) / overlay.height];
  };
  overlay.path([...wing(0.5), ...to, ...wing(-0.5)], "arrow");
}
