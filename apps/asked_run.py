"""A run as somebody asked for it, from options to a run folder: the same for a command line and for a program.

Rule: nothing is printed here. The fork server starts first and imports what the units need while this process goes on,
so what this process needs is imported inside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from trilane.apps.remake import Remake, check_remake
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from trilane.apps.run_job import Hooks, Outcome, Plan, Watched
    from trilane.pipeline.unit_starter import UnitStarter
    from trilane.stages.configure import Checked, GlFacts, Request

MOST_LATCH_MS: Final = 1000
MOST_CHECKED: Final = 1000


@dataclass(frozen=True)
class AskedRun:
    """What was asked for.

    `request`: fields of `trilane.stages.configure.Request`; what is not there is as it has it.
    `edge`: rule of every edge.
    `baseline_frames`: of the `sequential` run that follows; 0: none.
    `paced_by`: a chip at whose pace jobs are held, and how many times slower; None: as fast as it goes.
    `performance_profile`: whose caps hold; None: no cap.
    `latch_ms`: how long before it is needed a pose is sampled.
    `out`: the run folder; None: `runs/TIME-SCENE`.
    `command`: the words by which it was asked for.
    `has_video`: whether the presented pictures are digested and encoded; not for runs that last.
    `check`: how many of its frames are compared with the truth or the float path when it is over; 0: none.
    `remake`: what of the avatar is made anew for the run.
    """

    request: Mapping[str, Any] = field(default_factory=dict)
    edge: str = "double"
    baseline_frames: int = 60
    paced_by: tuple[str, float] | None = None
    performance_profile: str | None = None
    latch_ms: float = 0.0
    out: Path | None = None
    command: tuple[str, ...] = ()
    has_video: bool = True
    check: int = 0
    remake: Remake = field(default_factory=Remake)


def check_numbers(asked: AskedRun) -> None:
    """Raises BadInputError for numbers of what was asked for that are none, or outside of what holds."""
    latch_ms, frames, check = asked.latch_ms, asked.baseline_frames, asked.check
    if not _is_number(latch_ms, (int, float)) or not 0 <= latch_ms <= MOST_LATCH_MS:  # NaN is not either
        raise BadInputError("latch_ms", repr(latch_ms), f"milliseconds, from 0 to {MOST_LATCH_MS}")
    if not _is_number(frames, (int,)) or frames < 0:
        raise BadInputError("baseline_frames", repr(frames), "a whole number of frames, 0 or more")
    if not _is_number(check, (int,)) or not 0 <= check <= MOST_CHECKED:
        raise BadInputError("check", repr(check), f"a whole number of frames, from 0 to {MOST_CHECKED}")
    check_remake(asked.remake)


def _is_number(value: object, kinds: tuple[type, ...]) -> bool:
    """A program hands over anything; a truth value is no number."""
    return isinstance(value, kinds) and not isinstance(value, bool)


@dataclass(frozen=True)
class Prepared:
    """What was `asked` for, `checked`, and how it is to be run."""

    asked: AskedRun
    checked: Checked
    plan: Plan


def run_asked(asked: AskedRun, hooks: Callable[[], AbstractContextManager[Hooks]]) -> Outcome:
    """Check what was asked for, run it and leave its run folder.

    `hooks`: opened when the input is checked and the units start.
    Raises BadInputError and MissingPartError for what cannot be run, TrilaneError when no frame was presented.
    """
    check_numbers(asked)
    with early_processes() as (starter, gl):
        return run_prepared(prepare(asked, gl), hooks=hooks, starter=starter, gl=gl)


def prepare(asked: AskedRun, gl: GlFacts) -> Prepared:
    """Check what was asked for. Raises BadInputError and MissingPartError for what cannot be run."""
    check_numbers(asked)
    from trilane.apps.run_job import Plan
    from trilane.stages.configure import Request, configure, requested_edge

    rule, request = requested_edge(asked.edge), Request(**asked.request)
    said: tuple[str, ...] = ()
    if asked.remake.is_asked:
        request, remade = _with_remade_avatar(request, asked.remake, is_checked=asked.check > 0)
        said = (remade,)
    checked = configure(request, Path.cwd(), gl)
    if said:
        checked = replace(checked, notes=(*said, *checked.notes))
    plan = Plan(request.policy, asked.baseline_frames, None, asked.performance_profile, asked.latch_ms, rule)
    if asked.check:
        _require_check(checked)
        plan = replace(plan, check=asked.check)
    if asked.paced_by is not None:
        from trilane.apps.pace import pace_of

        pace = pace_of(checked.config, *asked.paced_by)
        plan, checked = replace(plan, pace=pace), checked.changed(pace_ns=dict(pace.stage_ns))
    if not asked.has_video:
        checked = checked.changed(record=False)
    return Prepared(asked, checked, plan)


def _with_remade_avatar(request: Request, remake: Remake, *, is_checked: bool) -> tuple[Request, str]:
    """`request` with the avatar made anew, and a sentence on it. Raises BadInputError, MissingPartError."""
    from trilane.apps.remade_avatar import is_untrained, remade_avatar
    from trilane.avatars.bundle import load_bundle
    from trilane.stages.configure import requested_scene

    avatars = requested_scene(request).avatars
    if len(avatars) > 1:
        expected = "one avatar, whose network is made anew"
        raise BadInputError("--width, --channels, --calibration", f"a scene of {len(avatars)} avatars", expected)
    folder, said = remade_avatar(str(avatars[0].bundle), remake)
    if is_checked and is_untrained(load_bundle(folder)):
        raise BadInputError("--check", "a network that is made untrained", "pictures that mean something")
    return replace(request, avatar=str(folder)), f"avatar: {said}"


def _require_check(checked: Checked) -> None:
    """Raises BadInputError, MissingPartError for what nothing can be compared with: found out before the run."""
    from trilane.apps.run_check import require_parts
    from trilane.avatars.bundle import load_bundle

    require_parts(load_bundle(folder) for folder in dict.fromkeys(checked.config.avatar_dirs))
    if checked.config.scene.hud:
        raise BadInputError("--check", "a scene with a HUD", "pictures without", "--no-hud leaves it out")


@contextmanager
def early_processes() -> Iterator[tuple[UnitStarter, GlFacts]]:
    """The fork server, which imports what the units need while this process goes on, and what it says of OpenGL.

    The driver is looked at in a process of its own, because it may crash.
    """
    from trilane.pipeline.unit_starter import UnitStarter
    from trilane.stages import PRELOAD

    with UnitStarter(PRELOAD) as starter, closing(starter.call("trilane.stages.machine_facts:open_gl")) as gl:
        yield starter, cache(gl.result)


def run_prepared(
    prepared: Prepared,
    *,
    hooks: Callable[[], AbstractContextManager[Hooks]],
    starter: UnitStarter,
    gl: GlFacts,
    watched: Watched | None = None,
) -> Outcome:
    """Run what was checked and leave its run folder.

    `hooks`: as of `run_asked`. `starter`, `gl`: of `early_processes`. `watched`: by whom; None: by nobody.
    Raises as `run_asked`.
    """
    from trilane.apps.made import made_facts
    from trilane.apps.run_folder import default_place
    from trilane.apps.run_job import run_to_folder
    from trilane.stages.configure import required_machine

    asked, checked, plan = prepared.asked, prepared.checked, prepared.plan
    target = asked.out or default_place(checked.config.scene.name)
    with hooks() as told:
        for note in checked.notes:
            told.message(note)
        try:
            made = made_facts(list(asked.command))
            machine = required_machine(gl)
            return run_to_folder(
                checked, target, plan, told, machine=machine, made=made, starter=starter, watched=watched
            )
        except KeyboardInterrupt:
            told.message("interrupted: nothing was written")
            raise
