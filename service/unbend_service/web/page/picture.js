// A file made visible: decoded upright by the browser, reduced for the preview.

import { asPng } from "./api.js";

export const PREVIEW_LONGEST_PX = 1600;

/** @returns {Promise<{name: string, body: Blob, preview: HTMLCanvasElement, width: number, height: number}>} */
export async function decode(file, ready) {
  let bitmap;
  try {
    bitmap = await createImageBitmap(file);
  } catch {
    await ready; // the service says better than the browser what is wrong with a file
    bitmap = await createImageBitmap(await asPng(file));
  }
  const { width, height } = bitmap;
  const share = Math.min(1, PREVIEW_LONGEST_PX / Math.max(width, height));
  const preview = document.createElement("canvas");
  preview.width = Math.max(1, Math.round(width * share));
  preview.height = Math.max(1, Math.round(height * share));
  const context = preview.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  context.drawImage(bitmap, 0, 0, preview.width, preview.height);
  bitmap.close();
  return { name: file.name || "pasted.png", body: file, preview, width, height };
}
