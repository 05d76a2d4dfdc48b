// The token of this tab: asked for when the service wants one, kept until the tab is closed, and nowhere else.

const KEY = "unbend-token";
let held = remembered();
let asking = null;

function remembered() {
  try { return sessionStorage.getItem(KEY) ?? ""; } catch { return ""; } // storage may be forbidden: then memory alone
}

/** Whether the service wanted a token and was given one. */
export function hasToken() {
  return held !== "";
}

/**
 * The response of `send(headers)`, asked again with another token for as long as the service refuses the one it was
 * given and the user gives one.
 */
export async function withToken(send) {
  for (;;) {
    const used = held;
    const response = await send(used ? { Authorization: `Bearer ${used}` } : {});
    if (response.status !== 401 && response.status !== 403) return response;
    if (used !== held) continue; // another call has been given one meanwhile
    if (!(await ask(await sentence(response.clone(), used)))) return response;
  }
}

async function sentence(response, used) {
  if (!used) return "This service lets in only those who have a token.";
  try {
    const { detail, allowed } = await response.json();
    return [detail, allowed && `Allowed: ${allowed}.`].filter(Boolean).join(" ");
  } catch {
    return "The service refused this token.";
  }
}

/** Calls that wait at once share one question. */
function ask(reason) {
  asking ??= question(reason).finally(() => { asking = null; });
  return asking;
}

function question(reason) {
  const dialog = element("dialog", { className: "token", ariaLabel: "Token" });
  const form = element("form"), field = element("input", { type: "password", id: "token", autocomplete: "off", required: true, spellcheck: false });
  const buttons = element("p"), cancel = element("button", { type: "button", textContent: "Cancel" });
  buttons.append(element("button", { className: "primary", textContent: "Go on" }), cancel);
  form.append(element("p", { textContent: reason, id: "token-reason" }), element("label", { htmlFor: "token", textContent: "Token" }), field, buttons,
    element("p", { className: "muted", textContent: "It is kept until this tab is closed." }));
  field.setAttribute("aria-describedby", "token-reason");
  dialog.append(form);
  document.body.append(dialog);
  return new Promise((resolve) => {
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      keep(field.value.trim());
      dialog.close("given");
    });
    cancel.addEventListener("click", () => dialog.close());
    dialog.addEventListener("close", () => { dialog.remove(); resolve(dialog.returnValue === "given"); });
    dialog.showModal();
  });
}

function keep(token) {
  held = token;
  try { sessionStorage.setItem(KEY, token); } catch { /* memory alone */ }
}

function element(tag, properties = {}) {
  return Object.assign(document.createElement(tag), properties);
}
