"""Turns the options of a run into a RunConfig, and checks all its parts.

Rule: motion, camera, background, avatar and runtime are opened and checked here, in the parent. Therefore a bad input
ends the command before a process is started or a file is made.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import NetworkFile
from trilane.avatars.network_split import split
from trilane.avatars.validation import DrawnAs, SizeLoss, accuracy_of, size_loss
from trilane.errors import EGL_LINE, BadInputError, MissingPartError, TrilaneError, did_you_mean
from trilane.hw_profiles.host import asked_cores, fastest_runtime, rule_placement, settings_of, usable_cores
from trilane.hw_profiles.profile_files import load_profile
from trilane.machine import shortage
from trilane.pipeline.memory import Assets
from trilane.scene.schema import BUILT_IN_PREFIX, FILE_KEYS, Scene, find_scene, load_scene, located, scene_from
from trilane.scene.staging import require_person, stage_scene
from trilane.scene.tensor_budget import TensorBudget
from trilane.stages.avatar_assets import AvatarData, load_avatar, networks_of_avatars, pack_assets
from trilane.stages.config import NetworkCut, RunConfig
from trilane.stages.dsp.runtime import RUNTIMES, installed, resolve
from trilane.stages.foresee import Painted, foresee, tensor_works
from trilane.stages.machine_facts import gl_facts, machine_facts
from trilane.stages.run_options import RunOptions
from trilane.units import HOST, ROOM

COMMAND_LINE = "command line"
#: Key of a scene for each option of a run that has another name.
KEYS = {"picture": "output"}

GlFacts = Callable[[], dict[str, Any] | None]


@dataclass(frozen=True)
class Checked:
    """A configuration that can be run.

    `assets`: arrays that were loaded to check the configuration, in the form that units take.
    `notes`: sentences for a person about the sources of the configuration and the choices in it.
    `accuracy`: result of `accuracy_of` for each avatar, by its name.
    `asked_cores`: cores that the options request for units.
    `placement`: facts from `trilane.stages.placing` about the units' cores; None before the cores are chosen.
    `losses`: loss of PSNR of each distinct avatar in tensors below full size; without figures if it was not measured.
    """

    config: RunConfig
    assets: Assets
    notes: tuple[str, ...]
    accuracy: Mapping[str, Any]
    asked_cores: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    placement: Mapping[str, Any] | None = None
    losses: tuple[SizeLoss, ...] = ()

    def changed(self, **values: Any) -> Checked:
        """Return this run with other `values` of the configuration, such as `out_dir`, `record` or `units`."""
        return replace(self, config=self.config.model_copy(update=values))


def requested_scene(options: RunOptions) -> Scene:
    """Return the scene of the scene file, changed by the options. Raises BadInputError.

    An option that is a key of the scene replaces its value. The options `motion` and `avatar` change the first avatar.
    For a new motion or camera file, the scene's keys about the old file's format are left out. For a built-in camera,
    all keys about the scene's camera file are left out.
    """
    values = load_scene(find_scene(options.scene))
    here, camera = Path.cwd(), values["camera"]
    keys = {KEYS.get(name, name): value for name, value in options if value is not None}
    values |= {key: value for key, value in keys.items() if key in Scene.model_fields}
    if options.camera is not None:
        source = located(options.camera, here)
        dropped = FILE_KEYS if source.startswith(BUILT_IN_PREFIX) else ("format",)
        values["camera"] = {key: value for key, value in camera.items() if key not in dropped} | {"source": source}
    if options.background is not None:
        values["background"] = located(options.background, here)
    if options.picture is not None:
        values["output"] = _picture(options.picture)
    first = dict(values["avatars"][0])
    if options.motion is not None:
        first |= {"motion": located(options.motion, here), "up_axis": "auto", "units": "auto"}
    if options.avatar is not None:
        first["bundle"] = located(options.avatar, here)
    values["avatars"] = [first, *values["avatars"][1:]]
    return scene_from(COMMAND_LINE, values)


def _picture(text: str) -> dict[str, int]:
    """Return the scene's key `output` from the text WIDTHxHEIGHT. Raises BadInputError."""
    match = re.fullmatch(r"([0-9]{1,9})x([0-9]{1,9})", text)
    if match is None:
        raise BadInputError("--picture", repr(text), "WIDTHxHEIGHT in pixels, such as 640x480")
    return {"width": int(match[1]), "height": int(match[2])}


def configure(
    options: RunOptions,
    out_dir: Path,
    gl: GlFacts = gl_facts,
    *,
    needs_person: bool = False,
    say: Callable[[str], object] = lambda _: None,
) -> Checked:
    """Return the checked configuration of the run that the options request. Raises BadInputError or MissingPartError.

    `out_dir`: run folder.
    `gl`: function that returns facts about the OpenGL driver.
    `needs_person`: whether to refuse a recorded camera that does not show the person in half of the frames.
    `say`: function that is called with sentences while this check takes long.
    """
    scene = requested_scene(options)
    if scene.plan == "full":
        raise BadInputError(
            f"{find_scene(options.scene)}: plan",
            "full",
            "planned or fixed",
            "`trilane bench planner` draws the full plan to compare",
        )
    asked = asked_cores(options.cores)
    runtime, reason = requested_runtime(options.runtime)
    footage = None
    if scene.background != ROOM:
        from trilane.stages.gpu.background import survey  # it is slow to import, and seldom needed here

        footage = survey(Path(scene.background), scene.fps)
    bundles = {spec.bundle: load_bundle(spec.bundle) for spec in scene.avatars}
    avatars = {bundle.folder.absolute(): load_avatar(bundle) for bundle in bundles.values()}
    folders = tuple(bundles[spec.bundle].folder.absolute() for spec in scene.avatars)
    numbers = dict(zip(avatars, networks_of_avatars(list(avatars.values())), strict=True))
    networks = {numbers[folder]: avatar.network for folder, avatar in avatars.items()}
    bodies = [avatars[folder].shaped for folder in folders]
    staged = stage_scene(scene, bodies, Path.cwd(), footage)
    if needs_person:
        require_person(scene, staged, bodies, Path.cwd(), footage, say)
    if footage is not None:
        from trilane.stages.gpu.background import check_pictures

        check_pictures(Path(scene.background), scene.fps, scene.frames, staged.camera.path)
    cuts = requested_cuts(options.split, list(networks.values()))
    unit, why = skinning_unit(options.skinning, gl)
    own = max(network.shape[1] * network.shape[2] for network in networks.values())
    sharing = Counter(numbers[folder] for folder in folders)
    losses = tuple(size_loss(avatar.bundle, sharing[numbers[folder]]) for folder, avatar in avatars.items())
    curves = tuple(loss.curve for loss in losses) if all(loss.curve for loss in losses) else ()
    whole = TensorBudget(own, scene.most_side**2, curves=curves)
    works, sizes = tensor_works(scene, options.policy, losses)
    budgets = [whole.scaled(work) for work in works]
    painters = tuple(numbers[folder] for folder in folders) if len(networks) > 1 else ()
    painted = Painted(list(networks.values()), painters)
    foreseen = foresee(scene, staged, bodies, painted, budgets) if scene.plans_tensor else None
    config = RunConfig(
        scene=scene,
        out_dir=out_dir,
        avatar_dirs=folders,
        units=settings_of(rule_placement(usable_cores(), asked)),
        runtime=runtime,
        networks=painters,
        shapes=foreseen.shapes.shapes if foreseen else (),
        changes=foreseen.changes if foreseen else (),
        own_pixels=whole.own,
        size_curves=whole.curves,
        works=works,
        posed_vertices=tuple(len(avatars[folder].shaped.vertices) for folder in folders) if unit == "cpu" else (),
        cuts=cuts,
    )
    notes = (*staged.notes, f"runtime: {runtime} ({reason})", f"skinning: {unit} unit ({why})")
    notes += (f"networks: {len(networks)}, each with a tensor and an inference of its own",) if painters else ()
    notes += foreseen.notes(scene.memory_mb, scene.most_side) if foreseen else ()
    notes += (sizes,) if sizes else ()
    drawn = DrawnAs(runtime, scene.size, scene.texture_filter)
    accuracy = _accuracy([(avatar, sharing[numbers[folder]]) for folder, avatar in avatars.items()], drawn)
    packed = pack_assets(list(avatars.values()), staged)
    return Checked(config, packed, notes, accuracy, asked, losses=losses)


def requested_runtime(asked: str) -> tuple[str, str]:
    """Return (runtime, reason): the runtime `asked`, or for `auto` the fastest installed runtime.

    Raises BadInputError, MissingPartError.
    """
    if asked == "auto":
        return fastest_runtime(load_profile(HOST), installed())
    if asked not in RUNTIMES:
        expected = f"auto or one of {', '.join(RUNTIMES)}"
        raise BadInputError("runtime", repr(asked), expected, did_you_mean(asked, ["auto", *RUNTIMES]))
    return resolve(asked), "as asked"


def requested_cuts(texts: Sequence[str], networks: Sequence[NetworkFile]) -> tuple[NetworkCut, ...]:
    """Return the cuts that the texts `TENSOR=UNIT` request. Raises BadInputError, also for cuts of several networks."""
    if texts and len(networks) > 1:
        raise BadInputError("--split", f"{len(networks)} networks in the scene", "a scene of one network")
    cuts = []
    for text in texts:
        at, _, unit = text.rpartition("=")
        try:
            cuts.append(NetworkCut.model_validate({"at": at, "unit": unit}))
        except ValidationError:
            raise BadInputError("--split", repr(text), "TENSOR=UNIT, with UNIT one of cpu, gpu, dsp") from None
    split(networks[0], [cut.at for cut in cuts])
    return tuple(cuts)


def _accuracy(avatars: Sequence[tuple[AvatarData, int]], drawn: DrawnAs) -> dict[str, Any]:
    """Return the result of `accuracy_of` for each avatar, by its name.

    If several avatars have the same name, the key also contains the folder.
    """
    bundles = [(avatar.bundle, sharing) for avatar, sharing in avatars]
    names = Counter(bundle.manifest.name for bundle, _ in bundles)
    return {
        bundle.manifest.name if names[bundle.manifest.name] == 1 else f"{bundle.manifest.name} in {bundle.folder}": (
            accuracy_of(bundle, replace(drawn, avatars=sharing))
        )
        for bundle, sharing in bundles
    }


def skinning_unit(asked: str, gl: GlFacts = gl_facts) -> tuple[str, str]:
    """Return (`cpu` or `gpu`, reason): the unit `asked`, or for `auto` the GPU if its driver is hardware.

    Raises BadInputError for another word.
    """
    if asked in ("cpu", "gpu"):
        return asked, "as asked"
    if asked != "auto":
        raise BadInputError("--skinning", repr(asked), "auto, cpu or gpu")
    driver = gl()
    hardware = driver is not None and bool(driver.get("hardware"))
    return ("gpu", "the driver is hardware") if hardware else ("cpu", "the OpenGL driver is software")


def required_machine(gl: GlFacts = gl_facts) -> dict[str, Any]:
    """Return `machine_facts` of this machine. `gl`: function that returns facts about the OpenGL driver.

    Raises MissingPartError if no OpenGL context can be made, TrilaneError if memory is short.
    """
    driver = gl()
    if driver is None and (short := shortage()):
        raise TrilaneError(f"no OpenGL context could be made; memory is short: {short}")
    if driver is None:
        raise MissingPartError("no OpenGL 3.3 context through EGL", EGL_LINE)
    return machine_facts(driver)
