// Makes the texts of figures, and elements. Rule: an unknown figure is a dash, never 0.

export const DASH = "–";

export function isNumber(value) {
  return typeof value === "number" && Number.isFinite(value);
}

export function number(value, digits = 1) {
  return isNumber(value) ? value.toFixed(digits) : DASH;
}

// About three digits.
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

// Returns a time in ms as minutes, seconds and tenths, such as 1:02.5.
export function clock(timeMs) {
  const tenths = Math.max(0, Math.round(timeMs / 100));
  const seconds = Math.floor(tenths / 10);
  return `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}.${tenths % 10}`;
}

export function words(name) {
  return name.replaceAll("_", " ");
}

// Makes an element, such as element("p", {class: "x", text: "y"}, child, …). The attribute `text` is the content.
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

// Sets the text only if it differs, because screen readers speak each change of a live region.
export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

// Gives a table's body the rows `rows`. A row is a list of texts; the first text is the row's heading.
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
