// The page: a picture comes in, is looked at, adjusted, and taken away.

import { announce } from "./accessibility.js";
import { estimate, sample } from "./api.js";
import { Editor } from "./editor.js";
import { Overlay, drawOverlays } from "./overlays.js";
import { decode } from "./picture.js";
import { createRenderer } from "./renderer.js";
import { createSplit } from "./slider.js";
import { derive, isDoubted, isLeftAlone, open, state, subscribe, update } from "./state.js";
import { downloadPicture, exports, snippets, storedGrid } from "./taking.js";
import { facts, verdict } from "./verdict.js";

const get = (id) => document.getElementById(id);
const renderer = createRenderer(get("after"));
const overlays = [new Overlay(get("over-before")), new Overlay(get("over-after"))];
const editor = new Editor(get("editor"));
const split = createSplit(get("viewer"), get("split"));

function phase(name) {
  document.body.dataset.phase = name;
  get("welcome").hidden = name !== "empty";
  get("working").hidden = name !== "working";
  for (const id of ["work", "panel", "another"]) get(id).hidden = name !== "ready";
}

let attempt = 0;

async function accept(file) {
  const mine = ++attempt;
  get("error").hidden = get("refused").hidden = true;
  phase("working");
  progress("Reading the picture…", null);
  try {
    const answer = estimate(file, (share) => {
      if (share < 1) progress("Sending the picture…", share); else progress("Looking for what is bent…", null);
    });
    const [picture, record] = await Promise.all([decode(file, answer), answer]).catch(async (error) => {
      await answer; // its sentence is the better one
      throw error.name === "InvalidStateError" ? new Error("The browser cannot show this picture.") : error;
    });
    if (mine === attempt) present(picture, record);
  } catch (error) {
    if (mine === attempt) refuse(error, file.name);
  }
}

/** A picture that is at work already stays. */
function refuse(error, name = "") {
  phase(state.picture ? "ready" : "empty");
  const place = get(state.picture ? "refused" : "error");
  place.textContent = name ? error.message.replace(/^The (body|image) /, `${name} `) : error.message;
  place.hidden = false;
  get(state.picture ? "another" : "choose").focus();
}

function progress(text, share) {
  get("progress-text").textContent = text;
  if (share === null) get("progress").removeAttribute("value"); else get("progress").value = share;
}

function present(picture, record) {
  const before = get("before"), { preview } = picture;
  before.width = preview.width;
  before.height = preview.height;
  before.getContext("2d").drawImage(preview, 0, 0);
  get("viewer").style.setProperty("--aspect", preview.width / preview.height);
  renderer.show(preview);
  editor.forget();
  phase("ready");
  split.set(50);
  open(picture, record);
  const { title, sentence } = verdict(state, derive());
  announce(`${title}. ${sentence}`);
  get("stage").focus({ preventScroll: true });
  scrollTo({ top: 0 });
}

let scheduled = false;

subscribe(() => {
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(() => {
    scheduled = false;
    if (state.picture) draw();
  });
});

function draw() {
  const derived = derive();
  if (derived.fitted !== draw.last) renderer.draw(derived.fitted);
  draw.last = derived.fitted;
  get("viewer").dataset.view = state.view;
  drawAll(derived);
  control(derived);
  document.body.dataset.drawn = String(Number(document.body.dataset.drawn ?? 0) + 1);
}

function drawAll(derived) {
  drawOverlays(...overlays, state, derived);
  if (state.view === "adjust") editor.draw(); else editor.overlay.clear();
}

function control(derived) {
  const { title, sentence } = verdict(state, derived), adjusting = state.view === "adjust";
  setText("verdict", title);
  setText("why", sentence);
  get("anyway").hidden = !(isDoubted() && state.record.guides);
  setText("anyway", isLeftAlone() ? "Correct it anyway" : "Correct it all the way");
  get("correction").hidden = isLeftAlone();
  get("strength").value = Math.round(state.strength * 100);
  setText("strength-value", `${Math.round(state.strength * 100)} %`);
  get("fit").disabled = state.fit === null;
  if (state.fit !== null) get("fit").value = Math.round(state.fit * 100);
  setText("fit-value", state.fit === null ? "as estimated" : { 0: "cropped", 1: "everything" }[state.fit] ?? `${Math.round(state.fit * 100)} %`);
  get("keep").checked = state.fit === null;
  get("all").checked = state.correct === "all";
  get("all").disabled = !state.guides;
  for (const button of document.querySelectorAll("[data-overlay]")) {
    button.setAttribute("aria-pressed", state.overlays[button.dataset.overlay]);
    button.disabled = button.dataset.overlay === "guides" && !state.guides;
  }
  get("adjust").setAttribute("aria-expanded", adjusting);
  get("adjust").disabled = !state.guides;
  get("adjusting").hidden = !adjusting;
  get("hint").hidden = adjusting;
  setText("hint", isLeftAlone() ? "Both sides are the same." : "Drag across the picture to compare.");
  if (state.guides) setText("guide-name", editor.name());
  get("undo").disabled = !editor.history.length;
  get("reset").disabled = !state.edited;
  get("fold").hidden = !derived.folded;
  setText("fold", derived.folded ? "These guides cross in a way that would fold the picture; the last ones that did not are shown." : "");
  get("save").disabled = get("download").disabled = derived.folded;
  get("save").hidden = isLeftAlone();
  setText("download", isLeftAlone() ? "Download it unchanged" : "Download the picture");
  get("saved").hidden = !state.saved || state.saved.lattice !== derived.blended;
  if (state.saved) for (const [name, text] of Object.entries(snippets(state.saved.id))) setText(name, text);
  get("facts").replaceChildren(...Object.entries(facts(state)).flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
}

function setText(id, text) {
  if (get(id).textContent !== text) get(id).textContent = text;
}

function element(tag, text) {
  const made = document.createElement(tag);
  made.textContent = text;
  return made;
}

/** Runs something slow behind a button; what goes wrong is said below it. */
async function busy(button, doing, work) {
  const label = button.textContent;
  get("save-error").hidden = true;
  button.disabled = true;
  button.textContent = doing;
  try {
    await work();
  } catch (error) {
    get("save-error").textContent = error.message;
    get("save-error").hidden = false;
  } finally {
    button.disabled = false;
    button.textContent = label;
  }
}

async function save() {
  const { blended } = derive();
  const id = await storedGrid();
  get("grid-id").textContent = id;
  get("exports").replaceChildren(...(await exports(id)).map(({ label, take }) => {
    const button = element("button", label), item = document.createElement("li");
    button.type = "button";
    button.addEventListener("click", () => busy(button, "Exporting…", take));
    item.append(button);
    return item;
  }));
  update({ saved: { id, lattice: blended } });
  announce(`Saved as the grid ${id}`);
  requestAnimationFrame(() => get("saved").scrollIntoView({ block: "nearest" }));
}

/** Copies the text of an element; over plain HTTP, where pages may not, it is selected instead. */
async function copied(source) {
  try {
    await navigator.clipboard.writeText(source.textContent);
    return true;
  } catch {
    getSelection().selectAllChildren(source);
    return false;
  }
}

/** Into the adjusting view, the focus on a control point; and back, the focus where it came from. */
function adjust(adjusting) {
  update({ view: adjusting ? "adjust" : "compare" });
  requestAnimationFrame(() => {
    const focused = adjusting ? document.querySelector("#editor .handle") : get("adjust");
    focused?.focus({ preventScroll: !adjusting });
    if (adjusting) get("work").scrollIntoView({ block: "nearest" });
  });
}

const on = (id, event, act) => get(id).addEventListener(event, act);
on("choose", "click", () => get("file").click());
on("file", "change", (event) => { if (event.target.files[0]) accept(event.target.files[0]); event.target.value = ""; });
on("another", "click", () => { attempt++; phase("empty"); state.picture = null; get("choose").focus(); });
for (const button of document.querySelectorAll("[data-sample]")) {
  button.addEventListener("click", () => sample(button.dataset.sample).then(accept, refuse));
}
on("strength", "input", (event) => update({ strength: event.target.value / 100 }));
on("fit", "input", (event) => update({ fit: event.target.value / 100 }));
on("keep", "change", (event) => update({ fit: event.target.checked ? null : get("fit").value / 100 }));
on("all", "change", (event) => update({ correct: event.target.checked ? "all" : "nonlinear" }));
on("anyway", "click", () => update({ anyway: true }));
for (const button of document.querySelectorAll("[data-overlay]")) {
  const name = button.dataset.overlay;
  button.addEventListener("click", () => update({ overlays: { ...state.overlays, [name]: !state.overlays[name] } }));
}
on("adjust", "click", () => adjust(state.view !== "adjust"));
on("done", "click", () => adjust(false));
on("guide-back", "click", () => editor.step(-1));
on("guide-next", "click", () => editor.step(1));
on("undo", "click", () => editor.undo());
on("reset", "click", () => editor.reset());
on("download", "click", (event) => busy(event.target, "Rendering at full size…", downloadPicture));
on("save", "click", (event) => busy(event.target, "Saving…", save));
for (const button of document.querySelectorAll("[data-copy]")) {
  button.addEventListener("click", async () => {
    button.textContent = (await copied(get(button.dataset.copy))) ? "Copied" : "Selected";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  });
}

let dragged = 0;
addEventListener("dragenter", (event) => { event.preventDefault(); dragged++; get("veil").hidden = false; });
addEventListener("dragleave", () => { if (--dragged <= 0) { dragged = 0; get("veil").hidden = true; } });
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  dragged = 0;
  get("veil").hidden = true;
  if (event.dataTransfer.files[0]) accept(event.dataTransfer.files[0]);
});
addEventListener("paste", (event) => {
  const file = [...event.clipboardData.files][0];
  if (file) accept(file);
});
addEventListener("keydown", (event) => {
  if (state.view === "adjust" && event.key === "Escape") adjust(false);
  if (state.view === "adjust" && (event.ctrlKey || event.metaKey) && event.key === "z") {
    event.preventDefault();
    editor.undo();
  }
});

new ResizeObserver(() => {
  for (const [id, which] of [["source-pane", [overlays[0], editor.overlay]], ["result-pane", [overlays[1]]]]) {
    const { clientWidth, clientHeight } = get(id);
    for (const overlay of which) overlay.resize(clientWidth, clientHeight);
  }
  if (state.picture) drawAll(derive());
}).observe(get("viewer"));
