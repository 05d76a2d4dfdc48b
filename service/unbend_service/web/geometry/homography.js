// The plane part of a map, as domain/homography.py has it.

import { targetLattice } from "./lattice.js";

const LATTICE_POINTS = 33;

export class NoPlanePart extends Error {}

/** [x, y] of a row-major 3x3 matrix on (x, y); points behind the horizon of the middle are put far out. */
export function apply(m, x, y) {
  const side = m[8] < 0 ? -1 : 1, w = Math.max((m[6] * x + m[7] * y + m[8]) * side, 1e-3) * side;
  return [(m[0] * x + m[1] * y + m[2]) / w, (m[3] * x + m[4] * y + m[5]) / w];
}

/** Gaussian elimination with pivoting; `rows` are [coefficients..., right side]. */
export function solve(rows) {
  const n = rows.length;
  for (let i = 0; i < n; i++) {
    let pivot = i;
    for (let k = i + 1; k < n; k++) if (Math.abs(rows[k][i]) > Math.abs(rows[pivot][i])) pivot = k;
    [rows[i], rows[pivot]] = [rows[pivot], rows[i]];
    for (let k = i + 1; k < n; k++) {
      const share = rows[k][i] / rows[i][i];
      if (share) for (let j = i; j <= n; j++) rows[k][j] -= share * rows[i][j];
    }
  }
  const found = new Array(n).fill(0);
  for (let i = n - 1; i >= 0; i--) {
    let rest = rows[i][n];
    for (let j = i + 1; j < n; j++) rest -= rows[i][j] * found[j];
    found[i] = rest / rows[i][i];
  }
  return found;
}

function median(values) {
  const sorted = Float64Array.from(values).sort(), half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
}

/** Robust least squares homography target -> source over flat points. */
export function fitHomography(target, source) {
  const count = target.length / 2, weight = new Float64Array(count).fill(1);
  let matrix = [1, 0, 0, 0, 1, 0, 0, 0, 1];
  for (let round = 0; round < 12; round++) {
    const normal = Array.from({ length: 8 }, () => new Float64Array(9));
    for (let i = 0; i < count; i++) {
      const x = target[2 * i], y = target[2 * i + 1], u = source[2 * i], v = source[2 * i + 1];
      for (const row of [[x, y, 1, 0, 0, 0, -u * x, -u * y, u], [0, 0, 0, x, y, 1, -v * x, -v * y, v]]) {
        for (let a = 0; a < 8; a++) {
          const scaled = weight[i] * row[a];
          if (scaled) for (let b = 0; b < 9; b++) normal[a][b] += scaled * row[b];
        }
      }
    }
    const solution = solve(normal);
    if (!solution.every(Number.isFinite)) throw new NoPlanePart();
    const previous = matrix;
    matrix = [...solution, 1];
    if (Math.max(...matrix.map((value, i) => Math.abs(value - previous[i]))) < 1e-10) break;
    const residual = new Float64Array(count);
    for (let i = 0; i < count; i++) {
      const [x, y] = apply(matrix, target[2 * i], target[2 * i + 1]);
      residual[i] = Math.hypot(x - source[2 * i], y - source[2 * i + 1]);
    }
    const scale = Math.max(2.4 * median(residual), 1e-6);
    for (let i = 0; i < count; i++) {
      const w = Math.max(Math.abs(matrix[6] * target[2 * i] + matrix[7] * target[2 * i + 1] + 1), 0.1);
      weight[i] = 1 / w ** 2 / (1 + (residual[i] / scale) ** 2);
    }
  }
  return matrix;
}

/** The homography that fits a map (flat points -> flat points) best over what it shows. */
export function planePart(map) {
  const all = targetLattice(LATTICE_POINTS, LATTICE_POINTS), shown = map(all);
  const target = [], source = [];
  for (let i = 0; i < all.length; i += 2) {
    if (Math.abs(shown[i]) <= 1.1 && Math.abs(shown[i + 1]) <= 1.1) {
      target.push(all[i], all[i + 1]);
      source.push(shown[i], shown[i + 1]);
    }
  }
  if (target.length < 32) throw new NoPlanePart();
  return fitHomography(target, source);
}

export function inverse(m) {
  const cofactor = (a, b, c, d) => m[a] * m[d] - m[b] * m[c];
  const determinant = m[0] * cofactor(4, 5, 7, 8) - m[1] * cofactor(3, 5, 6, 8) + m[2] * cofactor(3, 4, 6, 7);
  if (Math.abs(determinant) < 1e-6) throw new NoPlanePart();
  return [
    cofactor(4, 5, 7, 8), -cofactor(1, 2, 7, 8), cofactor(1, 2, 4, 5),
    -cofactor(3, 5, 6, 8), cofactor(0, 2, 6, 8), -cofactor(0, 2, 3, 5),
    cofactor(3, 4, 6, 7), -cofactor(0, 1, 6, 7), cofactor(0, 1, 3, 4),
  ].map((value) => value / determinant);
}
