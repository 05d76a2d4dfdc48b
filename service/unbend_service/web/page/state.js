// What the page knows, in one place. Views subscribe; nothing else is shared.

import { withFit, withStrength } from "../geometry/fit.js";
import { GuidesDoNotMeet } from "../geometry/guides.js";
import { NoPlanePart } from "../geometry/homography.js";
import { Lattice } from "../geometry/lattice.js";
import { spin } from "../geometry/spin.js";
import { NothingShown } from "../geometry/windows.js";

const STRENGTHS = [1, 0.75, 0.5, 0.25];

export const state = {
  picture: null, // {name, body, preview, width, height}
  record: null, // what /v1/estimate said
  guides: null, // as they are now
  edited: false,
  anyway: false, // follow an estimate that the service did not trust
  correct: "nonlinear",
  strength: 1,
  fit: 0, // null: keep
  overlays: { guides: false, grid: false, arrows: false },
  view: "compare",
  active: { family: "rows", index: 0 },
  saved: null, // {id, lattice}
};

const listeners = new Set();

export function subscribe(listener) {
  listeners.add(listener);
}

export function update(changes) {
  Object.assign(state, changes);
  for (const listener of listeners) listener(state, changes);
}

export function open(picture, record) {
  update({
    picture, record, guides: record.guides && structuredClone(record.guides), edited: false, anyway: false,
    correct: "nonlinear", strength: 1, fit: 0, view: "compare", active: { family: "rows", index: 0 }, saved: null,
  });
}

/** Whether the picture stays as it is. */
export function isLeftAlone() {
  return state.record.outcome === "left_alone" && !state.edited && !state.anyway;
}

/** Whether the service did not trust the estimate enough to follow it all the way. */
export function isDoubted() {
  return state.record.reason === "low_confidence" && state.correct === "nonlinear" && !state.edited && !state.anyway;
}

/** Whether the grid in effect is, to the last bit, the one the service has under the id of its estimate. */
export function isEstimate() {
  return !state.edited && !state.anyway && state.correct === "nonlinear" && state.strength === 1;
}

/**
 * What follows from the state: {base, blended, fitted, window, weakened, folded}. `base` is the correction at full
 * strength, `blended` what is saved, `fitted` what is drawn. When the guides fold, the last ones that did not are kept.
 */
export function derive() {
  const { record, guides, edited, anyway, correct, strength, fit } = state;
  const base = find("base", [record, edited || anyway ? JSON.stringify(guides) : "", anyway, correct], makeBase);
  const blended = find("blended", [base, strength], () => withStrength(base.lattice, strength));
  const made = find("fitted", [blended, fit], () => fitted(blended, fit));
  return { base: base.lattice, weakened: base.share, blended, ...made, folded: base.folded || made.folded };
}

const known = new Map();
function find(name, key, make) {
  const entry = known.get(name);
  if (entry && entry.key.every((part, i) => part === key[i])) return entry.value;
  const value = make(entry?.value);
  known.set(name, { key, value });
  return value;
}

function makeBase(previous) {
  const { record, guides, correct } = state;
  const { rows } = record.grid;
  if (isLeftAlone()) return { lattice: Lattice.identity(rows), share: 1, folded: false };
  if (!state.edited && !state.anyway && correct === "nonlinear") {
    return { lattice: Lattice.fromJson(record.grid), share: record.strength, folded: false };
  }
  try {
    const whole = spin(guides, correct, rows);
    for (const share of STRENGTHS) {
      const lattice = withStrength(whole, share);
      if (lattice.isUnfolded) return { lattice, share, folded: false };
    }
  } catch (error) {
    if (!(error instanceof GuidesDoNotMeet || error instanceof NoPlanePart)) throw error;
  }
  return { lattice: previous?.lattice ?? Lattice.identity(rows), share: previous?.share ?? 1, folded: true };
}

function fitted(blended, fit) {
  try {
    const { lattice, window } = withFit(blended, fit);
    return { fitted: lattice, window, folded: false };
  } catch (error) {
    if (!(error instanceof NothingShown)) throw error;
    return { fitted: blended, window: { x: 0, y: 0, half: 1 }, folded: true };
  }
}
