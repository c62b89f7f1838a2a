"""One run after the other under a page: what follows which, with doubles of the runs and of the server."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from trilane import machine
from trilane.apps.dashboard import access, live_run
from trilane.apps.dashboard.channel import ChangesAsked, ChangesRefused, Message, StateIs
from trilane.apps.dashboard.live_run import ENDLESS, _Runs
from trilane.apps.run.run_job import Prepared, Watched
from trilane.errors import BadInputError, MissingPartError, TrilaneError
from trilane.stages.run_options import RunOptions


def prepared(options: RunOptions) -> Prepared:
    return Prepared(options, None)  # type: ignore[arg-type]


class World:
    """`script`: for each run what happens while it goes on, which may raise; `begun`: policy and folder of each."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *script: Callable[[], Any]) -> None:
        self.begun: list[tuple[str, str | None, int | None]] = []
        self.told: list[Message] = []
        self.sentences: list[str] = []
        self._script = iter(script)
        monkeypatch.setattr(live_run, "required_machine", lambda _gl: {})
        self.runs = _Runs(prepared, lambda: None, self._run, self.sentences.append)
        self.runs.link = SimpleNamespace(send=self.told.append, window=None)  # type: ignore[assignment]

    def _run(self, prepared: Prepared, watched: Watched) -> Any:
        out = prepared.options.out
        self.begun.append((prepared.options.policy, out and str(out), watched.frames))
        exit_code, failure = next(self._script)() or (0, None)
        return SimpleNamespace(exit_code=exit_code, folder=str(out), report=SimpleNamespace(failure=failure))

    def ask(self, policy: str) -> None:
        self.runs.director.do(ChangesAsked({"policy": policy}))

    def run_all(self, **options: Any) -> Any:
        return self.runs.run_all(prepared(RunOptions(**options)))

    @property
    def states(self) -> list[str]:
        return [message.state for message in self.told if isinstance(message, StateIs)]


def test_a_run_that_is_interrupted_is_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, lambda: (130, None))
    assert world.run_all().exit_code == 130
    assert (world.begun, world.states) == ([("pipelined", None, ENDLESS)], ["ended"])


def test_frames_that_were_asked_for_are_the_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, lambda: None)
    world.run_all(frames=60)
    assert world.begun == [("pipelined", None, None)]


def test_what_the_page_asks_for_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, lambda: world.ask("latest"), lambda: world.ask("sequential"), lambda: (130, None))
    world.run_all()
    assert [policy for policy, _, _ in world.begun] == ["pipelined", "latest", "sequential"]
    assert world.states == ["restarting", "restarting", "restarting", "restarting", "ended"]  # asked for, made ready
    assert len(world.sentences) == 2  # where the runs before the last are


def test_a_change_that_cannot_begin_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def dies() -> None:
        raise TrilaneError("unit dsp could not start")

    world = World(monkeypatch, lambda: world.ask("latest"), dies, lambda: (130, None))
    world.run_all()
    assert [policy for policy, _, _ in world.begun] == ["pipelined", "latest", "pipelined"]
    assert [message for message in world.told if isinstance(message, ChangesRefused)] == [
        ChangesRefused("", "the run did not begin: unit dsp could not start")
    ]


def test_a_run_that_is_stopped_before_its_first_frame_is_followed_by_what_was_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def stops() -> None:
        world.ask("latest")
        raise TrilaneError("no frame was presented")

    world = World(monkeypatch, stops, lambda: (130, None))
    world.run_all()
    assert [policy for policy, _, _ in world.begun] == ["pipelined", "latest"]
    world = World(monkeypatch, lambda: world.ask("sequential"), stops, lambda: (130, None))
    world.run_all()
    assert [policy for policy, _, _ in world.begun] == ["pipelined", "sequential", "latest"]


def test_a_first_run_that_cannot_begin_is_an_error_and_one_that_fails_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def dies() -> None:
        raise TrilaneError("unit dsp could not start")

    world = World(monkeypatch, dies)
    with pytest.raises(TrilaneError, match="could not start"):
        world.run_all()
    assert world.states == ["failed"]
    world = World(monkeypatch, lambda: (1, "unit dsp could not be kept alive"))
    assert world.run_all().exit_code == 1
    assert world.told == [StateIs("failed", "unit dsp could not be kept alive")]


def test_what_is_not_installed_is_named_with_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.here, "has_package", lambda name: name != "uvicorn")
    with pytest.raises(MissingPartError, match=r"needs the package uvicorn.*\[dashboard\]") as missing:
        access.require_server()
    assert missing.value.exit_code == 3


def test_a_port_in_use_is_an_error_of_the_option() -> None:
    place = access.listen(None)
    assert place.url == f"http://127.0.0.1:{place.port}/?token={place.token}" and len(place.token) >= 32
    with pytest.raises(BadInputError, match=f"--port: found {place.port}, which is in use"):
        access.listen(place.port)
    place.close()
