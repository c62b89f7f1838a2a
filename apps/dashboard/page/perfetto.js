// "Open in Perfetto". Rule: data leaves this page only after the person's click. It goes from memory to memory, to the
// window of ui.perfetto.dev that the click opened. This page sends no request there.
// https://perfetto.dev/docs/visualization/deep-linking-to-perfetto-ui

const PERFETTO = "https://ui.perfetto.dev";
const PING_EVERY_MS = 100;
const GIVE_UP_MS = 60_000;

// Fetches the trace at `url` and hands it over. `say` gets texts about the progress. Call it after the person's click.
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

// Resolves to whether the window `target` answers PONG within GIVE_UP_MS.
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
