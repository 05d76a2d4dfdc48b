// The before/after divider: a native range over the whole picture, so that mouse, touch, keys and screen readers agree.

export function createSplit(viewer, input) {
  const place = () => {
    viewer.style.setProperty("--split", `${input.value}%`);
    input.setAttribute("aria-valuetext", `${Math.round(input.value)} per cent before, the rest after`);
  };
  const follow = (event) => {
    const box = input.getBoundingClientRect();
    input.value = (100 * (event.clientX - box.left)) / box.width;
    place();
  };
  // A native range moves its thumb by the thumb's own width less than the pointer; the divider has to be under it.
  input.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    input.setPointerCapture(event.pointerId);
    follow(event);
  });
  input.addEventListener("pointermove", (event) => { if (event.buttons & 1) { event.preventDefault(); follow(event); } });
  input.addEventListener("input", place);
  place();
  return { set(value) { input.value = value; place(); } };
}
