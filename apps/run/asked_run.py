"""A run from its options to its run folder, for the command line and for programs alike.

Rule: nothing is printed here. To save time, the fork server starts first, and imports the units' modules while this
process prepares the run. Therefore, each function here imports the modules that it needs only when it is called.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from trilane.errors import BadInputError
from trilane.machine import require_memory
from trilane.stages.run_options import RunOptions

if TYPE_CHECKING:
    from trilane.apps.run.run_job import Hooks, Prepared, RunOutcome, Watched
    from trilane.pipeline.unit_starter import UnitStarter
    from trilane.stages.configure import Checked, GlFacts


def run_asked(
    options: RunOptions,
    hooks: Callable[[], AbstractContextManager[Hooks]],
    command: tuple[str, ...] = (),
) -> RunOutcome:
    """Check the options, run the scene or pipeline file, and leave its run folder.

    `options`: options of the run.
    `hooks`: function that returns a context manager. The context manager yields the callbacks of the run, and is
    entered when a run begins, or when a long check has a message.
    `command`: words of the command line.
    Raises BadInputError for wrong input and MissingPartError for an absent part, both before the run begins. Raises
    TrilaneError if no frame was presented, or if a file could not be written. Raises KeyboardInterrupt if a signal
    ended the run before its first frame.
    """
    from trilane.pipeline.pipeline_file import is_pipeline_file

    if is_pipeline_file(Path(options.scene)):
        from trilane.apps.run.run_file import run_file

        return run_file(options, hooks, command)
    options.check_together()
    _require_free(options)
    with early_processes() as (starter, gl):
        return run_prepared(prepare(options, gl, command, hooks), hooks=hooks, starter=starter, gl=gl)


def _require_free(options: RunOptions) -> None:
    """Raise BadInputError if the folder of `--out` exists, before any work. The run folder checks again later."""
    from trilane.apps.run.run_folder import require_free

    if options.out is not None:
        with suppress(OSError):  # the run folder raises a better error about the place
            require_free(options.out.absolute())


def prepare(
    options: RunOptions,
    gl: GlFacts,
    command: tuple[str, ...] = (),
    hooks: Callable[[], AbstractContextManager[Hooks]] | None = None,
) -> Prepared:
    """Check `options`, and return the prepared run.

    `gl`: function from `early_processes`. `command`: words of the command line.
    `hooks`: see `run_asked`; a message is sent if the check takes long. For None, no message is sent.
    Raises BadInputError for wrong input, and MissingPartError if a part that the run needs is absent.
    """

    def say(text: str) -> None:
        if hooks is not None:
            with hooks() as told:
                told.message(text)

    options.check_together()
    from trilane.apps.run.run_job import Prepared
    from trilane.stages.configure import configure

    requested, said = _with_remade_avatar(options) if options.remakes_avatar else (options, ())
    checked = configure(requested, Path.cwd(), gl, needs_person=not requested.allow_empty, say=say)
    if said:
        checked = replace(checked, notes=(*said, *checked.notes))
    if options.check:
        _require_check(checked)
    pace = None
    if options.profile is not None:
        from trilane.apps.run.pace import pace_of

        pace = pace_of(checked.config, options.profile, options.slow_motion)
        checked = checked.changed(pace_ns=dict(pace.stage_ns))
    if not options.video:
        checked = checked.changed(record=False)
    return Prepared(options, checked, pace, command)


def _with_remade_avatar(options: RunOptions) -> tuple[RunOptions, tuple[str, ...]]:
    """Return (options, notes): `options` with the variant of the avatar that they request, and notes on the variant.

    Raises BadInputError for a scene of several avatars, for a check of an untrained network, and for a variant that
    cannot be made. Raises MissingPartError without PyTorch or OpenGL.
    """
    from trilane.apps.avatar_files import is_untrained, remade_avatar
    from trilane.avatars.bundle import load_bundle
    from trilane.stages.configure import requested_scene

    avatars = requested_scene(options).avatars
    if len(avatars) > 1:
        expected = "one avatar, whose network is made again"
        raise BadInputError("--width, --channels, --calibration", f"a scene of {len(avatars)} avatars", expected)
    folder, said = remade_avatar(str(avatars[0].bundle), options)
    if options.check and is_untrained(load_bundle(folder)):
        raise BadInputError("--check", "a network that is made untrained", "pictures that mean something")
    return options.changed(avatar=folder), (f"avatar: {said}",)


def _require_check(checked: Checked) -> None:
    """Raise an error before the run if `--check` is not possible.

    Raises BadInputError for a scene with a HUD, because the reference pictures have no HUD. Raises MissingPartError if
    a library that the check needs is not installed.
    """
    from trilane.apps.run.run_job import require_parts
    from trilane.avatars.bundle import load_bundle

    require_parts(load_bundle(folder) for folder in dict.fromkeys(checked.config.avatar_dirs))
    if checked.config.scene.hud:
        raise BadInputError("--check", "a scene with a HUD", "pictures without", "--no-hud leaves it out")


@contextmanager
def early_processes() -> Iterator[tuple[UnitStarter, GlFacts]]:
    """Start the fork server, and a process that examines the OpenGL driver, because a driver may crash its process.

    Yield (fork server, function). The function waits for the facts about OpenGL and returns them.
    Raises TrilaneError if there is too little memory for a run.
    """
    require_memory()
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
) -> RunOutcome:
    """Run a prepared scene and leave its run folder. Raises the errors of `run_asked`.

    `prepared`: result of `prepare`. `hooks`: see `run_asked`. `starter`, `gl`: fork server and function from
    `early_processes`. `watched`: viewer of the run; None if nobody watches the run.
    """
    from trilane.apps.run.report_facts import made_facts
    from trilane.apps.run.run_folder import default_place
    from trilane.apps.run.run_job import run_to_folder
    from trilane.stages.configure import required_machine

    target = prepared.options.out or default_place(prepared.checked.config.scene.name)
    with hooks() as told:
        for note in prepared.checked.notes:
            told.message(note)
        try:
            made = made_facts(prepared.command)
            machine = required_machine(gl)
            return run_to_folder(prepared, target, told, machine=machine, made=made, starter=starter, watched=watched)
        except KeyboardInterrupt:
            said = "interrupted: nothing was written"
            told.message(said)
            raise KeyboardInterrupt(said) from None
