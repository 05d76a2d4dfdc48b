// Lattices: source points for a regular lattice over the target, as domain/grid.py and domain/continuation.py have them.
//
// Coordinates are centred: [-1, 1] to the right and down. Points lie in flat arrays, x before y, row after row.

export const MAX_SOURCE = 16;
const FARTHEST = 3;
const LARGEST_BEND = 1;
const BLENDED = 0.125;

/** Flat (rows x columns) points evenly spaced over [-extent, extent]. */
export function targetLattice(rows, columns, extent = 1) {
  const points = new Float64Array(2 * rows * columns);
  for (let r = 0, at = 0; r < rows; r++) {
    for (let c = 0; c < columns; c++) {
      points[at++] = spaced(c, columns, extent);
      points[at++] = spaced(r, rows, extent);
    }
  }
  return points;
}

function spaced(index, count, extent) {
  return index === count - 1 ? extent : -extent + index * ((2 * extent) / (count - 1));
}

export class Lattice {
  /** @param {ArrayLike<number>} source rows x columns points; kept as float32, which is what travels. */
  constructor(rows, columns, source) {
    this.rows = rows;
    this.columns = columns;
    this.source = source instanceof Float32Array ? source : Float32Array.from(source);
  }

  static identity(rows, columns = rows) {
    return new Lattice(rows, columns, targetLattice(rows, columns));
  }

  /** From the `grid` object of the API. */
  static fromJson(grid) {
    const source = new Float32Array(2 * grid.source.length);
    grid.source.forEach(([x, y], i) => { source[2 * i] = x; source[2 * i + 1] = y; });
    return new Lattice(grid.rows, grid.columns, source);
  }

  toJson() {
    const source = [];
    for (let i = 0; i < this.source.length; i += 2) source.push([this.source[i], this.source[i + 1]]);
    return { rows: this.rows, columns: this.columns, source };
  }

  get isIdentity() {
    const target = targetLattice(this.rows, this.columns);
    return this.source.every((value, i) => value === Math.fround(target[i]));
  }

  /** Mean length of source - target, in half picture widths. */
  get displacement() {
    const target = targetLattice(this.rows, this.columns);
    let sum = 0;
    for (let i = 0; i < target.length; i += 2) sum += Math.hypot(this.source[i] - target[i], this.source[i + 1] - target[i + 1]);
    return sum / (target.length / 2);
  }

  get isUnfolded() {
    return foldedShare(this.source, this.rows, this.columns) === 0;
  }

  /** The backward map, flat target points -> flat source points, continued over [-extent, extent]. */
  continued(extent) {
    return continuedMap(this, extent);
  }
}

/** Signed areas of the four corner triangles of each cell, 4 (rows - 1) (columns - 1) of them. */
export function cellOrientations(source, rows, columns) {
  const areas = new Float64Array(4 * (rows - 1) * (columns - 1));
  const cross = (p, q, r) => (source[q] - source[p]) * (source[r + 1] - source[p + 1])
    - (source[q + 1] - source[p + 1]) * (source[r] - source[p]);
  for (let r = 0, at = 0; r < rows - 1; r++) {
    for (let c = 0; c < columns - 1; c++) {
      const a = 2 * (r * columns + c), b = a + 2, d = a + 2 * columns, e = d + 2;
      areas[at++] = cross(a, b, d);
      areas[at++] = cross(b, e, a);
      areas[at++] = cross(e, d, b);
      areas[at++] = cross(d, a, e);
    }
  }
  return areas;
}

/** Share of the cells that show some of the source and do not keep the orientation of the others. */
export function foldedShare(source, rows, columns) {
  const areas = cellOrientations(source, rows, columns);
  const visible = [];
  for (let r = 0; r < rows - 1; r++) {
    for (let c = 0; c < columns - 1; c++) {
      const a = 2 * (r * columns + c), corners = [a, a + 2, a + 2 * columns, a + 2 * columns + 2];
      const shows = [0, 1].every((axis) => {
        const values = corners.map((corner) => source[corner + axis]);
        return Math.min(...values) <= 1 && Math.max(...values) >= -1;
      });
      if (shows) visible.push(4 * (r * (columns - 1) + c));
    }
  }
  if (!visible.length) return 1;
  let positive = 0;
  for (const cell of visible) for (let k = 0; k < 4; k++) positive += areas[cell + k] > 0 ? 1 : 0;
  const sign = positive > 2 * visible.length ? 1 : -1;
  const folded = visible.filter((cell) => [0, 1, 2, 3].some((k) => areas[cell + k] * sign <= 0));
  return folded.length / visible.length;
}

function continuedMap(lattice, extent) {
  let { rows, columns } = lattice;
  let points = Float64Array.from(lattice.source);
  let rowMargin = 0, columnMargin = 0;
  const outside = Math.min(extent, FARTHEST) - 1;
  if (outside > 0) {
    rowMargin = Math.ceil((outside / 2) * (rows - 1)) + 1;
    columnMargin = Math.ceil((outside / 2) * (columns - 1)) + 1;
    points = continueLines(points, rows, columns, rowMargin, false);
    rows += 2 * rowMargin;
    points = continueLines(points, rows, columns, columnMargin, true);
    columns += 2 * columnMargin;
  }
  const across = (columns - 2 * columnMargin - 1) / 2, down = (rows - 2 * rowMargin - 1) / 2;
  return (target, out = new Float64Array(target.length)) => {
    for (let i = 0; i < target.length; i += 2) {
      const column = (target[i] + 1) * across + columnMargin, row = (target[i + 1] + 1) * down + rowMargin;
      const c = Math.trunc(Math.min(Math.max(column, 0), columns - 2));
      const r = Math.trunc(Math.min(Math.max(row, 0), rows - 2));
      const u = column - c, v = row - r, at = 2 * (r * columns + c), below = at + 2 * columns;
      for (let axis = 0; axis < 2; axis++) {
        const top = points[at + axis] * (1 - u) + points[at + 2 + axis] * u;
        const bottom = points[below + axis] * (1 - u) + points[below + 2 + axis] * u;
        out[i + axis] = top * (1 - v) + bottom * v;
      }
    }
    return out;
  };
}

/** Adds `margin` rows before and after, or columns if `sideways`. */
function continueLines(points, rows, columns, margin, sideways) {
  const count = sideways ? columns : rows, lines = sideways ? rows : columns;
  const newColumns = sideways ? columns + 2 * margin : columns;
  const made = new Float64Array(2 * (sideways ? rows : rows + 2 * margin) * newColumns);
  const index = (line, i, width) => 2 * (sideways ? line * width + i : i * width + line);
  const inwards = new Float64Array(2 * count);
  for (let line = 0; line < lines; line++) {
    for (let i = 0; i < count; i++) {
      const from = index(line, i, columns), to = index(line, i + margin, newColumns);
      made[to] = points[from];
      made[to + 1] = points[from + 1];
    }
    for (const end of [0, 1]) {
      for (let i = 0; i < count; i++) {
        const from = index(line, end ? count - 1 - i : i, columns);
        inwards[2 * i] = points[from];
        inwards[2 * i + 1] = points[from + 1];
      }
      const more = beyond(inwards, count, margin);
      for (let k = 1; k <= margin; k++) {
        const to = index(line, end ? margin + count - 1 + k : margin - k, newColumns);
        made[to] = more[2 * k - 2];
        made[to + 1] = more[2 * k - 1];
      }
    }
  }
  return made;
}

/** `margin` points outside the first of a line of points, nearest first; see domain/continuation.py for the why. */
function beyond(line, count, margin) {
  const made = new Float64Array(2 * margin);
  if (count < 5) {
    for (let k = 1; k <= margin; k++) for (const a of [0, 1]) made[2 * k - 2 + a] = line[a] + k * (line[a] - line[2 + a]);
    return made;
  }
  const step = Math.max(1, Math.floor((count - 1) / 8));
  const pace = [0, 0], change = [0, 0];
  for (const a of [0, 1]) {
    const edge = line[a], inner = line[2 * step + a], innermost = line[4 * step + a];
    pace[a] = (3 * edge - 4 * inner + innermost) / 2;
    change[a] = edge - 2 * inner + innermost;
  }
  const squared = Math.max(pace[0] ** 2 + pace[1] ** 2, 1e-12);
  const ratio = (change[0] * pace[0] + change[1] * pace[1]) / squared;
  const bend = Math.min(Math.max(ratio, -LARGEST_BEND), LARGEST_BEND);
  const slackening = Math.min(bend, -1e-6);
  for (let distance = 1; distance <= margin; distance++) {
    const k = distance / step;
    const along = bend >= 0 ? k + (bend * k ** 2) / 2 : Math.log1p(-slackening * k) / -slackening;
    const across = k <= 2 ? k ** 2 / 2 : 2 * k - 2;
    for (const a of [0, 1]) {
      const edge = line[a], far = Math.abs(edge), side = Math.sign(edge);
      const curved = edge + along * pace[a] + across * (change[a] - ratio * pace[a]);
      const bound = far < 1 + BLENDED ? 0.5 + ((far - 1) * (0.5 + BLENDED)) / BLENDED : far;
      made[2 * distance - 2 + a] = far > 1 ? side * Math.max(side * curved, bound) : curved;
    }
  }
  return made;
}
