// What was decided, in sentences.

import { isDoubted } from "./state.js";

const percent = (share) => `${Math.round(100 * share)}\u00a0%`;

function trust({ confidence, confidence_kind: kind }) {
  if (kind === "calibrated_probability") return `The service is ${percent(confidence)} sure that this makes the picture better.`;
  if (kind === "mirror_agreement") return `The estimate agrees to ${percent(confidence)} with the one of the mirrored picture.`;
  return "";
}

const ALONE = {
  low_confidence: [
    "Left as it is",
    (record) =>
      record.confidence_kind === "calibrated_probability"
        ? `The service is ${percent(record.confidence)} sure that a correction would make this picture better. That is less than it asks for, since a wrong correction is worse than none.`
        : `The distortion could not be told with enough certainty (${percent(record.confidence)}), and a wrong correction is worse than none.`,
  ],
  nothing_to_correct: ["Left as it is", () => "Nothing in this picture is bent by more than a fraction of a pixel, so nothing was changed."],
  folded: ["Left as it is", () => "The estimated correction would fold the picture over itself, so nothing was changed."],
};

/** @returns {{title: string, sentence: string}} */
export function verdict(state, derived) {
  const { record } = state;
  const share = percent(derived.weakened);
  const weaker = derived.weakened < 1 ? ` Only ${share} of the correction is applied; more would fold the picture.` : "";
  if (state.edited) return { title: "Straightened by hand", sentence: `The picture follows your guides.${weaker}` };
  if (record.outcome === "left_alone" && !state.anyway) {
    const [title, sentence] = ALONE[record.reason] ?? ["Left as it is", () => "Nothing was changed."];
    return { title, sentence: sentence(record) };
  }
  const moved = (derived.blended.displacement * state.picture.width) / 2;
  const moves = `On average a point moves by ${moved < 10 ? moved.toFixed(1) : Math.round(moved)}\u00a0pixels.`;
  if (state.anyway) {
    const itself = record.outcome === "left_alone" ? "left the picture alone" : `applied ${percent(record.strength)} of it`;
    return { title: "Corrected at your word", sentence: `${moves} The service itself would have ${itself}.` };
  }
  if (isDoubted()) {
    const doubt = `${trust(record)} In doubt only ${share} of the correction is applied.`;
    return { title: "Straightened a little", sentence: `${moves} ${doubt}` };
  }
  return { title: "Straightened", sentence: `${moves} ${trust(record)}${weaker}`.trim() };
}

export function facts({ picture, record }) {
  const found = { Picture: `${picture.width} × ${picture.height}` };
  if (picture.preview.width < picture.width) found.Preview = `${picture.preview.width} × ${picture.preview.height}`;
  if (record.model) found.Model = record.model;
  return found;
}
