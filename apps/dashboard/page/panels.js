// Figures as text and tables. Rule: no speed is written without the avatar's error beside it.

import { CAUSES, CAUSE_MEANINGS } from "./slices.js";
import { byId, bytes, clock, DASH, element, isNumber, ms, number, percent, setRows, setText, short, words } from "./text.js";

export const PERCENTILES = ["p50", "p90", "p95", "p99"];
const MOST_NOTES = 200;
const BYTES = ["read", "written", "uploaded", "read_back", "least"];
const LONG_TEXT = 24;

// Returns a text such as "PSNR 30.6 dB, worst frame 19.5 dB (source)" for each avatar, or why there is no figure.
function errorText(accuracy) {
  const avatars = Object.entries(accuracy ?? {});
  if (avatars.length === 0) return "not known: the run does not say how exact its avatar is";
  return avatars.map(([name, facts]) => `${avatars.length > 1 ? `${name}: ` : ""}${oneError(facts)}`).join("; ");
}

function oneError(facts) {
  if (isNumber(facts?.psnr_db)) {
    const worst = isNumber(facts.least_psnr_db) ? `, worst frame ${number(facts.least_psnr_db)} dB` : "";
    return `PSNR ${number(facts.psnr_db)} dB${worst} (${facts.source ?? "source not said"})`;
  }
  const bands = Object.values(facts?.psnr_db_by_band ?? {}).filter(isNumber);
  if (bands.length) {
    const range = `${number(Math.min(...bands))} to ${number(Math.max(...bands))}`;
    return `PSNR ${range} dB by distance (${facts.source ?? "source not said"})`;
  }
  return `not known: ${facts?.why ?? facts?.source ?? "no figures"}`;
}

export function showSpeed(figures, accuracy) {
  const how = figures.clock === "virtual" ? "computed, virtual clock" : "measured, host clock";
  setText(byId("fps"), number(figures.fps));
  const when = figures.state === "finished" ? "whole run" : `last ${number(figures.window_s, 0)} s`;
  setText(byId("speed-note"), `frames a second, ${when} (${how})`);
  setText(byId("error"), errorText(accuracy));
  for (const [key, id] of [
    ["frame_time_ms", "frame-time"],
    ["latency_ms", "latency"],
  ]) {
    const times = figures[key]?.samples ? figures[key] : {};
    const [first, ...others] = PERCENTILES;
    setText(byId(id), ms(times[first]));
    const rest = others.map((name) => `${name} ${short(times[name])}`).join(" · ");
    setText(byId(`${id}-rest`), `${first}; ${rest} ms, of ${number(times.samples, 0)}`);
  }
  setText(byId("run-time"), isNumber(figures.run_s) ? `in ${clock(1000 * figures.run_s)} of the run` : "");
  byId("run-time").dataset.seconds = figures.run_s;
  const frames = figures.frames ?? {};
  setText(byId("presented"), number(frames.presented, 0));
  const lost = total(frames.lost);
  const dropped = (frames.dropped ?? []).reduce((sum, drop) => sum + drop.frames, 0);
  const rest = `${frames.in_flight ?? DASH} in flight · ${frames.not_begun ?? DASH} not begun`;
  setText(byId("presented-rest"), `presented; ${lost} lost · ${dropped} dropped · ${rest}`);
}

// Shows the verdict's lines, the same as in every view of a run. The style sheet adds a sign to PASS and FAIL, so that
// their meaning does not rest on colour alone.
export function showVerdict(verdict) {
  const lines = verdict?.lines ?? [];
  byId("no-verdict").hidden = lines.length > 0;
  const home = byId("verdict");
  while (home.children.length > lines.length) home.lastElementChild.remove();
  while (home.children.length < lines.length) home.append(element("div", {}, element("dt"), element("dd")));
  lines.forEach(([label, text], place) => {
    const [term, said] = home.children[place].children;
    setText(term, label);
    setText(said, text);
    home.children[place].dataset.is = label;
  });
}

function total(counts) {
  return Object.values(counts ?? {}).reduce((sum, count) => sum + count, 0);
}

function setHead(table, titles) {
  const head = table.tHead.rows[0];
  while (head.cells.length > titles.length) head.deleteCell(-1);
  while (head.cells.length < titles.length) head.append(element("th", { scope: "col" }));
  titles.forEach((title, place) => setText(head.cells[place], title));
}

// Shows each unit's busy share, and its idle share by cause. The cause `join` is shown only if a unit has it.
export function showUnits(figures) {
  const units = Object.entries(figures.units ?? {});
  const idle = units.map(([, unit]) => unit.run?.idle ?? {});
  const causes = CAUSES.filter((cause) => idle.some((shares) => cause in shares));
  setHead(byId("units"), ["unit", "process", "now", "busy", ...causes, "busy, whole run", "restarts", "duty (cap)"]);
  const rows = units.map(([name, unit]) => [
    name,
    unit.is_up ? "up" : "down",
    unit.stage ? `${unit.stage} ${unit.frame}` : "idle",
    percent(unit.window?.busy),
    ...causes.map((cause) => percent(unit.window?.idle?.[cause])),
    percent(unit.run?.busy),
    number(unit.restarts, 0),
    isNumber(figures.duty?.[name]) ? percent(figures.duty[name]) : DASH,
  ]);
  setRows(byId("units").tBodies[0], rows);
  for (const row of byId("units").tBodies[0].rows) {
    row.dataset.unit = row.cells[0].textContent;
    row.cells[1].className = row.cells[1].textContent;
  }
}

// `edges`: {name, rule} of each edge. The first stage has no edge before it.
export function showStages(figures, edges) {
  const stages = Object.entries(figures.stages ?? {});
  const kinds = [...new Set(stages.flatMap(([, stage]) => Object.keys(stage.bytes ?? {})))].sort(byPlace);
  const titles = ["stage", "unit", "edge before it", "frames waiting", "service", ...kinds.map((kind) => words(kind))];
  setHead(byId("stages"), titles);
  setRows(
    byId("stages").tBodies[0],
    stages.map(([name, stage], place) => [
      name,
      stage.unit,
      edges[place - 1]?.rule ?? DASH,
      number(stage.waiting, 0),
      ms(stage.service_ms),
      ...kinds.map((kind) => bytes(stage.bytes?.[kind]?.per_job)),
    ]),
  );
  byId("no-bytes").hidden = kinds.length > 0;
}

export function showDrops(figures) {
  const frames = figures.frames ?? {};
  const rows = [
    ...(frames.dropped ?? []).map((drop) => [drop.edge, `dropped, ${words(drop.cause)}`, number(drop.frames, 0)]),
    ...Object.entries(frames.lost ?? {}).map(([cause, count]) => [cause.split(":")[1] ?? "", lostText(cause), `${count}`]),
  ];
  setRows(byId("drops").tBodies[0], rows);
  byId("no-drops").hidden = rows.length > 0;
  byId("drops").hidden = rows.length === 0;
}

function lostText(cause) {
  return `lost, ${words(cause.split(":")[0])}`;
}

// Shows any plain data, such as plan and placement, as nested lists of terms.
export function showFacts(home, facts) {
  const text = JSON.stringify(facts ?? null);
  if (home.dataset.shown === text) return;
  home.dataset.shown = text;
  home.replaceChildren(facts === null || facts === undefined ? "not known" : factNode(facts));
}

function factNode(facts) {
  if (Array.isArray(facts)) {
    const isPlain = facts.every((fact) => (fact === null || typeof fact !== "object" ? !isLong(fact) : isFlat(fact)));
    if (isPlain) return facts.length ? facts.map(plain).join(", ") : "none";
    return element("ol", {}, ...facts.map((fact) => element("li", {}, factNode(fact))));
  }
  if (facts !== null && typeof facts === "object") {
    const entries = Object.entries(facts);
    if (entries.length === 0) return "none";
    const pairs = entries.map(([name, fact]) =>
      element("div", {}, element("dt", { text: words(name) }), element("dd", {}, factNode(fact))),
    );
    return element("dl", {}, ...pairs);
  }
  return plain(facts);
}

// Kinds of bytes that are not in BYTES come before the last of BYTES.
function byPlace(a, b) {
  const place = (kind) => (BYTES.includes(kind) ? BYTES.indexOf(kind) : BYTES.length - 1.5);
  return place(a) - place(b);
}

function isLong(fact) {
  return typeof fact === "string" && fact.length > LONG_TEXT;
}

function isFlat(fact) {
  return Array.isArray(fact) && fact.every((part) => part === null || typeof part !== "object");
}

function plain(fact) {
  if (Array.isArray(fact)) return fact.map(plain).join("×");
  if (isNumber(fact) && !Number.isInteger(fact)) return String(Number(fact.toPrecision(6)));
  if (fact === null) return "none";
  if (typeof fact === "boolean") return fact ? "yes" : "no";
  return String(fact);
}

export function showSources(figures) {
  const rows = Object.entries(figures.sources ?? {}).map(([key, source]) => [words(key), source]);
  setRows(byId("sources").tBodies[0], rows);
}

export function buildLegend(home) {
  home.replaceChildren(
    element("li", {}, element("span", { class: "swatch job", "aria-hidden": "true" }), "a job: a colour for each frame; with the time in which another thread had its core"),
    ...CAUSES.map((cause) =>
      element(
        "li",
        { title: CAUSE_MEANINGS[cause] },
        element("canvas", { class: "swatch", "data-cause": cause, width: 28, height: 14, "aria-hidden": "true" }),
        cause === "unexplained" ? cause : `${cause}: ${CAUSE_MEANINGS[cause]}`,
      ),
    ),
  );
}

// Shows messages, the newest on top. Only the newest MOST_NOTES stay.
export class Notes {
  constructor(home) {
    this.home = home;
    this.last = null;
  }

  add(timeText, text) {
    const key = `${timeText} ${text}`;
    if (key === this.last) return;
    this.last = key;
    this.home.prepend(element("li", {}, element("time", { text: timeText }), ` ${text}`));
    while (this.home.children.length > MOST_NOTES) this.home.lastElementChild.remove();
    byId("no-notes").hidden = true;
  }

  clear() {
    this.last = null;
    this.home.replaceChildren();
    byId("no-notes").hidden = false;
  }
}
