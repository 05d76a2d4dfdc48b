// Guides and the backward map that they define, as domain/guides.py has them. Centred coordinates.
//
// A family is a list of {anchor, coefficients}; guides are {rows, columns}, the JSON of the API.

export const TRUSTED_EXTENT = 1.25;
const MAX_REACH = 8;
const LEAST_CROSSING = 0.02;

export class GuidesDoNotMeet extends Error {}

const clip = (value, bound) => Math.min(Math.max(value, -bound), bound);

/** Value of a polynomial at `argument`, along its tangent outside +-TRUSTED_EXTENT; `slope` is left in the second slot. */
export function polynomial(coefficients, argument, out = [0, 0], offset = 0, count = coefficients.length) {
  const inside = clip(argument, TRUSTED_EXTENT);
  let value = 0, slope = 0;
  for (let power = count - 1; power >= 0; power--) {
    slope = slope * inside + value;
    value = value * inside + coefficients[offset + power];
  }
  out[0] = value + slope * (argument - inside);
  out[1] = slope;
  return out;
}

function lagrange(nodes, position) {
  return nodes.map((node, i) => nodes.reduce((made, other, j) => (i === j ? made : (made * (position - other)) / (node - other)), 1));
}

function anchorBasis(anchors, position) {
  const inside = clip(position, TRUSTED_EXTENT);
  const basis = lagrange(anchors, inside), outside = position - inside;
  if (outside) {
    const step = 1e-5, after = lagrange(anchors, inside + step), before = lagrange(anchors, inside - step);
    basis.forEach((_, i) => { basis[i] += (outside * (after[i] - before[i])) / (2 * step); });
  }
  return basis;
}

/** Coefficients of the curve of a family that is straight at target `position`. */
function curveAt(family, position) {
  const basis = anchorBasis(family.map((guide) => guide.anchor), position);
  const curve = new Float64Array(family[0].coefficients.length);
  family.forEach((guide, k) => guide.coefficients.forEach((c, power) => {
    curve[power] += basis[k] * (power ? c : c - guide.anchor);
  }));
  curve[0] += position;
  return curve;
}

/** The map of the guides: (s, t) -> [x, y]; throws GuidesDoNotMeet where the curves stop to intersect inside the picture. */
export class GuideMap {
  constructor(guides) {
    this.guides = guides;
    this.known = [new Map(), new Map()];
    this.row = [0, 0];
    this.column = [0, 0];
  }

  /** Flat target points -> flat source points. */
  points(target) {
    const source = new Float64Array(target.length);
    for (let i = 0; i < target.length; i += 2) {
      const [x, y] = this.at(target[i], target[i + 1]);
      const reach = MAX_REACH / Math.max(Math.abs(x), Math.abs(y), MAX_REACH);
      source[i] = x * reach;
      source[i + 1] = y * reach;
    }
    return source;
  }

  at(s, t) {
    const found = this.meeting(s, t, 24);
    return found.met ? [found.x, found.y] : this.past(s, t);
  }

  /** Curves are wanted again and again for the same coordinate: a lattice has few different ones. */
  curve(side, position) {
    const known = this.known[side];
    let curve = known.get(position);
    if (!curve) {
      curve = curveAt(side ? this.guides.columns : this.guides.rows, position);
      if (known.size > 4096) known.clear();
      known.set(position, curve);
    }
    return curve;
  }

  meeting(s, t, steps) {
    const rowCurve = this.curve(0, t), columnCurve = this.curve(1, s);
    const { row, column } = this;
    let x = s, y = t, met = false;
    for (let n = 0; n < steps; n++) {
      polynomial(rowCurve, x, row);
      polynomial(columnCurve, y, column);
      const residualX = x - column[0], residualY = y - row[0];
      let determinant = 1 - row[1] * column[1];
      const size = Math.abs(residualX) + Math.abs(residualY);
      met = size < 1e-7 && determinant > LEAST_CROSSING;
      if (size < 1e-13 && met) break;
      if (Math.abs(determinant) < 0.05) determinant = 0.05;
      const stepX = (residualX + column[1] * residualY) / determinant;
      const stepY = (row[1] * residualX + residualY) / determinant;
      const damping = Math.min(1, 0.5 / Math.max(Math.abs(stepX), Math.abs(stepY), 1e-12));
      x -= damping * stepX;
      y -= damping * stepY;
    }
    return { x, y, met };
  }

  /** For a target at which the curves do not meet: further out along its ray, where nothing is shown. */
  past(s, t) {
    let low = 0, high = 1, last = this.meeting(0, 0, 24), { met } = last;
    for (let n = 0; n < 8; n++) {
      const share = (low + high) / 2, found = this.meeting(share * s, share * t, 10);
      if (found.met) { low = share; last = found; met = true; } else high = share;
    }
    const inside = Math.max(Math.abs(last.x), Math.abs(last.y)) < 1 && Math.max(Math.abs(s), Math.abs(t)) <= 1;
    if (!met || inside) throw new GuidesDoNotMeet();
    const before = this.meeting(0.9 * low * s, 0.9 * low * t, 24), run = Math.max(0.1 * low, 1e-9);
    let paceX = (last.x - before.x) / run, paceY = (last.y - before.y) / run;
    const slower = Math.min(1, 2 / Math.max(Math.hypot(paceX, paceY), 1e-9));
    paceX *= slower;
    paceY *= slower;
    return [last.x + paceX * (1 - low), last.y + paceY * (1 - low)];
  }
}

/** Chebyshev-Lobatto points of [-0.9, 0.9]: where the control points of a guide of this degree sit. */
export function controlPositions(degree) {
  return Array.from({ length: degree + 1 }, (_, n) => -0.9 * Math.cos((Math.PI * n) / degree));
}

export function valuesOf(coefficients) {
  return controlPositions(coefficients.length - 1).map((at) => polynomial(coefficients, at)[0]);
}

/** The polynomial through values at the control positions (Newton's divided differences). */
export function coefficientsOf(values) {
  const at = controlPositions(values.length - 1), differences = [...values];
  for (let order = 1; order < values.length; order++) {
    for (let i = values.length - 1; i >= order; i--) {
      differences[i] = (differences[i] - differences[i - 1]) / (at[i] - at[i - order]);
    }
  }
  let made = [differences[values.length - 1]];
  for (let i = values.length - 2; i >= 0; i--) {
    const next = [differences[i], ...made];
    made.forEach((c, power) => { next[power] -= c * at[i]; });
    made = next;
  }
  return made;
}
