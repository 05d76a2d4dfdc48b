// What a screen reader is told when something changed without the focus being there.

let pending;

export function announce(sentence) {
  clearTimeout(pending);
  pending = setTimeout(() => { document.getElementById("announcer").textContent = sentence; }, 150);
}
