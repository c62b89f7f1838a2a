"""What was asked for on the command line, as a RunConfig whose every part was looked at.

Rule: motion, camera, background, avatar and runtime are opened and checked here, in the parent, so that a bad
input ends the command before a process is started or a file is made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from trilane.apps.machine import gl_facts, machine_facts
from trilane.avatars.bundle import Bundle, load_bundle
from trilane.avatars.network_split import split
from trilane.body.body import load_body
from trilane.errors import BadInputError, MissingPartError
from trilane.hw_profiles.host import host_units
from trilane.hw_profiles.load import HOST, load_profile
from trilane.hw_profiles.runtimes import fastest_runtime
from trilane.scene.schema import Scene
from trilane.scene.staging import stage_scene
from trilane.scene.validate import find_scene, load_scene, located, scene_from
from trilane.stages.config import NetworkCut, RunConfig
from trilane.stages.dsp.runtime import RUNTIMES, installed, resolve
from trilane.stages.gpu.background import open_background

GL_INSTALL = "apt-get install libegl1 libgl1-mesa-dri"
ROOM = "room"
COMMAND_LINE = "command line"


@dataclass(frozen=True)
class Request:
    """The options of `trilane run`; None leaves what the scene says."""

    scene: str = "default"
    motion: str | None = None
    camera: str | None = None
    background: str | None = None
    avatar: str | None = None
    frames: int | None = None
    size: str | None = None
    runtime: str = "auto"
    hud: bool | None = None
    skinning: str = "auto"
    split: tuple[str, ...] = ()


@dataclass(frozen=True)
class Checked:
    """A configuration that can be run, what the loads said of their sources, and the avatars' own figures."""

    config: RunConfig
    notes: tuple[str, ...]
    accuracy: Mapping[str, Any]


def requested_scene(request: Request) -> Scene:
    """The scene file with the options laid over it. Raises BadInputError.

    A motion or camera from the command line drops what the scene says of its own file's format.
    """
    values = load_scene(find_scene(request.scene))
    here = Path.cwd()
    values.update(
        {key: getattr(request, key) for key in ("frames", "size", "hud") if getattr(request, key) is not None}
    )
    if request.background is not None:
        values["background"] = located(request.background, here)
    if request.camera is not None:
        values["camera"] |= {"source": located(request.camera, here), "format": "auto"}
    first = dict(values["avatars"][0])
    if request.motion is not None:
        first |= {"motion": located(request.motion, here), "up_axis": "auto", "units": "auto"}
    if request.avatar is not None:
        first["bundle"] = located(request.avatar, here)
    values["avatars"] = [first, *values["avatars"][1:]]
    return scene_from(COMMAND_LINE, values)


def configure(request: Request, out_dir: Path) -> Checked:
    """Look at every part of what was asked for. Raises BadInputError or MissingPartError."""
    scene = requested_scene(request)
    runtime, reason = requested_runtime(request.runtime)
    _check_background(scene)
    bundles = [_checked_bundle(spec.bundle) for spec in scene.avatars]
    bodies = {bundle.folder: load_body(bundle.body_path).shape() for bundle in bundles}
    notes = list(stage_scene(scene, [bodies[bundle.folder] for bundle in bundles], Path.cwd()).notes)
    cuts = requested_cuts(request.split, bundles[0])
    unit, why = skinning_unit(request.skinning)
    notes += [f"runtime: {runtime} ({reason})", f"skinning: {unit} unit ({why})"]
    config = RunConfig(
        scene=scene,
        out_dir=out_dir,
        avatar_dirs=tuple(bundle.folder.absolute() for bundle in bundles),
        units=host_units(),
        runtime=runtime,
        posed_vertices=tuple(len(bodies[b.folder].vertices) for b in bundles) if unit == "cpu" else (),
        cuts=cuts,
    )
    return Checked(config, tuple(notes), {bundle.manifest.name: _accuracy(bundle) for bundle in bundles})


def requested_runtime(asked: str) -> tuple[str, str]:
    """The runtime and why: as asked, else the fastest installed one. Raises BadInputError, MissingPartError."""
    if asked == "auto":
        return fastest_runtime(load_profile(HOST), installed())
    if asked not in RUNTIMES:
        raise BadInputError("runtime", repr(asked), f"auto or one of {', '.join(RUNTIMES)}")
    return resolve(asked), "as asked"


def requested_cuts(texts: Sequence[str], bundle: Bundle) -> tuple[NetworkCut, ...]:
    """`TENSOR=UNIT` texts as cuts of the bundle's network. Raises BadInputError."""
    cuts = []
    for text in texts:
        at, _, unit = text.rpartition("=")
        try:
            cuts.append(NetworkCut.model_validate({"at": at, "unit": unit}))
        except ValidationError:
            raise BadInputError("--split", repr(text), "TENSOR=UNIT, with UNIT one of cpu, gpu, dsp") from None
    split(bundle.read_network(), [cut.at for cut in cuts])
    return tuple(cuts)


def _checked_bundle(name: str) -> Bundle:
    bundle = load_bundle(name)
    bundle.read_texture()
    bundle.read_network()
    return bundle


def _check_background(scene: Scene) -> None:
    if scene.background != ROOM:
        open_background(Path(scene.background), (scene.output.height, scene.output.width), scene.fps).close()


def _accuracy(bundle: Bundle) -> dict[str, Any]:
    """The error of the avatar's pictures as its manifest has it; empty when it was never validated."""
    validation = bundle.manifest.validation
    return {} if validation is None else validation.model_dump(mode="json")


def skinning_unit(asked: str) -> tuple[str, str]:
    """`cpu` or `gpu`, and why: what was asked for, else the GPU where the driver is hardware. Raises BadInputError."""
    if asked in ("cpu", "gpu"):
        return asked, "as asked"
    if asked != "auto":
        raise BadInputError("--skinning", repr(asked), "auto, cpu or gpu")
    gl = gl_facts()
    hardware = gl is not None and bool(gl.get("hardware"))
    return ("gpu", "the driver is hardware") if hardware else ("cpu", "the OpenGL driver is software")


def required_machine() -> dict[str, Any]:
    """Facts of this machine. Raises MissingPartError when no OpenGL context can be made."""
    gl = gl_facts()
    if gl is None:
        raise MissingPartError("no OpenGL 3.3 context through EGL", GL_INSTALL)
    return machine_facts(gl)
