// How figures and elements are written. Rule: a figure that is not known is a dash, never 0.

export const DASH = "–";

export function isNumber(value) {
  return typeof value === "number" && Number.isFinite(value);
}

export function number(value, digits = 1) {
  return isNumber(value) ? value.toFixed(digits) : DASH;
}

// Three digits or so.
export function short(value) {
  return number(value, value < 100 ? 1 : 0);
}

export function ms(value) {
  return isNumber(value) ? `${short(value)} ms` : DASH;
}

export function percent(share) {
  return isNumber(share) ? `${(100 * share).toFixed(0)} %` : DASH;
}

export function bytes(value) {
  if (!isNumber(value)) return DASH;
  const units = ["B", "KiB", "MiB", "GiB"];
  let place = 0;
  while (value >= 1024 && place < units.length - 1) {
    value /= 1024;
    place += 1;
  }
  return `${value.toFixed(place && value < 100 ? 1 : 0)} ${units[place]}`;
}

// Minutes, seconds and tenths of a time in ms, such as 1:02.5.
export function clock(timeMs) {
  const tenths = Math.max(0, Math.round(timeMs / 100));
  const seconds = Math.floor(tenths / 10);
  return `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}.${tenths % 10}`;
}

export function words(name) {
  return name.replaceAll("_", " ");
}

// element("p", {class: "x", text: "y"}, child, …): attributes as they are written, `text` for the content.
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") made.textContent = value;
    else if (typeof value === "boolean") made.toggleAttribute(name, value);
    else if (value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

export function byId(id) {
  return document.getElementById(id);
}

// Changes the text only where it is another one: screen readers speak each change of a live region.
export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

// Makes the rows of a table's body those of `rows`, each a list of texts; the first one is the row's heading.
export function setRows(body, rows) {
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach((cells, index) => {
    const row = body.rows[index] ?? body.insertRow();
    while (row.cells.length > cells.length) row.deleteCell(-1);
    while (row.cells.length < cells.length) {
      row.append(element(row.cells.length ? "td" : "th", row.cells.length ? {} : { scope: "row" }));
    }
    cells.forEach((text, place) => setText(row.cells[place], text));
  });
}
