// The page's table sorts and filters, and two pictures are laid over each other. The page works without: nothing is hidden.
"use strict";

const table = document.querySelector("table.entries");
const body = table.tBodies[0];
const rows = [...body.rows];

const valueOf = (row, column) => {
  const cell = row.cells[column];
  return cell.dataset.value === undefined ? cell.textContent : Number(cell.dataset.value);
};

const compare = (a, b) => {
  if (a === "" || b === "") return (a === "") - (b === "");
  return typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true });
};

table.tHead.addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (!button) return;
  const head = button.closest("th");
  const falls = head.getAttribute("aria-sort") === "ascending";
  for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", falls ? "descending" : "ascending");
  const sign = falls ? -1 : 1;
  rows.sort((a, b) => sign * compare(valueOf(a, head.cellIndex), valueOf(b, head.cellIndex)));
  body.append(...rows);
});

const filter = document.querySelector("#filter");
const only = document.querySelector("#only");
const count = document.querySelector("#count");
const show = () => {
  const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
  let shown = 0;
  for (const row of rows) {
    const text = row.textContent.toLowerCase();
    row.hidden = !words.every((word) => text.includes(word)) || (only.checked && !row.classList.contains("on"));
    shown += !row.hidden;
  }
  count.textContent = `${shown} of ${rows.length}`;
};
filter.addEventListener("input", show);
only.addEventListener("change", show);
show();

const stage = document.querySelector(".pair");
if (stage) {
  const [left, right] = stage.querySelectorAll("img");
  const [first, second] = document.querySelectorAll("select.picture");
  const slider = document.querySelector("#divide");
  const pictures = [...document.querySelectorAll("figure.still img")];
  const draw = () => {
    left.src = pictures[first.value].src;
    right.src = pictures[second.value].src;
    left.alt = pictures[first.value].alt;
    right.alt = pictures[second.value].alt;
    right.style.clipPath = `inset(0 0 0 ${slider.value}%)`;
    stage.style.setProperty("--at", `${slider.value}%`);
  };
  for (const control of [first, second, slider]) control.addEventListener("input", draw);
  draw();
}
