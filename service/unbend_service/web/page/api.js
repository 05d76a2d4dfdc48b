// Calls of the service. Whatever goes wrong is thrown as an Error whose message is a sentence for people.

import { withToken } from "../token.js";

async function problemOf(response) {
  try {
    const { detail, allowed, setting } = await response.json();
    const sentences = [detail];
    if (allowed) sentences.push(`Allowed: ${allowed}.`);
    if (setting) sentences.push(`The setting ${setting} of the service says so.`);
    return new Error(sentences.join(" "));
  } catch {
    return new Error(`The service answered with the status ${response.status} and no explanation.`);
  }
}

export async function call(path, options) {
  let response;
  try {
    response = await withToken((token) => fetch(path, { ...options, headers: { ...options?.headers, ...token } }));
  } catch {
    throw new Error("The service does not answer. Is it still running?");
  }
  if (!response.ok) throw await problemOf(response);
  return response;
}

/** The estimate of a file; `onProgress` hears the share of the upload, 0..1 (fetch could not say). */
export async function estimate(body, onProgress) {
  const response = await withToken((token) => uploaded(body, onProgress, token));
  if (!response.ok) throw await problemOf(response);
  return response.json();
}

function uploaded(body, onProgress, headers) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", "/v1/estimate");
    for (const [name, value] of Object.entries(headers)) request.setRequestHeader(name, value);
    request.upload.onprogress = (event) => event.lengthComputable && onProgress(event.loaded / event.total);
    request.onerror = () => reject(new Error("The service does not answer. Is it still running?"));
    request.onload = () => resolve(new Response(request.response, { status: request.status }));
    request.send(body);
  });
}

/** A file that the browser cannot show, as a PNG that it can, with nothing corrected. */
export async function asPng(body) {
  return (await call("/v1/correct?strength=0&fit=keep&format=png", { method: "POST", body })).blob();
}

/** @returns {Promise<{picture: Blob, format: string}>} */
export async function correct(body, query) {
  const response = await call(`/v1/correct?${new URLSearchParams(query)}`, { method: "POST", body });
  const picture = await response.blob();
  return { picture, format: picture.type.split("/")[1] };
}

/** The id under which the record is stored. */
export async function saveGrid(record) {
  const headers = { "Content-Type": "application/json" };
  const response = await call("/v1/grids", { method: "POST", headers, body: JSON.stringify(record) });
  return (await response.json()).grid_id;
}

export async function exported(id, query) {
  const response = await call(`/v1/grids/${encodeURIComponent(id)}/export?${new URLSearchParams(query)}`);
  const name = /filename="([^"]+)"/.exec(response.headers.get("Content-Disposition") ?? "");
  return { file: await response.blob(), name: name ? name[1] : `${id}.${query.format}` };
}

/** The export formats that this service has, as its own description lists them. */
export async function exportFormats() {
  const { paths, components } = await (await call("/openapi.json")).json();
  const { schema } = paths["/v1/grids/{grid_id}/export"].get.parameters.find((one) => one.name === "format");
  return (schema.enum ?? components.schemas[schema.$ref.split("/").pop()].enum).filter((one) => typeof one === "string");
}

export async function sample(name) {
  return new File([await (await call(`/web/samples/${name}`)).blob()], name);
}
