// The page. Rule: each message goes to the panels that show it. One loop draws what has changed, once a browser frame.

import { Chart } from "./charts.js";
import { Connection, withToken } from "./connection.js";
import { Controls } from "./controls.js";
import { listen } from "./keys.js";
import {
  buildLegend,
  Notes,
  PERCENTILES,
  showDrops,
  showFacts,
  showSources,
  showSpeed,
  showStages,
  showUnits,
  showVerdict,
} from "./panels.js";
import { causePattern } from "./patterns.js";
import { openInPerfetto } from "./perfetto.js";
import { Picture } from "./picture.js";
import { Seek } from "./seek.js";
import { Slices } from "./slices.js";
import { byId, clock, isNumber, setText, words } from "./text.js";
import { followThemeSwitch, onThemeChange } from "./theme.js";
import { Timeline } from "./timeline.js";

// The page shares the cores with the run. On a machine with few cores, the page draws about half as often.
const FEW_CORES = 4;
const DRAW_EVERY_MS = navigator.hardwareConcurrency > FEW_CORES ? 0 : 30;
const NOTE_EVERY_MS = 250;
const STATES = {
  running: "running",
  paused: "paused",
  starting: "starting",
  restarting: "restarting",
  ended: "ended",
  failed: "failed",
};

let slices = null;
let accuracy = null;
let run = { name: "" };
let isLive = true;
let isOver = false;
let isReported = false; // whether the report says what bounded the run
let state = "";
let span = [0, 0];
let drawnAt = 0;
let notedAt = 0;

const notes = new Notes(byId("notes"));
const connection = new Connection({
  message: received,
  picture: pictured,
  link: linked,
  isOver: () => isLive && isOver,
});
const controls = new Controls(
  { live: byId("live-controls"), restart: byId("restart-controls"), actions: byId("transport") },
  (name, value) => connection.control(name, value),
  (changes) => connection.restart(changes),
);
const camera = {
  orbit: (dx, dy) => controls.use("orbit", [dx, dy]),
  zoom: (factor) => controls.scale("zoom", factor),
  reset: () => controls.use("recentre"),
};
const picture = new Picture(byId("picture"), camera);
const timeline = new Timeline(byId("timeline"), {
  say: (text) => setText(byId("slice"), text || "Point at a slice, or use the keys [ and ]."),
  changed(view) {
    byId("follow").setAttribute("aria-pressed", String(view.isFollowing));
    if (!isLive && Math.abs(view.middle - seek.time) > 0.01) seek.go(view.middle);
  },
});
const seek = new Seek(
  (time, span) => connection.send({ type: "seek", t_ms: time, span_ms: span }),
  (time) => timeline.showMoment(time),
);

const of = (key) => (figures) => {
  const times = figures[key]?.samples ? figures[key] : {};
  return Object.fromEntries(PERCENTILES.map((name) => [name, times[name]]));
};
const shares = (table, share) =>
  Object.fromEntries(Object.entries(table ?? {}).map(([name, row]) => [words(name), 100 * share(row)]));
const charts = [
  new Chart(byId("chart-frame-time"), "ms", 1, of("frame_time_ms")),
  new Chart(byId("chart-latency"), "ms", 1, of("latency_ms")),
  new Chart(byId("chart-queues"), "frames", 0, (figures) => ({
    "in flight": figures.frames?.in_flight,
    ...Object.fromEntries(Object.entries(figures.stages ?? {}).map(([name, stage]) => [name, stage.waiting])),
  })),
  new Chart(byId("chart-busy"), "%", 0, (figures) => shares(figures.units, (unit) => unit.window?.busy)),
  new Chart(byId("chart-temperature"), "°C", 1, (figures) => figures.temperature_c ?? {}),
  new Chart(byId("chart-duty"), "%", 0, (figures) => shares(figures.duty, (duty) => duty)),
];

function received(message) {
  const handlers = { hello, slices: sliced, figures: figured, state: stated, note: noted, refused, refusals };
  handlers[message.type]?.(message);
}

function hello(message) {
  run = message.run;
  isLive = message.is_live;
  isOver = false;
  slices = new Slices(run.stages, run.units);
  timeline.show(slices, isLive);
  for (const chart of charts) chart.clear();
  notes.clear();
  controls.build(message.controls ?? []);
  setText(byId("run-name"), run.name ?? "");
  document.title = `${run.name ?? "run"} – Trilane`;
  setText(byId("machine"), [run.scene, run.clock && `${run.clock} clock`, run.machine].filter(Boolean).join(" · "));
  byId("seek-row").hidden = isLive;
  byId("follow").hidden = !isLive;
  setText(byId("charts-title"), isLive ? "The last two minutes" : "Over the run");
  seek.end();
  span = message.span_ms;
}

function sliced(message) {
  if (!slices) return;
  if (!isLive) {
    if (!seek.isNewStretch) return;
    slices.clear();
  }
  slices.add(message);
  timeline.fed();
}

function figured(figures) {
  if (Object.keys(figures.accuracy ?? {}).length) accuracy = figures.accuracy;
  for (const chart of charts) chart.add(figures);
  const isSurvey = !isLive && seek.isSurveying;
  if (!isLive) answered(figures);
  if (!isSurvey) showFigures(figures);
}

// The first figures of a finished run come unasked, and end the server's greeting. All later figures are answers.
function answered(figures) {
  if (!seek.isOn) seek.begin(span);
  else {
    if (!seek.isSurveying) for (const chart of charts) chart.mark(figures.t_ms);
    seek.answered();
  }
}

function showFigures(figures) {
  showSpeed(figures, accuracy);
  showUnits(figures);
  showStages(figures, run.edges ?? []);
  showDrops(figures);
  showSources(figures);
  if (!isReported) {
    showBound(figures.bound);
    showVerdict(figures.verdict);
  }
}

// `bound`: of a run that goes on, the bound so far; of a finished run, the bound in its report.
function showBound(bound) {
  byId("bound-part").hidden = !bound;
  if (!bound) return;
  setText(byId("bound-title"), isOver ? "What bounded the frame time" : "What bounds the frame time, so far");
  showFacts(byId("bound"), bound);
}

function stated(message) {
  state = message.is;
  isOver = state === "ended" || state === "failed";
  timeline.isRunning = state === "running";
  byId("state").dataset.is = state;
  const why = message.why ? `: ${message.why}` : "";
  setText(byId("state"), isLive ? `run: ${STATES[state] ?? state}${why}` : "finished run");
  controls.config(message.config);
  if (message.accuracy) accuracy = message.accuracy;
  if ("plan" in message) showFacts(byId("plan"), message.plan);
  if ("placement" in message) showFacts(byId("placement"), message.placement);
  isReported = Boolean(message.bound);
  if (isReported) showBound(message.bound);
  if (message.verdict) showVerdict(message.verdict);
}

function noted(message) {
  notes.add(isNumber(message.t_ms) ? clock(message.t_ms) : "", message.text);
}

function refused(message) {
  if (!controls.refused(message.control, message.why)) notes.add("", `refused: ${message.control} ${message.why}`);
}

function refusals(message) {
  const counts = Object.entries(message.counts ?? {}).filter(([, count]) => count);
  const text = counts.map(([why, count]) => `${words(why)} ${count}`).join(", ");
  setText(byId("refusals"), text ? `The server has refused or dropped: ${text}.` : "");
}

async function pictured(shown) {
  if (!(await picture.show(shown)) || (isLive && performance.now() - notedAt < NOTE_EVERY_MS)) return;
  notedAt = performance.now();
  const age = shown.ageMs > 0 ? `, ${shown.ageMs.toFixed(0)} ms old when it was sent` : "";
  setText(byId("picture-note"), `frame ${shown.frame}, ${clock(shown.mediaMs)} in the scene${age}`);
}

function linked(link, text) {
  byId("link").dataset.is = link;
  setText(byId("link"), text);
}

function playOrPause() {
  if (!isLive) seek.toggle();
  else controls.use(state === "paused" ? "play" : "pause");
}

function draw(now) {
  requestAnimationFrame(draw);
  if (now - drawnAt < DRAW_EVERY_MS) return;
  drawnAt = now;
  if (slices && picture.isWanted && !seek.isSurveying && (isLive || seek.isOn)) connection.pullPicture();
  picture.tick(now);
  seek.tick(now, timeline.span);
  timeline.tick(now);
  for (const chart of charts) chart.tick();
}

function drawLegend() {
  for (const swatch of document.querySelectorAll("canvas.swatch")) {
    const pen = swatch.getContext("2d");
    pen.fillStyle = causePattern(pen, swatch.dataset.cause, 1);
    pen.fillRect(0, 0, swatch.width, swatch.height);
  }
}

function toggleHelp() {
  const sheet = byId("help");
  if (sheet.open) sheet.close();
  else sheet.showModal();
}

buildLegend(byId("legend"));
onThemeChange(drawLegend);
followThemeSwitch(byId("theme"));
byId("show-help").addEventListener("click", toggleHelp);
byId("close-help").addEventListener("click", toggleHelp);
byId("follow").addEventListener("click", () => timeline.follow());
byId("zoom-in").addEventListener("click", () => timeline.zoom(0.5));
byId("zoom-out").addEventListener("click", () => timeline.zoom(2));
byId("perfetto").addEventListener("click", () =>
  openInPerfetto(withToken("trace.pftrace"), `Trilane: ${run.name}`, (text) => setText(byId("perfetto-note"), text)),
);
listen(
  [
    { keys: [" ", "k"], text: "pause, or go on", run: playOrPause },
    { keys: ["."], text: "one frame further, while paused", run: () => controls.use("step") },
    { keys: ["f"], text: "the timeline follows the run", run: () => timeline.follow() },
    { keys: ["t"], text: "to the timeline", run: () => byId("timeline").focus() },
    { keys: ["v"], text: "to the avatar", run: () => byId("picture").focus() },
    { keys: ["p"], text: "open the trace in Perfetto", run: () => byId("perfetto").click() },
    { keys: ["?"], text: "this sheet", run: toggleHelp },
    { keys: [], label: "← → ↑ ↓", text: "turn the camera", run: () => {} },
    { keys: [], label: "+ −", text: "zoom the camera", run: () => {} },
    { keys: [], label: "0", text: "the camera as it was (so does a double click)", run: () => {} },
  ],
  (key) => picture.key(key),
);
connection.open();
requestAnimationFrame(draw);
