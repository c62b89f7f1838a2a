"""The server process of a live run. It shows the growing journal, the newest picture and the controls.

Rule: nothing here makes the run wait. This process reads the journal, fetches pictures through the window, sends
requests to the run, and sends the run's answers to all pages. Its priority is low, and it ends with the run's process.
It inherits three file descriptors: the listening socket, its end of the channel, and the window.
"""

from __future__ import annotations

import asyncio
import os
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Final

from PIL import Image

from trilane.apps.dashboard.app import DashboardApp, server
from trilane.apps.dashboard.channel import (
    ChangesAsked,
    ChangesRefused,
    ChannelEnd,
    ControlAsked,
    Opened,
    RunBegins,
    StateIs,
)
from trilane.apps.dashboard.channel import Message as FromRun
from trilane.apps.dashboard.run_facts import OF_A_NEW_RUN, OF_THE_CAMERA, Control, RunFacts, Value, control_of
from trilane.apps.dashboard.view import (
    ChangesSaid,
    Client,
    ControlSaid,
    IdleRow,
    JobRow,
    Message,
    Seek,
    TimelineRows,
    described,
    figures_said,
    jpeg_of,
    metrics_text,
    note,
    shown,
    slices,
)
from trilane.apps.watch.followed_run import FollowedRun, run_name
from trilane.apps.watch.live_figures import LiveFigures
from trilane.errors import BadInputError
from trilane.pipeline.journal import Begun, Record
from trilane.transport.live_window import LiveWindow, ShownPicture, Steering
from trilane.unexpected_value import UnexpectedValue

NICE: Final = 10
FIGURES_S: Final = 0.25
PICTURE_S: Final = 0.05  # least time between two encoded pictures
MOST_RAISED_DEG: Final = 90.0
MOST_JOBS: Final = 4000
MOST_IDLE: Final = 4000
MOST_NOTES: Final = 100
RECORDS_AT_ONCE: Final = 200
READ_S: Final = 0.05  # longest time for reading the journal at once
ASKED_A_SECOND: Final = 10
ACCEPTED: Final = ""
RUNNING, STARTING, NO_FRAME_YET = "running", "starting", "the units start; no frame yet"
NO_NEW_RUN: Final = "it needs no new run"
GOES_ON: Final = "a run that goes on has no other time than now"
MS: Final = 1e-6  # milliseconds in a nanosecond


async def serve(listener: socket.socket, channel: ChannelEnd, window_fd: int) -> None:
    """Serve until the run's process closes its end of `channel`.

    `listener`: socket that listens for clients.
    `channel`: this process's end of the channel to the run.
    `window_fd`: file descriptor of the window with the pictures.
    Raises EOFError if the run ends before its first message, UnexpectedValue if the first message is not `Opened`.
    """
    opened = await _first(channel)
    window = LiveWindow(window_fd, opened.height, opened.width)
    os.close(window_fd)
    view = LiveView(window, channel.send)
    app = DashboardApp(view, listener.getsockname()[1], opened.token)
    answers = server(app)
    run_is_over = asyncio.Event()
    asyncio.get_running_loop().add_reader(channel.fd, _hear, channel, view, run_is_over)
    leaving = asyncio.create_task(_leave(run_is_over, app, answers))
    os.setpriority(os.PRIO_PROCESS, 0, NICE)  # only now, so that the imports were quick
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # so that its wake-ups take no core from a unit
    await answers.serve(sockets=[listener])
    leaving.cancel()


async def _first(channel: ChannelEnd) -> Opened:
    while (message := channel.receive()) is None:
        await asyncio.sleep(0.01)
    if not isinstance(message, Opened):
        raise UnexpectedValue(type(message).__name__, Opened.__name__)
    return message


async def _leave(run_is_over: asyncio.Event, app: DashboardApp, answers: Any) -> None:
    await run_is_over.wait()
    await app.finish()
    answers.should_exit = True


def _hear(channel: ChannelEnd, view: LiveView, run_is_over: asyncio.Event) -> None:
    try:
        message = channel.receive()
    except EOFError:
        asyncio.get_running_loop().remove_reader(channel.fd)
        run_is_over.set()
        return
    if message is not None:
        view.hear(message)


def main() -> None:
    """Run the server process: `python -m trilane.apps.dashboard.live_server LISTENER CHANNEL WINDOW`.

    The three arguments are inherited file descriptors.
    """
    listener_fd, channel_fd, window_fd = map(int, sys.argv[1:])
    channel = ChannelEnd(socket.socket(fileno=channel_fd))
    with socket.socket(fileno=listener_fd) as listener:
        try:
            asyncio.run(serve(listener, channel, window_fd))
        except EOFError:  # the run ended before it began
            return


class _Course:
    """The timeline and figures of one live run.

    `begun`: first record of the run's journal.

    `timeline`, `figures`: rows and figures so far. `jobs`, `idle`, `notes`: the newest rows and notes, for clients that
    join later.
    """

    def __init__(self, begun: Begun) -> None:
        self.begun = begun
        self.timeline, self.figures = TimelineRows(begun), LiveFigures(begun)
        self.jobs: deque[JobRow] = deque(maxlen=MOST_JOBS)
        self.idle: deque[IdleRow] = deque(maxlen=MOST_IDLE)
        self.notes: deque[Message] = deque(maxlen=MOST_NOTES)

    def add(self, record: Record) -> None:
        self.timeline.add(record)
        self.figures.add(record)

    def fresh(self) -> Iterable[Message]:
        """Return messages with the jobs, idle slices and notes since the last call, and store these rows."""
        jobs, idle, said = self.timeline.take()
        notes = [note(t_ms, text) for t_ms, text in said]
        self.jobs.extend(jobs)
        self.idle.extend(idle)
        self.notes.extend(notes)
        return [*([slices(jobs, idle)] if jobs or idle else []), *notes]


class LiveView:
    """The `RunView` of successive live runs. `hear` takes the messages that announce each run.

    `window`: window that has the pictures and steers the camera.
    `ask`: function that sends a request to the run, and returns whether the request was sent.
    """

    def __init__(self, window: LiveWindow, ask: Callable[[ControlAsked | ChangesAsked], bool]) -> None:
        self._window, self._ask = window, ask
        self._steering = Steering()
        self._facts: RunFacts | None = None
        self._controls: dict[str, Control] = {}
        self._folder: Path | None = None
        self._followed: FollowedRun | None = None
        self._course: _Course | None = None
        self._state, self._why = "restarting", ""
        self._is_told_starting = False
        self._told: list[Message] = []
        self._unread: Iterator[Record] = iter(())
        self._is_news = self._is_behind = False
        self._figures_s = self._picture_s = 0.0
        self._jpeg: tuple[int, bytes] = (-1, b"")
        self._asked_s: deque[float] = deque(maxlen=ASKED_A_SECOND)

    def hear(self, message: FromRun) -> None:
        """Process a message from the run's process."""
        if isinstance(message, RunBegins):
            self._facts = RunFacts.of_row(message.facts)
            self._controls = {control.name: control for control in map(control_of, message.controls)}
            self._folder, self._followed, self._course = Path(message.folder), None, None
            self._unread = iter(())
        elif isinstance(message, StateIs):
            self._state, self._why, self._is_news = message.state, message.why, True
        elif isinstance(message, ChangesRefused):
            self._told.append({"type": "refused", "control": message.control, "why": message.why})

    def greeting(self) -> Iterable[Message]:
        course = self._course
        if course is not None and self._facts is not None:
            yield self._hello(course, self._facts)
        if self._facts is not None:
            yield self._stated(self._facts)
        if course is not None:
            yield slices(list(course.jobs), list(course.idle))
            yield from course.notes
            yield figures_said(course.figures.now(self._now_ns()))

    async def news(self, *, is_watched: bool) -> Iterable[Message]:
        await self._read_on()
        told, self._told = self._told, []
        if not is_watched:
            if self._course is not None:
                self._course.fresh()
            return ()
        if (self._is_news or self._is_told_starting != self._is_starting) and self._facts is not None:
            self._is_news, self._is_told_starting = False, self._is_starting
            told.append(self._stated(self._facts))
        if self._course is not None:
            told += self._course.fresh()
            if time.monotonic() >= self._figures_s:
                self._figures_s = time.monotonic() + FIGURES_S
                told.append(figures_said(self._course.figures.now(self._now_ns())))
        return told

    async def picture(self, client: Client) -> bytes | None:
        self._window.look()
        if time.monotonic() < self._picture_s:
            return None
        seen = self._window.newest(client.had_frame)
        if seen is None:
            return None
        self._picture_s = time.monotonic() + PICTURE_S
        if seen.sampled_ns != self._jpeg[0]:  # a later run has the same frame numbers
            self._jpeg = seen.sampled_ns, await asyncio.to_thread(_jpeg, seen)
        client.had_frame = seen.frame
        age_ms = (time.monotonic_ns() - seen.sampled_ns) * MS
        return shown(seen.frame, 1e3 * seen.media_s, age_ms, self._jpeg[1])

    def control(self, asked: ControlSaid) -> str:
        if asked.name in OF_A_NEW_RUN and isinstance(asked.value, str):
            return self._new_run({asked.name: asked.value}).get(asked.name, ACCEPTED)
        if why := self._refusal(asked.name, asked.value):
            return why
        if asked.name in OF_THE_CAMERA:
            self._steer(asked.name, asked.value)
            return ACCEPTED
        value = asked.value if not isinstance(asked.value, list) else None
        return self._hand_over(ControlAsked(asked.name, value))

    def restart(self, asked: ChangesSaid) -> Mapping[str, str]:
        return self._new_run(asked.changes)

    def _new_run(self, changes: Mapping[str, str]) -> dict[str, str]:
        """Request a new run with `changes`, values by control. Return the reason for each refusal, by control.

        If a change is refused, nothing is requested. The result is empty if the request was sent.
        """
        of_another_kind = {name: NO_NEW_RUN for name in changes if name not in OF_A_NEW_RUN}
        refused = of_another_kind | {name: why for name, word in changes.items() if (why := self._refusal(name, word))}
        if refused:
            return refused
        why = self._hand_over(ChangesAsked(changes))
        return dict.fromkeys(changes, why) if why else {}

    def _refusal(self, name: str, value: Value) -> str:
        control = self._controls.get(name)
        return control.refusal(value) if control else f"found {name!r}, expected one of {', '.join(self._controls)}"

    def _hand_over(self, asked: ControlAsked | ChangesAsked) -> str:
        """Send the request `asked` to the run. Return ACCEPTED, or why the request was not sent, in words."""
        now_s = time.monotonic()
        if len(self._asked_s) == ASKED_A_SECOND and now_s - self._asked_s[0] < 1.0:
            return f"more than {ASKED_A_SECOND} things were asked for within a second"
        self._asked_s.append(now_s)
        return ACCEPTED if self._ask(asked) else "the run does not answer"

    async def seek(self, client: Client, to: Seek) -> Iterable[Message]:  # noqa: ARG002 - a view's signature
        return [{"type": "refused", "control": "seek", "why": GOES_ON}]

    def metrics(self) -> str:
        return "" if self._course is None else metrics_text(self._course.figures.now(self._now_ns()))

    @property
    def trace(self) -> Path | None:
        folder = self._followed.folder if self._followed is not None else self._folder
        return None if folder is None else folder / "trace.pftrace"

    async def _read_on(self) -> None:
        """Add new records of the run's journal to the figures, for about READ_S seconds at most."""
        if self._followed is None and self._folder is not None:
            with suppress(BadInputError):  # the journal does not exist yet, or the run just renames its folder
                self._followed = FollowedRun(_place_of(self._folder))
        if (followed := self._followed) is None:
            return
        until_s = time.monotonic() + READ_S
        while records := list(islice(self._unread, RECORDS_AT_ONCE)):
            for record in records:
                self._add(record)
            self._is_behind = time.monotonic() > until_s
            if self._is_behind:
                return
            await asyncio.sleep(0)
            if self._followed is not followed:  # `hear` got the message about another run meanwhile
                return
        self._unread = followed.new()

    def _add(self, record: Record) -> None:
        if isinstance(record, Begun):
            self._course = _Course(record)
            if self._facts is not None:
                self._told.append(self._hello(self._course, self._facts))
                self._is_news = True
        elif self._course is not None:
            self._course.add(record)

    def _hello(self, course: _Course, facts: RunFacts) -> Message:
        run = {**facts.hello(), **described(course.begun.graph)}
        values = self._values(facts)
        rows = [control.as_json(values.get(name)) for name, control in self._controls.items()]
        span = [0.0, course.timeline.now_ms]
        return {"type": "hello", "run": run, "controls": rows, "is_live": True, "span_ms": span}

    def _stated(self, facts: RunFacts) -> Message:
        state, why = (STARTING, NO_FRAME_YET) if self._is_starting else (self._state, self._why)
        return {**facts.state(state, why), "config": self._values(facts)}

    @property
    def _is_starting(self) -> bool:
        """Return whether the run is going on but has presented no frame yet."""
        return self._state == RUNNING and (self._course is None or not self._course.figures.has_frames)

    def _values(self, facts: RunFacts) -> dict[str, Any]:
        """Return the present value of each control that has a value, by the control's name."""
        camera = self._steering
        return {**facts.config, "orbit": [camera.azimuth_deg, camera.elevation_deg], "zoom": camera.zoom}

    def _steer(self, name: str, value: Value) -> None:
        """Steer the camera by `value` of the control `name`; the control `recentre` undoes all steering.

        `value`: (right, down) in degrees for a drag, or the new zoom. The picture follows a drag: a drag to the right
        moves the camera to the left, and a drag down lifts the camera.
        """
        azimuth, elevation, zoom = self._steering
        if isinstance(value, list):
            azimuth = (azimuth - value[0] + 180.0) % 360.0 - 180.0
            elevation = min(max(elevation + value[1], -MOST_RAISED_DEG), MOST_RAISED_DEG)
        elif isinstance(value, float | int):
            zoom = float(value)
        self._steering = Steering() if name == "recentre" else Steering(azimuth, elevation, zoom)
        self._window.steer(self._steering)
        self._is_news = True

    def _now_ns(self) -> int | None:
        """Return the time for which to compute figures: now, in ns, or None for the time of the last record.

        None is returned if the run is over, or if its journal is not fully read.
        """
        return None if self._is_behind or self._state in ("ended", "failed") else time.monotonic_ns()


def _place_of(folder: Path) -> Path:
    """Return the folder that has the run's files now: `folder` or, after the rename, the folder with the final name."""
    complete = folder.with_name(run_name(folder))
    return folder if folder.is_dir() or not complete.is_dir() else complete


def _jpeg(seen: ShownPicture) -> bytes:
    return jpeg_of(Image.fromarray(seen.pixels))


if __name__ == "__main__":
    main()
