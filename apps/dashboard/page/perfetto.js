// "Open in Perfetto". Rule: only on the person's click does anything leave this page, and then it goes to the window of
// ui.perfetto.dev that the click opened, from memory to memory; no request of this page goes there.
// https://perfetto.dev/docs/visualization/deep-linking-to-perfetto-ui

const PERFETTO = "https://ui.perfetto.dev";
const PING_EVERY_MS = 100;
const GIVE_UP_MS = 60_000;

// Fetches the trace at `url` and hands it over. `say` hears how far it is. Call it when the person has clicked.
export async function openInPerfetto(url, title, say) {
  if (!(await fetch(url, { method: "HEAD" })).ok) {
    say("the run has no trace yet: it is written at its end");
    return;
  }
  const target = window.open(PERFETTO);
  if (!target) {
    say("the browser did not open a window for ui.perfetto.dev: allow pop-ups of this page");
    return;
  }
  say("fetching the trace");
  const buffer = await (await fetch(url)).arrayBuffer();
  say("waiting for ui.perfetto.dev");
  if (!(await ponged(target))) {
    say("ui.perfetto.dev did not answer: is there a network? The file is trace.pftrace in the run folder");
    return;
  }
  target.postMessage({ perfetto: { buffer, title, fileName: "trace.pftrace" } }, PERFETTO, [buffer]);
  say("handed to ui.perfetto.dev");
}

// Whether the window answers PONG before GIVE_UP_MS.
function ponged(target) {
  return new Promise((resolve) => {
    const end = (isThere) => {
      clearInterval(pings);
      clearTimeout(limit);
      removeEventListener("message", heard);
      resolve(isThere);
    };
    const heard = (event) => {
      if (event.origin === PERFETTO && event.data === "PONG") end(true);
    };
    addEventListener("message", heard);
    const pings = setInterval(() => target.postMessage("PING", PERFETTO), PING_EVERY_MS);
    const limit = setTimeout(() => end(false), GIVE_UP_MS);
  });
}
