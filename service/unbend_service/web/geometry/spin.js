// From guides to the lattice that the service would spin from them, as domain/decision.py has it.

import { GuideMap } from "./guides.js";
import { apply, inverse, planePart } from "./homography.js";
import { Lattice, targetLattice } from "./lattice.js";

/** @param {"nonlinear" | "all"} correct Throws GuidesDoNotMeet or NoPlanePart. */
export function spin(guides, correct, points) {
  const map = new GuideMap(guides), target = targetLattice(points, points);
  if (correct === "nonlinear") {
    const back = inverse(planePart((all) => map.points(all)));
    for (let i = 0; i < target.length; i += 2) {
      [target[i], target[i + 1]] = apply(back, target[i], target[i + 1]);
    }
  }
  return new Lattice(points, points, map.points(target));
}
