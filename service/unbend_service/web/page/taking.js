// Taking the result away: the picture, a stored grid, snippets that use it, exports.

import { hasToken } from "../token.js";
import { correct, exportFormats, exported, saveGrid } from "./api.js";
import { derive, isEstimate, isLeftAlone, state } from "./state.js";

const LABELS = {
  json: "Grid (JSON)", npz: "OpenCV maps", "npz-fixed": "OpenCV maps, fixed point", "stmap-exr": "STMap (EXR)",
  "stmap-tiff": "STMap (TIFF)", ffmpeg: "ffmpeg maps",
};

/**
 * Stores the grid in effect, strength included, and returns its id. The frame is not part of it: it is asked for when
 * the grid is used, so that the same grid serves for every frame.
 */
export async function storedGrid() {
  if (isEstimate()) return state.record.grid_id;
  const { blended, weakened } = derive();
  if (state.saved?.lattice === blended) return state.saved.id;
  const { record, edited } = state;
  return saveGrid({
    grid: blended.toJson(), guides: state.guides, outcome: "corrected", strength: weakened * state.strength,
    confidence: edited ? 1 : record.confidence, confidence_kind: edited ? "given" : record.confidence_kind,
    model: edited ? "" : record.model,
  });
}

/** The `fit` of the API that the page shows now. */
export function fitOption() {
  if (state.fit === null) return "keep";
  return { 0: "crop", 1: "full" }[state.fit] ?? String(state.fit);
}

export async function downloadPicture() {
  const { body, name } = state.picture;
  if (isLeftAlone()) return hand(body, name);
  const { picture, format } = await correct(body, { grid_id: await storedGrid(), fit: fitOption() });
  return hand(picture, `${name.replace(/\.[^.]+$/, "")}-straight.${format === "jpeg" ? "jpg" : format}`);
}

export function snippets(id) {
  const fit = fitOption(), query = fit === "crop" ? "" : `&fit=${fit}`;
  const option = fit === "crop" ? "" : `, fit=${Number.isNaN(Number(fit)) ? `"${fit}"` : fit}`;
  const token = hasToken() ? ' -H "Authorization: Bearer $UNBEND_TOKEN"' : ""; // the client takes it from there by itself
  const tls = location.protocol === "https:" ? ", tls=True" : "";
  return {
    curl: `curl -sS --data-binary @photo.jpg${token} \\\n  '${location.origin}/v1/correct?grid_id=${id}${query}' -o straight.jpg`,
    python: [
      "import numpy as np, unbend", "from PIL import Image", "",
      'image = np.asarray(Image.open("photo.jpg").convert("RGB"))',
      `with unbend.Client("${location.hostname}:50051"${tls}) as client:`,
      `    straight = client.correct(image, grid="${id}"${option})`,
      'Image.fromarray(straight.image).save("straight.jpg")',
    ].join("\n"),
  };
}

/** [{label, take}] for every export that the service has. Maps of other programs carry the frame; the JSON does not. */
export async function exports(id) {
  return (await exportFormats()).map((format) => ({
    label: LABELS[format] ?? format,
    async take() {
      const { width, height } = state.picture;
      const { file, name } = await exported(id, format === "json" ? { format } : { format, width, height, fit: fitOption() });
      hand(file, name);
    },
  }));
}

function hand(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
