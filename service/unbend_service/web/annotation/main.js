// The annotation page: picture by picture, four curves over what ought to be straight.

import { announce } from "../page/accessibility.js";
import { Board } from "./board.js";
import { CURVES, LEAST_POINTS, isComplete } from "./curves.js";
import { Saver, overview, pictureAddress, read } from "./store.js";

const UNDO_STEPS = 500;
const LOUPE_ZOOM = 4;
const get = (id) => document.getElementById(id);

let pictures = [];
let at = -1;
let active = 0;
let curves = empty();
let history = [];
let opening = 0;

function empty() {
  return CURVES.map(() => []);
}

const saver = new Saver((name, kept) => {
  const entry = pictures.find((one) => one.name === name);
  const before = entry.complete;
  entry.complete = kept.complete;
  if (kept.complete && !before) announce(`${name} is done`);
  showProgress();
  if (pictures[at]?.name === name && !saver.waiting) get("place").textContent = `${place()} · saved`;
}, complain);

const board = new Board(get("board"), {
  curves: () => curves,
  active: () => active,
  put(point) {
    change((points) => points.push(point));
    return curves[active].length - 1;
  },
  move(point, to) {
    curves[active][point] = to;
    changed();
  },
  seen: magnify,
});

function change(act) {
  history.push({ curves: structuredClone(curves), active });
  if (history.length > UNDO_STEPS) history.shift();
  act(curves[active]);
  changed();
}

function changed() {
  const { naturalWidth: width, naturalHeight: height } = get("picture");
  const of = (family) => CURVES.flatMap((curve, n) => (curve.family === family ? [{ points: curves[n] }] : []));
  saver.keep(pictures[at].name, { width, height, rows: of("rows"), columns: of("columns") });
  get("place").textContent = `${place()} · saving…`;
  show();
}

const place = () => `${at + 1} of ${pictures.length}`;

function show() {
  board.draw();
  get("curves").replaceChildren(...CURVES.map(({ family, name }, n) => {
    const button = document.createElement("button"), points = curves[n];
    button.type = "button";
    button.className = family;
    button.dataset.curve = n;
    button.setAttribute("role", "radio");
    button.setAttribute("aria-checked", n === active);
    button.tabIndex = n === active ? 0 : -1;
    const count = isComplete(points, family) ? `${points.length} points ✓` : `${points.length} of ${LEAST_POINTS}`;
    for (const [tag, text, kind] of [["span", "", "swatch"], ["span", name, ""], ["span", count, "count"], ["kbd", n + 1, ""]]) {
      const part = document.createElement(tag);
      part.textContent = text;
      part.className = kind;
      button.append(part);
    }
    return button;
  }));
  get("undo").disabled = !history.length;
  get("delete").disabled = !curves[active].length;
}

function showProgress() {
  const done = pictures.filter((one) => one.complete).length;
  get("done-text").textContent = `${done} of ${pictures.length} done`;
  get("done").max = pictures.length;
  get("done").value = done;
}

function complain(error) {
  get("error").textContent = error.message;
  get("error").hidden = false;
}

async function visit(index) {
  if (index < 0 || index >= pictures.length) {
    announce(index < 0 ? "This is the first picture" : "This is the last picture");
    return;
  }
  await saver.flush();
  const mine = ++opening, { name } = pictures[index];
  get("error").hidden = true;
  try {
    const picture = get("picture");
    picture.src = pictureAddress(name);
    const [kept] = await Promise.all([read(name), picture.decode()]);
    if (mine !== opening) return;
    at = index;
    curves = kept ? CURVES.map(({ family, index: n }) => kept[family][n].points) : empty();
    active = Math.max(0, curves.findIndex((points, n) => !isComplete(points, CURVES[n].family)));
    history = [];
    board.cursor = null;
    get("name").textContent = name;
    picture.alt = name;
    get("place").textContent = place();
    get("viewer").style.setProperty("--aspect", picture.naturalWidth / picture.naturalHeight);
    get("previous").disabled = at === 0;
    get("next").disabled = at === pictures.length - 1;
    document.body.dataset.picture = name;
    show();
    announce(`${name}, ${place()}`);
  } catch (error) {
    if (mine === opening) complain(error instanceof DOMException ? new Error(`The browser cannot show ${name}.`) : error);
  }
}

function choose(curve) {
  active = (curve + CURVES.length) % CURVES.length;
  show();
  announce(`${CURVES[active].name}, ${curves[active].length} points`);
}

function undo() {
  const before = history.pop();
  if (!before) return announce("Nothing to undo");
  ({ curves, active } = before);
  announce("Undone");
  return changed();
}

function removePoint() {
  if (curves[active].length) change((points) => points.pop());
}

/** The surroundings of a place, enlarged. */
function magnify([x, y]) {
  const picture = get("picture"), loupe = get("loupe"), context = loupe.getContext("2d");
  const side = loupe.width / LOUPE_ZOOM, scale = Math.max(1, picture.naturalWidth / picture.clientWidth);
  const centre = [((x + 1) / 2) * picture.naturalWidth, ((y + 1) / 2) * picture.naturalHeight];
  context.clearRect(0, 0, loupe.width, loupe.height);
  context.drawImage(picture, centre[0] - (side * scale) / 2, centre[1] - (side * scale) / 2, side * scale, side * scale, 0, 0, loupe.width, loupe.height);
  const middle = loupe.width / 2;
  for (const [colour, width] of [["#0009", 3], ["#fff", 1]]) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(middle + 5 * dx, middle + 5 * dy);
      context.lineTo(middle + 18 * dx, middle + 18 * dy);
    }
    context.stroke();
  }
}

const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

addEventListener("keydown", (event) => {
  if (at < 0 || event.altKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const onButton = document.activeElement instanceof HTMLButtonElement;
  const act = {
    n: () => visit(at + 1), PageDown: () => visit(at + 1), p: () => visit(at - 1), PageUp: () => visit(at - 1),
    z: undo, Backspace: removePoint, Delete: removePoint,
    " ": () => board.hands.put(board.cursor ?? [0, 0]),
  }[key] ?? (/^[1-4]$/.test(key) ? () => choose(Number(key) - 1) : undefined);
  if ((event.ctrlKey || event.metaKey) && key !== "z") return;
  if (key === " " && onButton) return;
  if (key in STEPS) {
    event.preventDefault();
    if (onButton && document.activeElement.dataset.curve) {
      choose(active + (STEPS[key][0] || STEPS[key][1]));
      get("curves").querySelector("[aria-checked=true]").focus();
      return;
    }
    board.steer(...STEPS[key].map((by) => by * (event.shiftKey ? 20 : 2)));
  } else if (act) {
    event.preventDefault();
    act();
  }
});

get("previous").addEventListener("click", () => visit(at - 1));
get("next").addEventListener("click", () => visit(at + 1));
get("undo").addEventListener("click", undo);
get("delete").addEventListener("click", removePoint);
get("curves").addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (!button) return;
  choose(Number(button.dataset.curve));
  get("curves").querySelector("[aria-checked=true]").focus();
});
new ResizeObserver(() => {
  board.overlay.resize(get("pane").clientWidth, get("pane").clientHeight);
  if (at >= 0) board.draw();
}).observe(get("pane"));

try {
  const { title, pictures: found } = await overview();
  pictures = found;
  document.title = `${title}: annotate`;
  showProgress();
  await visit(Math.max(0, pictures.findIndex((one) => !one.complete)));
  get("board").focus({ preventScroll: true });
} catch (error) {
  complain(error);
}
