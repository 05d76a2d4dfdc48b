// Shows /openapi.json as a page. All text goes through textContent: nothing of the document is taken as HTML.

import { withToken } from "./token.js";

function element(tag, text, ...children) {
  const made = document.createElement(tag);
  if (text) made.textContent = text;
  made.append(...children);
  return made;
}

function resolved(schema, root) {
  if (!schema || !schema.$ref) return schema || {};
  return schema.$ref.split("/").slice(1).reduce((at, key) => at[key], root);
}

function range(schema, root) {
  const at = resolved(schema, root);
  const choices = at.anyOf || at.oneOf;
  if (choices) return choices.filter((one) => one.type !== "null").map((one) => range(one, root)).join(", or ");
  if (at.enum) return at.enum.map((value) => value === "" ? '""' : value).join(", ");
  const low = at.minimum ?? at.exclusiveMinimum, high = at.maximum ?? at.exclusiveMaximum;
  const bounds = low !== undefined || high !== undefined ? ` ${low ?? ""}..${high ?? ""}` : "";
  if (at.type === "array") return `array of ${range(at.items, root) || "values"}`;
  return (at.title && at.properties ? at.title : (at.type || "") + bounds).trim();
}

function table(head, rows) {
  const body = element("tbody", "", ...rows.map((cells) => element("tr", "", ...cells)));
  return element("table", "", element("thead", "", element("tr", "", ...head.map((name) => element("th", name)))), body);
}

function code(text) {
  return element("td", "", element("code", text));
}

function parameters(call, root) {
  return table(["Parameter", "Takes", "Default", ""], call.parameters.map((one) => [
    code(one.name),
    element("td", range(one.schema, root)),
    element("td", one.schema.default === undefined ? (one.required ? "required" : "") : String(one.schema.default)),
    element("td", (one.description || "").replaceAll("`", "")),
  ]));
}

function answers(call, root) {
  return table(["Answer", "", "Body"], Object.entries(call.responses).map(([status, one]) => [
    code(status),
    element("td", one.description || ""),
    element("td", Object.entries(one.content || {}).map(([type, body]) => {
      const name = (body.schema && body.schema.$ref || "").split("/").pop();
      return name ? `${type}: ${name}` : type;
    }).join(", ")),
  ]));
}

function fields(name, schema, root) {
  const rows = Object.entries(schema.properties || {}).map(([field, one]) => [
    code(field),
    element("td", range(one, root)),
    element("td", (one.description || "").replaceAll("`", "")),
  ]);
  const shown = element("details", "", element("summary", "", element("code", name)));
  shown.append(element("p", schema.description || ""), table(["Field", "Type", ""], rows));
  return shown;
}

function call(path, method, one, root) {
  const summary = element("summary", "", element("code", method.toUpperCase()), ` ${path} `);
  summary.firstChild.className = "method";
  summary.append(element("span", one.summary || ""));
  summary.lastChild.className = "muted";
  const shown = element("details", "", summary, element("p", (one.description || "").replaceAll("`", "")));
  if (one.parameters && one.parameters.length) shown.append(parameters(one, root));
  if (one.requestBody) {
    const types = Object.keys(one.requestBody.content).join(", ");
    shown.append(element("p", `Body: ${(one.requestBody.description || "").replaceAll("`", "")} (${types})`));
  }
  shown.append(answers(one, root));
  return shown;
}

async function show() {
  const main = document.getElementById("calls");
  try {
    const answer = await withToken((headers) => fetch("/openapi.json", { headers }));
    if (!answer.ok) throw new Error((await answer.json()).detail);
    const root = await answer.json();
    document.getElementById("title").textContent = `${root.info.title} API ${root.info.version}`;
    document.getElementById("about").textContent = root.info.description || "";
    for (const [path, methods] of Object.entries(root.paths)) {
      for (const [method, one] of Object.entries(methods)) main.append(call(path, method, one, root));
    }
    main.append(element("h2", "Bodies"));
    for (const [name, schema] of Object.entries(root.components.schemas)) main.append(fields(name, schema, root));
  } catch (error) {
    main.append(element("p", `/openapi.json could not be shown: ${error}`));
  }
}

show();
