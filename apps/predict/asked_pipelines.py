"""The pipelines that share a chip in `trilane predict --beside`: scenes, networks and pipeline files.

Rule: the code of a run's pose stage plans each frame of a scene, as in `trilane plan`. A pipeline file is read as in
`trilane predict FILE.toml`, and no Python of the file is imported.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from trilane.apps.check.port_types import port_types, read_networks
from trilane.apps.explain.scene_plan import ScenePlan
from trilane.apps.predict.predict_options import PredictOptions
from trilane.apps.predict.predicted_verdict import pipeline_verdict
from trilane.arrays import Shape
from trilane.errors import BadInputError
from trilane.hw_profiles.application import LEAST_FPS, MOST_FPS, NETWORK_UNITS, Variant
from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.network_time import Computes
from trilane.hw_profiles.network_work import Network
from trilane.hw_profiles.schema import Profile
from trilane.hw_profiles.shared_chip import MOST_TENANTS, predict_beside
from trilane.hw_profiles.tenants import NEWEST, SKIPS, FileTenant, SharingPipeline, Tenant
from trilane.pipeline.pipeline_file import checked_tables, is_pipeline_file, read_pipeline
from trilane.scene.planner import FrameWork
from trilane.scene.schema import ENDING
from trilane.stages.avatar_assets import networks_of, painting
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions
from trilane.units import INFER, UnitName

NETWORK_ENDING = ".onnx"
#: Largest number of a scene's frames that are planned. A longer prediction repeats these frames.
MOST_FRAMES = 600
FORM = "SCENE, SCENE@RATE or NETWORK.onnx@RATE, with :gpu or :dsp behind the rate, or FILE.toml or FILE.toml@RATE"


class AskedPipeline(NamedTuple):
    """A pipeline as typed on the command line.

    `text`: the whole text, such as `face.onnx@30:gpu`. `what`: scene, network file or pipeline file, without the rate.
    `fps`: frames a second; None for the pipeline's own rate. `unit`: unit of the network; None if not given.
    """

    text: str
    what: str
    fps: float | None
    unit: UnitName | None

    @property
    def is_file(self) -> bool:
        """Return whether `what` is a pipeline file."""
        return is_pipeline_file(Path(self.what))


def asked(text: str) -> AskedPipeline:
    """Return the pipeline that `text` describes: SCENE, SCENE@RATE, or another of the forms in FORM.

    An @ in the name of a file is allowed. Raises BadInputError for a text of another form.
    """
    what, at, rate = text.rpartition("@")
    if not at or text.endswith((ENDING, NETWORK_ENDING)):
        what, rate = text, ""
        if text.endswith(NETWORK_ENDING):
            remedy = f"such as {text}@30; by itself: --network {text}"
            raise BadInputError(_where(text), "a network without a rate", FORM, remedy)
    if not what:
        raise BadInputError(_where(text), "no scene and no file", FORM)
    number, colon, unit = rate.partition(":")
    chosen = _unit(text, unit) if colon else None
    found = AskedPipeline(text, what, _rate(text, number) if at and what != text else None, chosen)
    if chosen is not None and found.is_file:
        remedy = f"leave out :{unit}; `unit` of each stage says where it runs"
        raise BadInputError(_where(text), f"the unit {chosen} for a pipeline file", "its rate alone", remedy)
    return found


def _where(text: str) -> str:
    return f"pipeline {text!r}"


def _rate(text: str, number: str) -> float:
    if not re.fullmatch(r"\d+(\.\d+)?", number) or not LEAST_FPS <= float(number) <= MOST_FPS:
        expected = f"frames a second, {LEAST_FPS:g} to {MOST_FPS:g}"
        raise BadInputError(_where(text), f"rate {number!r}", expected, "such as @30")
    return float(number)


def _unit(text: str, asked_for: str) -> UnitName:
    for unit in NETWORK_UNITS:
        if unit == asked_for:
            return unit
    raise BadInputError(
        _where(text), f"unit {asked_for!r}", " or ".join(NETWORK_UNITS), "without the colon it is the dsp"
    )


def tenants(texts: Sequence[str], variant: Variant = NEWEST, precision: str | None = None) -> list[SharingPipeline]:
    """Return the pipeline that each of `texts` describes, in order.

    `variant`: policy, edge and batch of scenes. `precision`: int8, fp16 or fp32 for all networks; None for the
    precision in each network's file. Stages of a pipeline file that have a `precision` keep their own.

    Raises BadInputError for too many pipelines, and for a scene, network or file that cannot be used.
    """
    if len(texts) > MOST_TENANTS:
        raise BadInputError("--beside", f"{len(texts)} pipelines", f"at most {MOST_TENANTS} with the first one")
    read = [asked(text) for text in texts]
    names = _names([Path(each.what).stem for each in read])
    return [_tenant(each, name, variant, precision) for each, name in zip(read, names, strict=True)]


def answer_of(chip: Profile, pipelines: Sequence[SharingPipeline], options: PredictOptions) -> dict[str, Any]:
    """Return the document of a prediction for `pipelines` that share `chip`, with a verdict on each pipeline.

    `options`: options of the prediction. Raises BadInputError if the prediction cannot be made.
    """
    answer = predict_beside(chip, pipelines, options.cap, options.minutes, options.governor, options.turns)
    is_cold = not options.minutes
    rows = [row | {"verdict": pipeline_verdict(row, is_cold=is_cold).shown()} for row in answer["pipelines"]]
    return answer | {"pipelines": rows}


def _tenant(each: AskedPipeline, name: str, variant: Variant, precision: str | None) -> SharingPipeline:
    if each.what.endswith(NETWORK_ENDING):
        return _bare(each, name, precision)
    return _of_file(each, name, precision) if each.is_file else avatar(each, name, variant, precision)


def _names(stems: Sequence[str]) -> list[str]:
    """Return a name for each pipeline, in order. Equal stems get numbers; no two names are equal.

    `stems`: file names of the pipelines without the suffix.
    """
    names: list[str] = []
    for stem in stems:
        numbered = (f"{stem} ({number})" for number in count(1))
        is_own = stems.count(stem) == 1
        names.append(stem if is_own else next(name for name in numbered if name not in (*stems, *names)))
    return names


def _bare(each: AskedPipeline, name: str, precision: str | None) -> Tenant:
    path = Path(each.what)
    graph = read_graph(path)
    network = Network({"network": str(path)}, 1, 1, 1, "packed", graph.work)
    computes = Computes(graph.numbers, precision)
    unit = each.unit or INFER[1]
    return Tenant(name, each.text, (network,), (0,), each.fps or 0.0, unit, is_bare=True, computes=computes)


def _of_file(each: AskedPipeline, name: str, precision: str | None) -> FileTenant:
    file = read_pipeline(Path(each.what))
    if each.fps is not None:
        run = {key: value for key, value in file.tables.get("run", {}).items() if key != "arrivals"}
        file = checked_tables({**file.tables, "run": {**run, "fps": each.fps}}, file.path)
    graphs = read_networks(file)
    port_types(file, graphs)
    return FileTenant(name, each.text, file, graphs, precision)


def avatar(each: AskedPipeline, name: str, variant: Variant = NEWEST, precision: str | None = None) -> Tenant:
    """Return the pipeline of the scene that `each` describes, after planning its frames.

    `name`: unique name of the pipeline. `variant`, `precision`: as in `tenants`.

    Raises BadInputError if the scene cannot be read or run.
    """
    checked = configure(RunOptions(scene=each.what, skinning="gpu"), Path.cwd())
    scene, files = checked.config.scene, networks_of(checked.assets)
    plan = ScenePlan(checked.config, checked.assets)
    plans = [plan.decide(frame).plan for frame in range(min(scene.frames, MOST_FRAMES))]
    seen = [
        (one.shape, checked.config.networks_of(one.seen), len(one.seen), one.meshes)
        if one.shape and one.work is FrameWork.FULL
        else None
        for one in plans
    ]
    distinct = list(dict.fromkeys(one for one in seen if one is not None)) or [(_own(files[0].shape), (0,), 1, 1.0)]
    by_kind = {
        (shape, used): painting([files[number] for number in used], shape, {"scene": each.what})
        for shape, used, *_ in distinct
    }
    networks = tuple(by_kind[shape, used] for shape, used, *_ in distinct)
    avatars, meshes = tuple(one[2] for one in distinct), tuple(one[3] for one in distinct)
    frames = tuple(SKIPS if one is None else distinct.index(one) for one in seen)
    fps, unit, computes = each.fps or scene.fps, each.unit or INFER[1], Computes(precision=precision)
    return Tenant(
        name, each.text, networks, frames, fps, unit, variant, avatars=avatars, meshes=meshes, computes=computes
    )


def _own(shape: Sequence[int]) -> Shape:
    return shape[1], shape[2]
