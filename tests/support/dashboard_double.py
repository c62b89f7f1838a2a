"""A run that is none, for tests of the page: a `View` with figures that a formula makes, 60 frames a second.

Rule: it says what the server's own views say, in the same messages, and does nothing that takes time. It is served by
the dashboard's own server, so the page meets the real headers, token and limits.
"""

from __future__ import annotations

import asyncio
import io
import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

from PIL import Image, ImageDraw

from trilane.apps.dashboard.access import listen
from trilane.apps.dashboard.app import DashboardApp, server
from trilane.apps.dashboard.view import ChangesSaid, Client, ControlSaid, Seek, shown

PERIOD_MS = 1000 / 60
STAGES = (("pose", "cpu"), ("raster", "gpu"), ("infer", "dsp"), ("composite", "gpu"), ("present", "cpu"))
UNITS = ("cpu", "gpu", "dsp")
#: Begin and end of each stage's job in ms after its frame's; no two of one unit overlap at this period.
JOBS = ((0.0, 3.0), (4.0, 9.5), (10.0, 25.8), (27.0, 32.5), (21.0 + PERIOD_MS, 24.5 + PERIOD_MS))
CAUSES = ("starved", "blocked", "throttled", "preempted", "overhead")
SPAN_MS = 20_000.0
KINDS = ("least", "read", "read_back", "uploaded", "written")
POLICIES = ("pipelined", "sequential", "latest", "deadline")
EDGES = ("single", "double", "triple", "fifo:4", "orphan:6")
PROFILES = ("burst", "balanced")
CONTROLS: tuple[dict[str, Any], ...] = (
    {"name": "play", "kind": "action", "live": True},
    {"name": "pause", "kind": "action", "live": True},
    {"name": "step", "kind": "action", "live": True},
    {"name": "orbit", "kind": "drag", "live": True},
    {"name": "zoom", "kind": "number", "live": True, "min": 0.25, "max": 4.0, "value": 1.0},
    {"name": "recentre", "kind": "action", "live": True},
    {"name": "kill", "kind": "choice", "live": True, "choices": UNITS},
    {"name": "policy", "kind": "choice", "choices": POLICIES, "value": "pipelined"},
    {"name": "edge", "kind": "choice", "choices": EDGES, "value": "double"},
    {"name": "performance_profile", "kind": "choice", "choices": PROFILES, "why_not": "no hardware profile"},
    {"name": "size", "kind": "choice", "choices": ("128", "192", "256", "auto"), "value": "128"},
    {"name": "runtime", "kind": "choice", "choices": ("openvino", "ort"), "value": "openvino"},
    {"name": "avatar", "kind": "choice", "choices": ("default",), "value": "default"},
)
HELLO_KEYS = {"choices": (), "min": None, "max": None, "live": False, "value": None, "why_not": ""}
SOURCE = "from the avatar's validation of 2026-11-22"
ACCURACY = {"default": {"source": SOURCE, "psnr_db": 30.56, "least_psnr_db": 19.48}}


def slices(begin_ms: float, end_ms: float) -> dict[str, Any]:
    """The slices that end in (begin_ms, end_ms], as a message."""
    first, last = int(begin_ms / PERIOD_MS) - 3, int(end_ms / PERIOD_MS) + 1
    spans: dict[int, list[tuple[float, float]]] = {unit: [] for unit in range(len(UNITS))}
    jobs: list[list[Any]] = []
    for frame in range(first, last):
        for stage, (begin, end) in enumerate(JOBS):
            unit, at = UNITS.index(STAGES[stage][1]), frame * PERIOD_MS
            spans[unit].append((at + begin, at + end))
            if frame >= 0 and begin_ms < at + end <= end_ms:
                jobs.append([unit, stage, frame, at + begin, at + end, 0.5 + stage / 4])
    idle: list[list[Any]] = []
    for unit, taken in spans.items():
        taken.sort()
        for number, ((_, left), (right, _)) in enumerate(pairwise(taken)):
            if right > left and left >= 0 and begin_ms < right <= end_ms:
                idle.append([unit, CAUSES[(number // 8 + unit) % len(CAUSES)], left, right])
    return {
        "type": "slices",
        "jobs": sorted(jobs, key=lambda row: row[4]),
        "idle": sorted(idle, key=lambda row: row[3]),
    }


#: Of the path.
SO_FAR = {"name": "gpu", "share": 0.82, "share_low": 0.78, "share_high": 0.86}


def figures(t_ms: float, restarts: int = 0) -> dict[str, Any]:
    """`trilane.apps.watch.figures.Figures` at a moment, as JSON."""
    wave = (t_ms / 1000 % 10) / 10
    times = {"mean": 16.7, "p50": 16.6 + wave, "p90": 17.9 + wave, "p95": 18.8 + wave, "p99": 21.4, "max": 25.0}
    idle = dict.fromkeys(CAUSES, 0.01)
    busy = {"cpu": 0.39, "gpu": 0.66, "dsp": 0.95}

    def shares(unit: str) -> dict[str, Any]:
        return {"busy": busy[unit], "idle": {**idle, "starved": 0.96 - busy[unit]}}

    units = {
        unit: {"window": shares(unit), "run": shares(unit), "jobs": int(t_ms / PERIOD_MS), "is_up": True}
        | {"restarts": restarts if unit == "dsp" else 0, "stage": "infer" if unit == "dsp" else "", "frame": 1}
        for unit in UNITS
    }
    stages = {
        name: {"unit": unit, "waiting": place % 3, "service_ms": JOBS[place][1] - JOBS[place][0]}
        | {"bytes": {kind: {"total": 1e8, "per_job": 65536.0 * (place + 1)} for kind in KINDS}}
        for place, (name, unit) in enumerate(STAGES)
    }
    frames = {"requested": 1200, "presented": int(t_ms / PERIOD_MS), "skipped": 0, "in_flight": 4}
    drops = (("pose->raster", "stale", 3), ("raster->infer", "late", 1))
    dropped = [{"edge": edge, "cause": cause, "frames": count} for edge, cause, count in drops]
    lost = {"died:dsp": 2}
    frames["not_begun"] = 1200 - frames["presented"] - 4 - sum(lost.values()) - sum(count for *_, count in drops)
    return {
        "type": "figures",
        "t_ms": t_ms,
        "window_s": 5.0,
        "run_s": t_ms / 1000,
        "clock": "host",
        "is_over": False,
        "fps": 60.0,
        "run_fps": 59.8,
        "frame_time_ms": {**times, "samples": 299},
        "latency_ms": {**{key: value + 16 for key, value in times.items()}, "samples": 299},
        "frames": {**frames, "lost": lost, "dropped": dropped},
        "units": units,
        "stages": stages,
        "temperature_c": {"device": 38 + wave, "gpu": 51 + 3 * wave, "dsp": 55 + 4 * wave},
        "duty": {"gpu": 0.8, "dsp": 0.6},
        "accuracy": ACCURACY,
        "bound": {"unit": {**SO_FAR, "name": "dsp"}, "stage": {**SO_FAR, "name": "infer"}},
        "sources": {"fps": "measured in this run", "temperature_c": "computed by a model"},
    }


def jpeg(frame: int, turn_deg: float, zoom: float) -> bytes:
    """A picture in which a bar moves with the frame, and a disc by the camera."""
    picture = Image.new("RGB", (320, 240), (40, 46, 60))
    pen = ImageDraw.Draw(picture)
    x, radius = 160 + turn_deg, 50 * zoom
    pen.ellipse((x - radius, 120 - radius, x + radius, 120 + radius), fill=(220, 180, 150))
    pen.rectangle((frame * 2 % 320, 220, frame * 2 % 320 + 12, 236), fill=(120, 200, 255))
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=85)
    return data.getvalue()


class DoubleView:
    """A live run, or one that is over. `said`: what the page asked for, in order.

    `refuses`: names of controls, and why. `trace`: file that it says is its trace.
    """

    def __init__(
        self, is_live: bool = True, refuses: Mapping[str, str] | None = None, trace: Path | None = None
    ) -> None:
        self.is_live, self.refuses, self.trace = is_live, dict(refuses or {}), trace
        self.said: list[ControlSaid | ChangesSaid | Seek] = []
        self.state = "running" if is_live else "ended"
        self.turn_deg, self.zoom, self.restarts = 0.0, 1.0, 0
        self.config: dict[str, Any] = {row["name"]: row["value"] for row in CONTROLS if row.get("value") is not None}
        self._began = time.monotonic() - 3.0
        self._told_ms = 0.0
        self._figures_ms = -1000.0
        self._seek_ms = 0.0
        self._notes: list[dict[str, Any]] = []

    @property
    def _now_ms(self) -> float:
        return 1000 * (time.monotonic() - self._began) if self.is_live else self._seek_ms

    def _state(self) -> dict[str, Any]:
        plan = {"tensor_shapes": [[128, 128]], "kept": ["all 55 joints"], "left_out": {"far avatars": "nobody is far"}}
        unit = {"cores": [0], "threads": 1}
        placement = {"how": "measured", "why": "the least predicted frame time", "units": dict.fromkeys(UNITS, unit)}
        return {"type": "state", "is": self.state, "config": self.config, "plan": plan, "placement": placement} | {
            "accuracy": ACCURACY,
            "bound": None if self.is_live else {"bottleneck": "gpu", "bound": {"unit": SO_FAR, "stage": None}},
        }

    def greeting(self) -> Iterable[dict[str, Any]]:
        """Hello, state, and of a live run what happened lately."""
        run = {
            "name": "20261122-default",
            "scene": "default",
            "clock": "host",
            "machine": "a machine of the tests",
            "stages": [{"name": name, "unit": unit} for name, unit in STAGES],
            "units": UNITS,
            "edges": [{"name": f"{a}->{b}", "rule": "double"} for (a, _), (b, _) in pairwise(STAGES)],
        }
        controls = [{**HELLO_KEYS, **row} for row in CONTROLS] if self.is_live else []
        span = [0.0, SPAN_MS]
        yield {"type": "hello", "run": run, "controls": controls, "is_live": self.is_live, "span_ms": span}
        yield self._state()
        if self.is_live:
            yield slices(max(0.0, self._told_ms - 2000), self._told_ms)
            yield {"type": "note", "t_ms": 0.0, "text": "runtime: openvino; placement: cpu 0, gpu 1, dsp 0"}
        else:
            yield figures(SPAN_MS)

    async def news(self, *, is_watched: bool) -> list[dict[str, Any]]:  # noqa: ARG002 - a view's signature
        """Slices since the last call, four figures a second."""
        if not self.is_live or self.state != "running":
            notes, self._notes = self._notes, []
            return notes
        now_ms, messages = self._now_ms, list(self._notes)
        self._notes = []
        messages.append(slices(self._told_ms, now_ms))
        self._told_ms = now_ms
        if now_ms - self._figures_ms >= 250:
            self._figures_ms = now_ms
            messages.append(figures(now_ms, self.restarts))
        return messages

    async def picture(self, client: Client) -> bytes | None:
        """A picture of the present frame."""
        frame = int(self._now_ms / PERIOD_MS)
        if client.had_frame == frame or self.state == "paused":
            return None
        client.had_frame = frame
        return shown(frame, frame * PERIOD_MS, 14.0, jpeg(frame, self.turn_deg, self.zoom))

    def end(self) -> None:
        """The run is over."""
        self.state = "ended"
        self._notes.append(self._state())

    def control(self, asked: ControlSaid) -> str:
        """Note it; do what changes pictures and state."""
        self.said.append(asked)
        if why := self.refuses.get(asked.name):
            return why
        if asked.name == "orbit" and isinstance(asked.value, list):
            self.turn_deg += asked.value[0]
        elif asked.name == "zoom" and isinstance(asked.value, float | int):
            self.zoom = self.config["zoom"] = asked.value
        elif asked.name == "recentre":
            self.turn_deg, self.zoom, self.config["zoom"] = 0.0, 1.0, 1.0
        elif asked.name == "kill":
            self.restarts += 1
            self._notes.append(
                {"type": "note", "t_ms": self._now_ms, "text": f"{asked.value} died; it is started again"}
            )
        elif asked.name in ("play", "pause"):
            self.state = "running" if asked.name == "play" else "paused"
        else:
            self.config[asked.name] = asked.value
        self._notes.append(self._state())
        return ""

    def restart(self, asked: ChangesSaid) -> dict[str, str]:
        """Note it; a new run has the values unless one of them is refused."""
        self.said.append(asked)
        if refused := {name: why for name, why in self.refuses.items() if name in asked.changes}:
            return refused
        self.config |= asked.changes
        self._notes.append(self._state())
        return {}

    async def seek(self, _client: Client, to: Seek) -> list[dict[str, Any]]:
        """Slices around the moment, and its figures."""
        self.said.append(to)
        self._seek_ms = to.t_ms
        begin_ms, end_ms = max(0.0, to.t_ms - to.span_ms), min(SPAN_MS, to.t_ms + to.span_ms)
        return [slices(begin_ms, end_ms), figures(to.t_ms)]

    def metrics(self) -> str:
        """None."""
        return ""


class Served:
    """Context manager: a server of `view` in a thread; `url` is the page's address.

    `port`, `token`: of its own if none. `app`: what it serves.
    """

    def __init__(self, view: DoubleView, port: int | None = None, token: str | None = None) -> None:
        place = listen(port)
        self.place = replace(place, token=token or place.token)
        self.app = DashboardApp(view, self.place.port, self.place.token)
        self._server = server(self.app)
        self._thread = threading.Thread(target=self._serve)

    @property
    def url(self) -> str:
        """The page's."""
        return self.place.url

    def _serve(self) -> None:
        asyncio.run(self._server.serve(sockets=[self.place.listener]))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.should_exit = True
        self._thread.join()
        self.place.close()
