// Keys of the whole page. Rule: each is in the table that the help sheet shows, and none acts while somebody types.

import { byId, element } from "./text.js";

const TYPING = "input:not([type=range]), textarea, select, [contenteditable]";

// actions: rows {keys, text, run}; `other(key)` is asked for keys of no row and says whether it took them.
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

// Space and Enter press a button that has the focus, and arrows move a slider.
function pressesElement(event) {
  if (event.target.closest("button, summary, a")) return event.key === " " || event.key === "Enter";
  return Boolean(event.target.closest("input[type=range]")) && event.key.startsWith("Arrow");
}
