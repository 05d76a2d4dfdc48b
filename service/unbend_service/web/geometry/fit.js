// Strength and fit, as domain/fit.py has them: what the page previews is what the service renders.

import { Lattice, MAX_SOURCE, foldedShare, targetLattice } from "./lattice.js";
import { NothingShown, WindowSearch, allWithin, inWindow, towards } from "./windows.js";

const ROUNDING = 1e-5;
const SMALLEST_WINDOW = 1e-3;
export const WHOLE = { x: 0, y: 0, half: 1 };

/** Blend with the identity. */
export function withStrength(lattice, strength) {
  if (strength === 1) return lattice;
  const target = targetLattice(lattice.rows, lattice.columns);
  return new Lattice(lattice.rows, lattice.columns, target.map((at, i) => at + strength * (lattice.source[i] - at)));
}

/** Windows depend on the lattice alone: another fit of the same one costs nothing. */
const windows = new WeakMap();

function searched(lattice) {
  let found = windows.get(lattice);
  if (!found) windows.set(lattice, (found = { search: new WindowSearch(lattice) }));
  return found;
}

/**
 * @param {number | null} zoomOut null keeps the frame; 0 crops; 1 shows every source pixel.
 * @returns {{lattice: Lattice, window: {x: number, y: number, half: number}}}
 */
export function withFit(lattice, zoomOut) {
  if (zoomOut === null || lattice.isIdentity) return { lattice, window: WHOLE };
  const target = targetLattice(lattice.rows, lattice.columns), found = searched(lattice);
  const crop = (found.crop ??= found.search.crop());
  const cropped = (found.cropped ??= withoutGaps(lattice, crop, target));
  if (zoomOut === 0) return cropped;
  const full = (found.full ??= found.search.full());
  for (let share = zoomOut; share > 0.01; share *= 0.9) {
    const window = towards(crop, full, share), source = shown(lattice, window, target);
    if (foldedShare(source, lattice.rows, lattice.columns) === 0) {
      return { lattice: new Lattice(lattice.rows, lattice.columns, source), window };
    }
  }
  return cropped;
}

function shown(lattice, window, target) {
  const points = inWindow(window, target);
  let extent = 0;
  for (const value of points) extent = Math.max(extent, Math.abs(value));
  const source = lattice.continued(extent)(points);
  return Float32Array.from(source, (value) => {
    const far = Math.abs(value);
    if (far > 1 && far < 1 + ROUNDING) return Math.sign(value);
    return Math.min(Math.max(value, -MAX_SOURCE), MAX_SOURCE);
  });
}

function withoutGaps(lattice, start, target) {
  let window = start;
  for (let round = 0; round < 200; round++) {
    const source = shown(lattice, window, target);
    if (window.half > SMALLEST_WINDOW && allWithin(source) && foldedShare(source, lattice.rows, lattice.columns) === 0) {
      return { lattice: new Lattice(lattice.rows, lattice.columns, source), window };
    }
    window = { ...window, half: window.half * 0.99 };
  }
  throw new NothingShown();
}
