"""The dashboard's page in a real browser: what a person sees moves, and what a person does gets through."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

pytest.importorskip("starlette", reason="the extra dashboard is not installed")
pytest.importorskip("uvicorn", reason="the extra dashboard is not installed")
pytest.importorskip("websockets", reason="the extra dashboard is not installed")
playwright = pytest.importorskip("playwright.sync_api", reason="the extra browser is not installed")

from support.dashboard_client import serving  # noqa: E402
from support.dashboard_double import DoubleView, Served  # noqa: E402
from trilane import machine  # noqa: E402
from trilane.apps.dashboard.view import PICTURE_KIND, ChangesSaid, ControlSaid, Seek  # noqa: E402

pytestmark = pytest.mark.slow

CHROMIUM = next(filter(None, map(machine.here.program, ("chromium", "chromium-browser", "google-chrome"))), None)
PHONE = {"width": 360, "height": 740}
DESKTOP = {"width": 1440, "height": 900}
PATIENCE_MS = 60_000
PIXELS = "id => document.getElementById(id).toDataURL()"
#: The picture's upper left corner, where the avatar never is, nor any of its blocks of JPEG.
CORNER = """() => {
  const copy = new OffscreenCanvas(24, 24).getContext("2d", { willReadFrequently: true });
  copy.drawImage(document.getElementById("picture"), 0, 0);
  return [...copy.getImageData(0, 0, 24, 24).data];
}"""
#: At the pace of a chip, in slow motion: a few frames a second, which leaves the cores to the browser.
PACE = ("--profile", "snapdragon-888", "--pace", "--slow-motion", "128")
SMALL = ("--size", "128", "--picture", "320x240", "--camera", "builtin:static")
#: Lets the page keep every state that it shows: on a busy machine one may be gone before anybody looks.
KEEP_STATES = """() => {
  window.states = [];
  const home = document.getElementById("state");
  const keep = () => window.states.push(home.textContent);
  new MutationObserver(keep).observe(home, { childList: true, characterData: true, subtree: true });
}"""
#: Columns of the table of the units.
PROCESS, RESTARTS = 1, 10
LONG_ENOUGH_S = 8


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A headless browser."""
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine: scripts/setup.sh all installs it")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


class Watched:
    """A page, and what went wrong in it: errors in its console, requests to other hosts."""

    def __init__(self, chromium: Any, url: str, **settings: Any) -> None:
        self.context = chromium.new_context(viewport=settings.pop("viewport", DESKTOP), **settings)
        self.page = self.context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.errors: list[str] = []
        self.foreign: list[str] = []
        self.page.on("console", self._said)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", self._asked)
        self.pulled = self.outstanding = self.most_outstanding = 0
        self.page.on("websocket", self._connected)
        self.page.goto(url)

    def _connected(self, socket: Any) -> None:
        self._check(socket.url)
        socket.on("framesent", self._sent)
        socket.on("framereceived", self._received)

    def _sent(self, frame: bytes) -> None:
        if b'"picture"' in frame:
            self.pulled += 1
            self.outstanding += 1
            self.most_outstanding = max(self.most_outstanding, self.outstanding)

    def _received(self, frame: bytes) -> None:
        self.outstanding -= frame[0] == PICTURE_KIND

    def _said(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.errors.append(message.text)

    def _asked(self, request: Any) -> None:
        self._check(request.url)

    def _check(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("data", "blob") and parts.hostname != "127.0.0.1":
            self.foreign.append(url)

    def pixels(self, canvas: str) -> str:
        """What the canvas shows, as a PNG in text."""
        return str(self.page.evaluate(PIXELS, canvas))

    def wait_for(self, condition: str, argument: Any = None) -> None:
        """Until `condition`, JavaScript, is true. (Playwright's own waiting needs eval, which the page forbids.)"""
        self.wait_until(lambda: bool(self.page.evaluate(condition, argument)))

    def wait_for_other_pixels(self, canvas: str, than: str) -> None:
        """Until the canvas shows something else."""
        self.wait_for(f"([id, than]) => ({PIXELS})(id) !== than", [canvas, than])

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Until it is so."""
        end = time.monotonic() + PATIENCE_MS / 1000
        while not condition():
            if time.monotonic() > end:
                said = [self.text(f"#{name}") for name in ("state", "link")]
                raise AssertionError(f"it never became so; the page says {said}, errors {self.errors[:3]}")
            self.page.wait_for_timeout(20)

    def text(self, selector: str) -> str:
        """What is written there."""
        return str(self.page.inner_text(selector))

    def says(self, selector: str, *words: str) -> bool:
        """Each of `words` comes to stand there: what the page shows of state, picture and figures comes one by one."""
        self.wait_until(lambda: all(each in self.text(selector) for each in words))
        return True

    def is_well(self) -> bool:
        """Nothing went wrong; says what."""
        assert self.errors == []
        assert self.foreign == []
        return True


@pytest.fixture
def opened(chromium: Any) -> Iterator[Callable[..., Watched]]:
    """Opens pages, which are closed after the test."""
    pages: list[Watched] = []

    def open_page(url: str, **settings: Any) -> Watched:
        pages.append(Watched(chromium, url, **settings))
        return pages[-1]

    yield open_page
    for page in pages:
        page.context.close()


def drag(page: Any, selector: str, dx: float, dy: float) -> None:
    """From the middle of what `selector` names."""
    box = page.locator(selector).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + dx, y + dy, steps=4)
    page.mouse.up()


def controls(view: DoubleView, name: str) -> list[Any]:
    """The values that the page asked for."""
    return [said.value for said in view.said if isinstance(said, ControlSaid) and said.name == name]


def changes(view: DoubleView) -> list[dict[str, str]]:
    """The changes that the page asked for."""
    return [said.changes for said in view.said if isinstance(said, ChangesSaid)]


def test_pictures_timeline_and_figures_of_a_live_run(opened: Callable[..., Watched]) -> None:
    with Served(DoubleView()) as served:
        seen = opened(served.url)
        seen.wait_for("() => document.getElementById('picture').dataset.frame > 0")
        seen.page.locator("#chart-frame-time").scroll_into_view_if_needed(timeout=20000)
        seen.wait_for("() => document.querySelectorAll('#chart-frame-time canvas').length === 1")
        seen.page.evaluate("() => scrollTo(0, 0)")
        for canvas in ("picture", "timeline"):
            seen.wait_for_other_pixels(canvas, seen.pixels(canvas))
        assert seen.says("#fps", "60.0") and seen.says("#error", "30.6 dB, worst frame 19.5 dB")
        assert [row.split("\t")[3] for row in seen.text("#units tbody").splitlines()] == ["39 %", "66 %", "95 %"]
        assert seen.says("#drops", "pose->raster") and seen.says("#stages", "64.0 KiB")
        assert seen.says("#state", "running") and seen.says("#link", "connected")
        assert seen.says("#bound-title", "What bounds the frame time, so far") and seen.says("#bound", "infer")
        assert seen.is_well()


def test_nothing_moves_when_a_chart_comes_into_view(opened: Callable[..., Watched]) -> None:
    with Served(DoubleView()) as served:
        seen = opened(served.url)
        seen.wait_for("() => document.getElementById('presented').textContent !== '–'")
        seen.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        top = "() => document.getElementById('restart-card').getBoundingClientRect().top + scrollY"
        before = seen.page.evaluate(top)
        seen.page.locator("#chart-busy").scroll_into_view_if_needed()
        seen.wait_until(lambda: seen.page.evaluate("() => scrollY") > 0)
        moment = "() => Number(document.getElementById('run-time').dataset.seconds)"
        later = seen.page.evaluate(moment) + 1
        seen.wait_for(f"later => ({moment})() > later", later)
        assert seen.page.locator("#chart-busy canvas").count() == 1
        assert seen.page.evaluate(top) == pytest.approx(before, abs=1)


def test_pictures_are_pulled_one_at_a_time_and_only_while_they_are_seen(opened: Callable[..., Watched]) -> None:
    with Served(DoubleView()) as served:
        seen = opened(served.url)
        seen.wait_until(lambda: seen.pulled > 20)
        assert seen.most_outstanding == 1
        seen.page.locator("#notes-title").scroll_into_view_if_needed()
        seen.wait_for("() => document.getElementById('picture').getBoundingClientRect().bottom < 0")
        seen.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        pulled, moment = seen.pulled, "() => Number(document.getElementById('run-time').dataset.seconds)"
        later = seen.page.evaluate(moment) + 1
        seen.wait_for(f"later => ({moment})() > later", later)
        assert seen.pulled <= pulled + 1
        assert seen.is_well()


def test_the_camera_follows_mouse_wheel_and_keys(opened: Callable[..., Watched]) -> None:
    view = DoubleView()
    with Served(view) as served:
        seen = opened(served.url)
        seen.wait_for("() => document.getElementById('picture').dataset.frame > 0")
        drag(seen.page, "#picture", 50, 0)
        seen.wait_until(lambda: sum(dx for dx, _ in controls(view, "orbit")) == pytest.approx(20))
        seen.page.mouse.wheel(0, -400)
        seen.wait_until(lambda: view.zoom == pytest.approx(2.718281828**0.6))
        seen.page.focus("#picture")
        seen.page.keyboard.press("ArrowLeft")
        seen.wait_until(lambda: view.turn_deg == pytest.approx(15))
        seen.page.keyboard.press("-")
        seen.wait_until(lambda: view.zoom == pytest.approx(2.718281828**0.6 / 1.1))
        seen.page.dblclick("#picture")
        seen.wait_until(lambda: view.turn_deg == 0 and view.zoom == 1.0)
        assert seen.is_well()


def test_controls_act_restart_or_say_why_not(opened: Callable[..., Watched]) -> None:
    view = DoubleView(refuses={"runtime": "ort is not installed"})
    with Served(view) as served:
        seen = opened(served.url)
        seen.page.locator("[data-control=policy]").wait_for()
        seen.page.keyboard.press("Space")
        seen.wait_for("() => document.getElementById('state').textContent.includes('paused')")
        seen.page.keyboard.press("Space")
        seen.wait_for("() => document.getElementById('state').textContent.includes('running')")
        seen.wait_until(lambda: in_flight(seen) > 1)
        policy = seen.page.locator("[data-control=policy]")
        apply = seen.page.get_by_role("button", name="Apply and restart")
        assert apply.is_disabled()
        policy.locator("select").select_option("sequential")
        assert changes(view) == [] and apply.is_enabled()
        for action, state in (("pause", "paused"), ("play", "running")):  # what is chosen stays, whatever the run says
            seen.page.locator(f"[data-action={action}]").click()
            seen.wait_for(f"() => document.getElementById('state').textContent.includes('{state}')")
            assert policy.locator("select").input_value() == "sequential"
        edge = seen.page.locator("[data-control=edge] select")
        edge.select_option("triple")
        assert seen.says("#restart-controls", "policy sequential, edge triple")
        apply.click()
        seen.wait_until(lambda: changes(view) == [{"policy": "sequential", "edge": "triple"}])
        seen.wait_for("() => document.querySelector('[data-action=apply]').disabled")
        edge.select_option("double")
        seen.page.get_by_role("button", name="Discard").click()
        assert edge.input_value() == "triple" and apply.is_disabled()
        runtime = seen.page.locator("[data-control=runtime]")
        runtime.locator("select").select_option("ort")
        apply.click()
        runtime.get_by_role("alert").wait_for()
        assert runtime.get_by_role("alert").inner_text() == "refused: ort is not installed"
        assert runtime.locator("select").input_value() == "openvino"
        profile = seen.page.locator("[data-control=performance_profile]")
        assert profile.locator("select").is_disabled() and "no hardware profile" in profile.inner_text()
        seen.page.get_by_role("button", name="Kill dsp").click()
        seen.wait_for("() => document.querySelector('#units tr[data-unit=dsp]').cells[10].textContent === '1'")
        assert seen.says("#notes", "dsp died")
        assert seen.is_well()


def test_the_timeline_is_pointed_at_moved_and_read_by_keys(opened: Callable[..., Watched]) -> None:
    with Served(DoubleView()) as served:
        seen = opened(served.url)
        seen.wait_for("() => document.getElementById('picture').dataset.frame > 0")
        seen.page.focus("#timeline")
        seen.page.keyboard.press("[")
        seen.wait_for("() => /^frame \\d+: \\w+ on cpu for 3.\\d+ ms, after a wait/.test(slice.textContent)")
        assert seen.page.get_attribute("#follow", "aria-pressed") == "false"
        still = seen.pixels("timeline")
        drag(seen.page, "#timeline", 100, 0)
        seen.wait_for_other_pixels("timeline", still)
        seen.page.click("#follow")
        assert seen.page.get_attribute("#follow", "aria-pressed") == "true"
        assert seen.is_well()


def test_a_lost_connection_comes_back_and_says_so(opened: Callable[..., Watched]) -> None:
    with Served(DoubleView()) as served:
        port = served.place.port
        seen = opened(served.url)
        seen.wait_for("() => document.getElementById('picture').dataset.frame > 0")
    seen.wait_for("() => document.getElementById('link').textContent.startsWith('connection lost; trying again')")
    with Served(DoubleView(), port, served.place.token):
        seen.wait_for("() => document.getElementById('link').textContent === 'connected'")
        frame = int(seen.page.get_attribute("#picture", "data-frame"))
        seen.wait_for("frame => document.getElementById('picture').dataset.frame !== String(frame)", frame)
    assert seen.foreign == []


def test_where_the_run_is_over_nobody_asks_again(opened: Callable[..., Watched]) -> None:
    view = DoubleView()
    with Served(view) as served:
        seen = opened(served.url)
        seen.wait_for("() => document.getElementById('picture').dataset.frame > 0")
        view.end()
        seen.wait_for("() => document.getElementById('state').textContent === 'run: ended'")
    seen.wait_for("() => document.getElementById('link').textContent.startsWith('the run is over')")
    assert seen.is_well()


def test_a_finished_run_is_sought_and_played(opened: Callable[..., Watched]) -> None:
    view = DoubleView(is_live=False)
    with Served(view) as served:
        seen = opened(served.url)
        seen.wait_for("() => document.getElementById('picture').dataset.frame > 0")
        asked = [said.t_ms for said in view.said if isinstance(said, Seek)]
        assert asked[:20] == pytest.approx([1000.0 * (second + 1) for second in range(20)])
        seen.page.locator("#seek").fill("5000")
        seen.wait_for("() => document.getElementById('picture').dataset.frame === '300'")
        seen.wait_for("() => document.getElementById('presented').textContent === '300'")
        assert seen.says("#seek-time", "0:05.0 of 0:20.0")
        seen.page.locator("#seek").fill("5110")  # of which the slices are there already
        seen.wait_for("() => document.getElementById('picture').dataset.frame === '306'")
        still = seen.pixels("timeline")
        seen.page.click("#seek-play")
        seen.wait_for("() => Number(document.getElementById('picture').dataset.frame) > 310")
        seen.wait_for_other_pixels("timeline", still)
        seen.page.click("#seek-play")
        assert seen.page.locator("#transport button").count() == 0
        assert seen.says("#bound-title", "What bounded the frame time") and seen.says("#bound", "gpu")
        assert "infer" not in seen.text("#bound")  # the report's, not a moment's
        assert seen.is_well()


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_a_phone_shows_all_of_it_without_scrolling_sideways(opened: Callable[..., Watched], theme: str) -> None:
    with Served(DoubleView()) as served:
        seen = opened(served.url, viewport=PHONE, color_scheme=theme, has_touch=True, reduced_motion="reduce")
        seen.wait_for("() => document.getElementById('picture').dataset.frame > 0")
        assert seen.page.evaluate("document.documentElement.scrollWidth") == PHONE["width"]
        light = seen.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(244, 246, 248)"
        assert light == (theme == "light")
        seen.page.select_option("#theme", "light" if theme == "dark" else "dark")
        assert light != (seen.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(244, 246, 248)")
        seen.page.locator("#timeline").scroll_into_view_if_needed()
        seen.page.locator("#timeline").tap(
            position={"x": 200, "y": 135}
        )  # in the lane of the dsp, which rests for 0.9 ms
        seen.wait_for("() => /^frame \\d+: infer on dsp|^dsp idle/.test(slice.textContent)")
        assert seen.is_well()


def test_everything_to_use_has_a_name_and_the_keys_are_listed(opened: Callable[..., Watched]) -> None:
    with Served(DoubleView()) as served:
        seen = opened(served.url)
        seen.page.locator("[data-control=policy]").wait_for()
        nameless = """() => [...document.querySelectorAll('button, select, input, canvas[tabindex]')].filter(each =>
          !(each.textContent.trim() || each.ariaLabel || each.labels?.length) || (each.matches('select, input') &&
          !each.labels?.length && !each.ariaLabel)).map(each => each.outerHTML)"""
        assert seen.page.evaluate(nameless) == []
        seen.page.keyboard.press("?")
        assert seen.says("#help", "pause, or go on") and seen.page.locator("#help").is_visible()
        seen.page.keyboard.press("Escape")
        assert not seen.page.locator("#help").is_visible()
        assert seen.is_well()


def test_memory_of_the_timeline_is_bounded_and_its_slices_stay_in_order(opened: Callable[..., Watched]) -> None:
    fill = """async () => {
      const { SliceRing } = await import("./ring.js");
      const ring = new SliceRing(8);
      for (const end of [3, 1, 2, 10, 11, 12, 13, 14, 9, 4, 2]) ring.add(end - 0.5, end, end, 0, 0);
      const kept = Array.from({ length: ring.count }, (_, index) => ring.slice(index).frame);
      return [kept, ring.firstAfter(3), ring.firstAfter(10), ring.firstAfter(14), ring.ends.length];
    }"""
    with Served(DoubleView()) as served:
        seen = opened(served.url)
        # Of eleven slices into eight places: 1 goes for the ninth, 2 for the tenth; the last is too old.
        assert seen.page.evaluate(fill) == [[3, 4, 9, 10, 11, 12, 13, 14], 1, 4, 8, 8]
        assert seen.is_well()


PERFETTO = """<script>
  addEventListener("message", event => {
    if (event.data === "PING") event.source.postMessage("PONG", event.origin);
    else if (event.data.perfetto) window.got = event.data.perfetto;
  });
</script>"""


def test_perfetto_is_handed_the_trace_on_a_click_alone(opened: Callable[..., Watched], tmp_path: Path) -> None:
    trace = tmp_path / "trace.pftrace"
    with Served(DoubleView(trace=trace)) as served:
        seen = opened(served.url)
        seen.context.route(
            "https://ui.perfetto.dev/**", lambda route: route.fulfill(body=PERFETTO, content_type="text/html")
        )
        seen.page.click("#perfetto")
        seen.wait_until(lambda: "no trace yet" in seen.text("#perfetto-note"))
        assert len(seen.context.pages) == 1
        seen.errors.clear()  # the browser says that there is no file

        trace.write_bytes(bytes(range(256)) * 1000)
        with seen.context.expect_page() as opening:
            seen.page.click("#perfetto")
        seen.wait_until(lambda: seen.text("#perfetto-note") == "handed to ui.perfetto.dev")
        got = "() => [got.title, got.fileName, got.buffer.byteLength, new Uint8Array(got.buffer)[256001 - 1000]]"
        assert opening.value.evaluate(got) == ["Trilane: 20261122-default", "trace.pftrace", 256000, 25]
        assert seen.foreign == []


def cell(seen: Watched, unit: str, column: int) -> str:
    """Of the table of the units."""
    return str(seen.page.locator(f"#units tr[data-unit={unit}]").locator("th, td").nth(column).inner_text())


def in_flight(seen: Watched) -> int:
    """The frames in flight that the page shows: several if pipelined, at most one if sequential, on any machine.

    A page that has a state need not have figures yet, so the figure is waited for.
    """
    seen.wait_for("() => /\\d+ in flight/.test(document.getElementById('presented-rest').textContent)")
    return int(seen.text("#presented-rest").split(" in flight")[0].split()[-1])


@pytest.mark.timeout(300)
def test_a_run_is_watched_and_steered(opened: Callable[..., Watched], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "trilane", "run", "--dashboard", *SMALL, *PACE, "--out", "run"]
    with serving(command, tmp_path) as served:
        seen = opened(served.url)
        seen.wait_for("() => document.getElementById('picture').dataset.frame > 0")
        corner = seen.page.evaluate(CORNER)
        for canvas in ("picture", "timeline"):
            seen.wait_for_other_pixels(canvas, seen.pixels(canvas))
        assert seen.page.evaluate(CORNER) == corner, "the camera stands still, and so does the wall"
        drag(seen.page, "#picture", 80, 0)
        seen.wait_until(lambda: seen.page.evaluate(CORNER) != corner)

        seen.wait_for("least => Number(document.getElementById('run-time').dataset.seconds) > least", LONG_ENOUGH_S)
        policy = seen.page.locator("[data-control=policy]")
        assert policy.locator("select").input_value() == "pipelined"
        policy.locator("select").select_option("sequential")
        seen.page.evaluate(KEEP_STATES)
        seen.page.get_by_role("button", name="Apply and restart").click()
        seen.wait_for("longest => Number(document.getElementById('run-time').dataset.seconds) < longest", LONG_ENOUGH_S)
        seen.wait_for("() => document.getElementById('state').textContent.includes('running')")
        assert any("restarting" in state for state in seen.page.evaluate("() => window.states"))
        assert policy.locator("select").input_value() == "sequential"
        assert in_flight(seen) <= 1

        seen.page.get_by_role("button", name="Kill dsp").click()
        seen.wait_until(lambda: (cell(seen, "dsp", RESTARTS), cell(seen, "dsp", PROCESS)) == ("1", "up"))
        seen.page.locator("#picture").scroll_into_view_if_needed()  # what nobody sees is not asked for
        seen.wait_for_other_pixels("picture", seen.pixels("picture"))
        assert seen.is_well()
