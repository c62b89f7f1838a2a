"""Runs a scene or a pipeline file under a dashboard, with a new run for each configuration that the page requests.

Rule: this process runs the pipeline with the code of `trilane run`. The page's server is another process, and neither
waits for the other. Some controls change the running run. Other controls need a new run, and their values are checked
like a command line. If the values are valid, the run ends cleanly, and a new run starts with its own folder. A pipeline
file has only one run.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from trilane.apps.dashboard.access import listen
from trilane.apps.dashboard.channel import (
    ChangesAsked,
    ChangesRefused,
    ControlAsked,
    Message,
    RunBegins,
    ServerLink,
    StateIs,
)
from trilane.apps.dashboard.run_facts import (
    OF_A_NEW_RUN,
    controls_of_file,
    controls_of_run,
    facts_of_checked,
    facts_of_config,
)
from trilane.apps.run.asked_run import early_processes, prepare, run_prepared
from trilane.apps.run.run_job import ENDLESS, Hooks, Prepared, RunOutcome, Watched
from trilane.apps.watch.followed_run import run_name
from trilane.avatars.bundle import MANIFEST
from trilane.errors import TrilaneError
from trilane.options import option_of
from trilane.pipeline.controls import ALL, RunControls
from trilane.pipeline.description import Pipeline
from trilane.stages.configure import Checked, GlFacts, required_machine
from trilane.stages.dsp.runtime import installed
from trilane.stages.run_options import RunOptions
from trilane.units import AVATARS, UNITS

OpenHooks = Callable[[], AbstractContextManager[Hooks]]
RUNNING, PAUSED, RESTARTING, ENDED, FAILED = "running", "paused", "restarting", "ended", "failed"
#: Control that holds or continues the run -> number of frames that the run may release, and the run's new state.
HOLDS: Final = {"play": (ALL, RUNNING), "pause": (0, PAUSED), "step": (1, PAUSED)}
MOST_AVATARS: Final = 20
#: Name of the control in a refusal of several changes that were requested together.
RESTART: Final = "restart"


def run_live(
    options: RunOptions, hooks: OpenHooks, command: tuple[str, ...], port: int | None, tell: Callable[[str], None]
) -> RunOutcome:
    """Run a scene under a dashboard, and each configuration that the page requests. Return the outcome of the last run.

    `options`: options of the first run. If they state a number of frames, each run ends after this number. Otherwise,
    an interrupt ends the last run.
    `hooks`, `command`: as in `run_asked`. `port`: as in `listen`.
    `tell`: function that gets the page's address, and other sentences for a person.
    Raises the errors of `run_asked` and `listen`.
    """
    with early_processes() as (starter, gl):
        first = prepare(options.changed(baseline_frames=0), gl, command)
        output = first.checked.config.scene.output
        runs = _Runs(
            partial(prepare, gl=gl, command=command),
            gl,
            partial(run_prepared, hooks=hooks, starter=starter, gl=gl),
            tell,
        )
        with contextlib.closing(listen(port)) as place:
            runs.link = ServerLink(place, output.height, output.width, runs.director.do, tell)
            tell(f"dashboard: {place.url}")
        with contextlib.closing(runs.link):
            return runs.run_all(first)


class _Runs:
    """Executes successive runs.

    `prepare`: function that checks the options of a run.
    `gl`: function that returns the facts about OpenGL, from `early_processes`.
    `run`: function that runs a prepared run.
    `tell`: as in `run_live`.

    `link`: link to the server; set it before the first run. `director`: carries out the page's requests.
    """

    link: ServerLink

    def __init__(
        self,
        prepare: Callable[[RunOptions], Prepared],
        gl: GlFacts,
        run: Callable[..., RunOutcome],
        tell: Callable[[str], None],
    ) -> None:
        self._gl, self._run, self._tell = gl, run, tell
        self._count = 0
        self.director = Director(prepare, lambda message: self.link.send(message))

    def run_all(self, first: Prepared) -> RunOutcome:
        """Run `first`, followed by each run that the page requests. Return the outcome of the last run.

        A run that ends early is the last run. If a run leaves no folder, such as a run without a presented frame, the
        requested run follows. Without a request, the configuration before it runs again. Raises TrilaneError if there
        is no such configuration, or if that run leaves no folder either.
        """
        now, before = first, None
        while True:
            try:
                outcome = self._run_one(now)
            except TrilaneError as error:
                following = self.director.take_next() or before
                if following is None:
                    self.link.send(StateIs(FAILED, str(error)))
                    raise
                self.link.send(ChangesRefused("", f"the run did not begin: {error}"))
                now, before = following, None
                continue
            following = self.director.take_next()
            if following is None or outcome.exit_code:
                failure = outcome.report.failure
                self.link.send(StateIs(FAILED if failure else ENDED, failure or ""))
                return outcome
            self._tell(f"run folder: {outcome.folder}")
            self.link.send(StateIs(RESTARTING, "the last run is written; the next one is made ready"))
            now, before = following, now

    def _run_one(self, prepared: Prepared) -> RunOutcome:
        options = prepared.options
        controls = self.director.begin(prepared)
        show = partial(self.director.show, required_machine(self._gl))
        frames = None if options.frames else ENDLESS
        self._count += 1
        if options.out is not None:
            prepared = replace(prepared, options=options.changed(out=_numbered(options.out, self._count)))
        return self._run(prepared, watched=Watched(frames, self.link.window, controls, show))


def _numbered(folder: Path, number: int) -> Path:
    """Return the folder for the run with number `number`, counted from 1.

    The first run gets `folder` itself. Later runs get a folder beside it, with the number at the end of the name.
    """
    return folder if number == 1 else folder.with_name(f"{folder.name}-{number}")


class Director:
    """Carries out the page's requests in successive runs.

    One thread calls `do`. Another thread calls all other methods.
    `prepare`: function that checks the options of a run.
    `send`: function that sends a message to the server.
    """

    def __init__(self, prepare: Callable[[RunOptions], Prepared], send: Callable[[Message], None]) -> None:
        self._prepare, self._send = prepare, send
        self._lock = threading.Lock()
        self._now: Prepared | None = None
        self._next: Prepared | None = None
        self._controls: RunControls | None = None

    def begin(self, prepared: Prepared) -> RunControls:
        """Make `prepared` the present run, and return the object through which `do` steers it."""
        with self._lock:
            self._now, self._next, self._controls = prepared, None, RunControls()
            return self._controls

    def show(self, machine: Mapping[str, Any], folder: Path, checked: Checked) -> None:
        """Tell the server that a run begins.

        `machine`: facts about the machine, as in report.json.
        `folder`: folder with the run's journal.
        `checked`: checked configuration of the run.
        """
        assert self._now is not None
        options = self._now.options
        facts = facts_of_checked(run_name(folder), checked, options, machine)
        choices = choices_of(facts.config)
        controls = controls_of_run(UNITS, choices, reasons_against(options))
        self._send(RunBegins(str(folder), asdict(facts), [asdict(control) for control in controls]))
        self._send(StateIs(RUNNING, ""))

    def take_next(self) -> Prepared | None:
        """Return and forget the run that the page requested; None without a request since the last call."""
        with self._lock:
            taken, self._next = self._next, None
            return taken

    def do(self, asked: ControlAsked | ChangesAsked) -> None:
        """Carry out the request `asked` of the page. The server has already checked all names and values in it."""
        with self._lock:
            controls = self._controls
        if controls is None:
            return
        if isinstance(asked, ChangesAsked):
            if all(name in OF_A_NEW_RUN and isinstance(word, str) for name, word in asked.values.items()):
                self._change(controls, asked.values)
        elif asked.control in HOLDS:
            frames, state = HOLDS[asked.control]
            controls.hold(frames)
            self._send(StateIs(state, ""))
        elif asked.control == "kill" and asked.value in UNITS:
            controls.kill(str(asked.value))

    def _change(self, controls: RunControls, values: Mapping[str, str]) -> None:
        with self._lock:
            current = self._next or self._now
        assert current is not None
        try:
            changes = {name: RunOptions.value_of(name, word) for name, word in values.items()}
            prepared = self._prepare(current.options.changed(**changes))
        except TrilaneError as error:
            self._send(ChangesRefused(next(iter(values)) if len(values) == 1 else RESTART, str(error)))
            return
        with self._lock:
            self._next = prepared
        told = ", ".join(f"{name.replace('_', ' ')} {word}" for name, word in values.items())
        self._send(StateIs(RESTARTING, f"{told}: the frames in flight are finished"))
        controls.stop()


def choices_of(config: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the valid values of each control in OF_A_NEW_RUN, by the control's name.

    `config`: present value of each control, which is always valid.
    """
    found = {"runtime": installed(), "avatar": (*AVATARS, *_neighbours(config["avatar"]))}
    choices = {}
    for name in OF_A_NEW_RUN:
        offered = option_of(RunOptions.model_fields[name]).offered or ()
        choices[name] = tuple(dict.fromkeys([*offered, *found.get(name, ()), config[name]]))
    return choices


def reasons_against(options: RunOptions) -> dict[str, str]:
    """Return why controls in OF_A_NEW_RUN are disabled in a run with `options`, by the control's name.

    Enabled controls are not in the result.
    """
    if options.pace:
        return {"performance_profile": "the run is held to a chip's pace, which is capped already"}
    return {}


def _neighbours(avatar: str) -> Iterator[str]:
    """Yield the paths of the first `MOST_AVATARS` avatars in the parent folder of `avatar`, in alphabetical order.

    Yield nothing if `avatar` is a built-in name or no folder.
    """
    folder = Path(avatar)
    if avatar not in AVATARS and folder.is_dir():
        yield from [str(manifest.parent) for manifest in sorted(folder.parent.glob(f"*/{MANIFEST}"))[:MOST_AVATARS]]


#: Height and width of the window if the pipeline file has no block `encode`, and therefore no pictures.
NO_PICTURE: Final = (2, 2)


def run_file_live(
    options: RunOptions, hooks: OpenHooks, command: tuple[str, ...], port: int | None, tell: Callable[[str], None]
) -> RunOutcome:
    """Run a pipeline file under a dashboard, and return the outcome.

    The page can only hold the run, step it and kill units.
    `options`: options of the run, with the pipeline file. If neither a number of frames nor the file's key `arrivals`
    limits the run, an interrupt ends it.
    `hooks`, `command`, `port`, `tell`, and the errors raised: as in `run_live`.
    """
    from trilane.apps.run.run_file import run_file

    with contextlib.ExitStack() as stack:
        place = stack.enter_context(contextlib.closing(listen(port)))
        watch = FileWatch(
            lambda height, width, hear: stack.enter_context(
                contextlib.closing(ServerLink(place, height, width, hear, tell))
            )
        )
        tell(f"dashboard: {place.url}")
        try:
            outcome = run_file(options, hooks, command, watch)
        except TrilaneError as error:
            watch.ends(FAILED, str(error))
            raise
        failure = outcome.report.failure
        watch.ends(FAILED if failure else ENDED, failure or "")
        return outcome


class FileWatch:
    """Shows a pipeline file's run on the page, and passes the page's requests to the run.

    It is a viewer as `trilane.apps.run.run_file.Watch` describes.
    `link`: function that makes the link to the page's server. Its first arguments are the height and width of pictures
    in pixels. Its last argument is a function that gets each request of the page, on a thread of its own.
    """

    def __init__(self, link: Callable[[int, int, Callable[[ControlAsked | ChangesAsked], None]], ServerLink]) -> None:
        self.controls = RunControls()
        self._make = link
        self._link: ServerLink | None = None

    def begins(self, folder: Path, pipeline: Pipeline, facts: Mapping[str, Any]) -> Path:
        config = facts["config"]
        output = config["scene"].get("output")
        sides = (output["height"], output["width"]) if output else NO_PICTURE
        height, width = (max(side // 2 * 2, 2) for side in sides)  # even, as the sides of the video
        link = self._link = self._make(height, width, self.do)
        said = facts_of_config(run_name(folder), config, facts["machine"], {})
        controls = controls_of_file(list(pipeline.units))
        link.send(RunBegins(str(folder), asdict(said), [asdict(control) for control in controls]))
        link.send(StateIs(RUNNING, ""))
        return link.window

    def ends(self, state: str, why: str) -> None:
        """Tell the page that the run is over.

        `state`: ended or failed.
        `why`: reason of a failure, "" without a failure.
        """
        if self._link is not None:
            self._link.send(StateIs(state, why))

    def do(self, asked: ControlAsked | ChangesAsked) -> None:
        """Carry out the request `asked` of the page. Requests for a new run are ignored.

        The server has already checked the request.
        """
        if isinstance(asked, ChangesAsked):
            return
        if asked.control in HOLDS:
            frames, state = HOLDS[asked.control]
            self.controls.hold(frames)
            if self._link is not None:
                self._link.send(StateIs(state, ""))
        elif asked.control == "kill":
            self.controls.kill(str(asked.value))
