// The search for the crop and the full window of a grid: domain/windows.py, step for step, so that the page shows at once
// what the service will render. A window {x, y, half} is an upright part of the target plane with the picture's aspect.

import { cellOrientations, targetLattice } from "./lattice.js";
import { solve } from "./homography.js";

const EXTENT = 2;
const POINTS = 129;
const SPACING = (2 * EXTENT) / (POINTS - 1);
const MOST_RIM_POINTS = 65;
const BORDER_POINTS = 65;
const STEP = 1e-3;

export class NothingShown extends Error {}

export const towards = (from, to, share) => ({
  x: from.x + share * (to.x - from.x),
  y: from.y + share * (to.y - from.y),
  half: from.half + share * (to.half - from.half),
});

/** Flat points of [-1, 1]^2 -> flat points of the window. */
export function inWindow(window, points) {
  const made = new Float64Array(points.length);
  for (let i = 0; i < points.length; i += 2) {
    made[i] = points[i] * window.half + window.x;
    made[i + 1] = points[i + 1] * window.half + window.y;
  }
  return made;
}

export function allWithin(source) {
  return source.every((value) => Math.abs(value) <= 1);
}

const evenly = (count) => Array.from({ length: count }, (_, i) => (i === count - 1 ? 1 : -1 + (2 * i) / (count - 1)));

/** Flat points of the boundary of [-1, 1]^2. */
function boundary(rows, columns) {
  const points = [];
  for (const side of [-1, 1]) for (const x of columns) points.push(x, side);
  for (const side of [-1, 1]) for (const y of rows) points.push(side, y);
  return Float64Array.from(points);
}

export class WindowSearch {
  constructor(lattice) {
    this.backward = lattice.continued(EXTENT);
    this.lattice = lattice;
    this.points = targetLattice(POINTS, POINTS, EXTENT);
    this.source = this.backward(this.points);
    this.rim = boundary(...[lattice.rows, lattice.columns].map((count) => evenly(Math.min(count, MOST_RIM_POINTS))));
    this.shown = this.findShown();
  }

  findShown() {
    const { source } = this, count = POINTS * POINTS, visible = new Uint8Array(count);
    for (let i = 0; i < count; i++) visible[i] = Math.abs(source[2 * i]) <= 1 && Math.abs(source[2 * i + 1]) <= 1 ? 1 : 0;
    const areas = cellOrientations(source, POINTS, POINTS);
    let positive = 0, touching = 0;
    this.eachCell((cell, a) => {
      if (!(visible[a] | visible[a + 1] | visible[a + POINTS] | visible[a + POINTS + 1])) return;
      touching += 4;
      for (let k = 0; k < 4; k++) positive += areas[4 * cell + k] > 0 ? 1 : 0;
    });
    if (!touching) throw new NothingShown();
    this.sign = positive > touching / 2 ? 1 : -1;
    const candidate = visible.slice();
    this.eachCell((cell, a) => {
      let kept = true;
      for (let k = 0; k < 4; k++) kept &&= areas[4 * cell + k] * this.sign > 0;
      if (!kept) candidate[a] = candidate[a + 1] = candidate[a + POINTS] = candidate[a + POINTS + 1] = 0;
    });
    let seed = -1, nearest = Infinity;
    for (let i = 0; i < count; i++) {
      const distance = this.points[2 * i] ** 2 + this.points[2 * i + 1] ** 2;
      if (candidate[i] && distance < nearest) [seed, nearest] = [i, distance];
    }
    if (seed < 0) throw new NothingShown();
    return connected(candidate, seed);
  }

  eachCell(visit) {
    for (let r = 0, cell = 0; r < POINTS - 1; r++) for (let c = 0; c < POINTS - 1; c++, cell++) visit(cell, r * POINTS + c);
  }

  /** The largest window without an invalid point. */
  crop() {
    const wide = POINTS + 1, sums = new Int32Array(wide * wide);
    for (let r = 0; r < POINTS; r++) {
      for (let c = 0; c < POINTS; c++) {
        sums[(r + 1) * wide + c + 1] = this.shown[r * POINTS + c] + sums[r * wide + c + 1] + sums[(r + 1) * wide + c] - sums[r * wide + c];
      }
    }
    const places = (size, visit) => {
      for (let r = 0; r + size <= POINTS; r++) {
        for (let c = 0; c + size <= POINTS; c++) {
          const total = sums[(r + size) * wide + c + size] + sums[r * wide + c] - sums[r * wide + c + size] - sums[(r + size) * wide + c];
          if (total === size * size && visit(r, c)) return true;
        }
      }
      return false;
    };
    let low = 1, high = POINTS;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (places(middle, () => true)) low = middle; else high = middle - 1;
    }
    const half = ((low - 1) * SPACING) / 2;
    let window = null, nearest = Infinity;
    places(low, (r, c) => {
      const x = this.points[2 * (r * POINTS + c)] + half, y = this.points[2 * (r * POINTS + c) + 1] + half;
      if (Math.hypot(x, y) < nearest) [window, nearest] = [{ x, y, half }, Math.hypot(x, y)];
      return false;
    });
    const grown = this.grown(window);
    const share = [1, 0.75, 0.5, 0.25].find((one) => this.isUnfolded(towards(window, grown, one)));
    return share === undefined ? window : towards(window, grown, share);
  }

  /** The smallest window that holds everything shown and the target of the source's border. */
  full() {
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    const hold = (x, y) => {
      low[0] = Math.min(low[0], x); high[0] = Math.max(high[0], x);
      low[1] = Math.min(low[1], y); high[1] = Math.max(high[1], y);
    };
    for (let i = 0; i < this.shown.length; i++) if (this.shown[i]) hold(this.points[2 * i], this.points[2 * i + 1]);
    const targets = this.borderTargets();
    for (let i = 0; i < targets.length; i += 2) hold(targets[i], targets[i + 1]);
    return { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, half: Math.max(high[0] - low[0], high[1] - low[1]) / 2 };
  }

  grown(start) {
    const { rim } = this, count = rim.length / 2;
    let window = this.largest(start, start.half, start.half + 2 * SPACING), trust = 4 * SPACING;
    for (let round = 0; round < 16; round++) {
      const at = inWindow(window, rim), source = this.backward(at), [byX, byY] = this.slopes(at);
      const normals = [], slack = [];
      for (let i = 0; i < count; i++) {
        for (const a of [2 * i, 2 * i + 1]) {
          const slope = [byX[a], byY[a], byX[a] * rim[2 * i] + byY[a] * rim[2 * i + 1]];
          normals.push(slope, slope.map((value) => -value));
          slack.push(Math.max(1 - source[a], 1e-7), Math.max(1 + source[a], 1e-7));
        }
      }
      for (const sign of [1, -1]) for (let a = 0; a < 3; a++) { normals.push([0, 1, 2].map((b) => (a === b ? sign : 0))); slack.push(Math.max(trust, 1e-7)); }
      const [x, y, half] = highest(normals, slack);
      const moved = { x: window.x + x, y: window.y + y, half: window.half + half };
      const better = this.largest(moved, window.half, window.half + 1.5 * Math.max(half, 1e-6));
      const gain = better.half - window.half;
      if (gain > 0 && allWithin(this.backward(inWindow(better, rim)))) window = better;
      if (gain <= 0.3 * half) trust /= 4;
      if (trust < 1e-5 || half < 1e-6) break;
    }
    return window;
  }

  largest({ x, y }, least, most) {
    let low = least, high = most;
    for (let round = 0; round < 3; round++) {
      const halves = Array.from({ length: 16 }, (_, i) => low + ((high - low) * (i + 1)) / 16);
      let first = halves.findIndex((half) => !allWithin(this.backward(inWindow({ x, y, half }, this.rim))));
      if (first < 0) first = halves.length;
      low = first ? halves[first - 1] : low;
      high = halves[Math.min(first, halves.length - 1)];
    }
    return { x, y, half: low };
  }

  isUnfolded(window) {
    const { rows, columns } = this.lattice;
    const source = this.backward(inWindow(window, targetLattice(rows, columns)));
    return cellOrientations(source, rows, columns).every((area) => area * this.sign > 0);
  }

  slopes(at) {
    return [0, 1].map((axis) => {
      const after = at.slice(), before = at.slice();
      for (let i = axis; i < at.length; i += 2) { after[i] += STEP; before[i] -= STEP; }
      const high = this.backward(after), low = this.backward(before);
      return high.map((value, i) => (value - low[i]) / (2 * STEP));
    });
  }

  /** Targets of points of the source's border, by Newton steps from the nearest shown sample. */
  borderTargets() {
    const side = evenly(BORDER_POINTS), border = boundary(side, side), edge = this.edgeSamples();
    const at = new Float64Array(border.length);
    for (let i = 0; i < border.length; i += 2) {
      let nearest = Infinity, best = edge[0];
      for (const sample of edge) {
        const distance = (border[i] - this.source[2 * sample]) ** 2 + (border[i + 1] - this.source[2 * sample + 1]) ** 2;
        if (distance < nearest) [nearest, best] = [distance, sample];
      }
      at[i] = this.points[2 * best];
      at[i + 1] = this.points[2 * best + 1];
    }
    const determinants = new Float64Array(border.length / 2);
    for (let round = 0; round < 12; round++) {
      const [byX, byY] = this.slopes(at), source = this.backward(at);
      for (let i = 0; i < at.length; i += 2) {
        const determinant = byX[i] * byY[i + 1] - byX[i + 1] * byY[i];
        const safe = Math.abs(determinant) < 1e-3 ? 1e-3 * this.sign : determinant;
        const rx = source[i] - border[i], ry = source[i + 1] - border[i + 1];
        const moves = [(rx * byY[i + 1] - ry * byY[i]) / safe, (ry * byX[i] - rx * byX[i + 1]) / safe];
        for (const a of [0, 1]) {
          const move = Math.min(Math.max(moves[a], -0.25), 0.25);
          at[i + a] = Math.min(Math.max(at[i + a] - move, -EXTENT), EXTENT);
        }
        determinants[i / 2] = determinant;
      }
    }
    const source = this.backward(at), found = [];
    for (let i = 0; i < at.length; i += 2) {
      const error = Math.max(Math.abs(source[i] - border[i]), Math.abs(source[i + 1] - border[i + 1]));
      if (error < 1e-6 && determinants[i / 2] * this.sign > 0) found.push(at[i], at[i + 1]);
    }
    return found;
  }

  /** Indices of shown samples with a neighbour that is not. */
  edgeSamples() {
    const is = (r, c) => r >= 0 && c >= 0 && r < POINTS && c < POINTS && this.shown[r * POINTS + c];
    const found = [];
    for (let r = 0; r < POINTS; r++) {
      for (let c = 0; c < POINTS; c++) {
        if (is(r, c) && !(is(r - 1, c) && is(r + 1, c) && is(r, c - 1) && is(r, c + 1))) found.push(r * POINTS + c);
      }
    }
    return found;
  }
}

function connected(mask, seed) {
  const part = new Uint8Array(mask.length), open = [seed];
  part[seed] = 1;
  while (open.length) {
    const at = open.pop(), column = at % POINTS;
    const next = [at - POINTS, at + POINTS, column ? at - 1 : -1, column < POINTS - 1 ? at + 1 : -1];
    for (const one of next) if (one >= 0 && one < mask.length && mask[one] && !part[one]) { part[one] = 1; open.push(one); }
  }
  return part;
}

/** The z with the largest z[2] where normals z <= slack, by a logarithmic barrier. */
function highest(normals, slack) {
  let point = [0, 0, 0], left = slack, weight = 1 / Math.max(...slack);
  for (let round = 0; round < 40; round++) {
    const gradient = [0, 0, -weight], curvature = [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]];
    normals.forEach((normal, i) => {
      const inverse = 1 / left[i];
      for (let a = 0; a < 3; a++) {
        gradient[a] += normal[a] * inverse;
        for (let b = 0; b < 3; b++) curvature[a][b] += normal[a] * normal[b] * inverse * inverse;
      }
    });
    const trace = curvature[0][0] + curvature[1][1] + curvature[2][2];
    curvature.forEach((row, a) => { row[a] += 1e-12 * trace; row[3] = -gradient[a]; });
    const step = solve(curvature);
    let length = 1;
    normals.forEach((normal, i) => {
      const change = normal[0] * step[0] + normal[1] * step[1] + normal[2] * step[2];
      if (change > 0) length = Math.min(length, (0.9 * left[i]) / change);
    });
    point = point.map((value, a) => value + length * step[a]);
    left = slack.map((value, i) => value - normals[i][0] * point[0] - normals[i][1] * point[1] - normals[i][2] * point[2]);
    if (length > 0.5) weight *= 6;
    if (weight > 1e9) break;
  }
  return point;
}
