// Cubic least squares through points along a feature, as domain/annotation.py computes them when they are saved.

import { solve } from "../geometry/homography.js";

export const DEGREE = 3;
export const LEAST_POINTS = DEGREE + 1;
export const CURVES = [
  { family: "rows", index: 0, name: "Upper row" },
  { family: "rows", index: 1, name: "Lower row" },
  { family: "columns", index: 0, name: "Left column" },
  { family: "columns", index: 1, name: "Right column" },
];

const distinct = (points, axis) => new Set(points.map((point) => point[axis])).size;

/** Whether the points determine a cubic. */
export function isComplete(points, family) {
  return distinct(points, family === "rows" ? 0 : 1) >= LEAST_POINTS;
}

/** The coefficients, of a lower degree while points are too few; null without points. */
export function fit(points, family) {
  const [along, across] = family === "rows" ? [0, 1] : [1, 0];
  const terms = Math.min(DEGREE, distinct(points, along) - 1) + 1;
  if (!terms) return null;
  const normal = Array.from({ length: terms }, () => new Float64Array(terms + 1));
  for (const point of points) {
    for (let i = 0; i < terms; i++) {
      for (let j = 0; j < terms; j++) normal[i][j] += point[along] ** (i + j);
      normal[i][terms] += point[along] ** i * point[across];
    }
  }
  return solve(normal);
}
