// Keys of the whole page. Rule: the help sheet shows a table of all keys. No key acts while somebody types.

import { byId, element } from "./text.js";

const TYPING = "input:not([type=range]), textarea, select, [contenteditable]";

// actions: rows {keys, label, text, run}. `other(key)` gets a key without a row, and returns whether it used the key.
export function listen(actions, other) {
  const sheet = byId("help");
  const table = byId("shortcuts").tBodies[0];
  for (const { keys, label, text } of actions) {
    const names = (label ? [label] : keys).map((key) => element("kbd", { text: key === " " ? "Space" : key }));
    table.append(element("tr", {}, element("th", { scope: "row" }, ...names), element("td", { text })));
  }
  const rows = new Map(actions.flatMap(({ keys, run }) => keys.map((key) => [key, run])));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    if (event.target.closest(TYPING) || (sheet.open && event.key !== "?")) return;
    if (event.key !== "?" && !byId("shortcuts-on").checked) return;
    if (pressesElement(event)) return;
    const run = rows.get(event.key);
    if (run) run();
    else if (!other(event.key)) return;
    event.preventDefault();
  });
}

// Returns whether the focused element itself uses the key: Space and Enter press a button, arrows move a slider.
function pressesElement(event) {
  if (event.target.closest("button, summary, a")) return event.key === " " || event.key === "Enter";
  return Boolean(event.target.closest("input[type=range]")) && event.key.startsWith("Arrow");
}
