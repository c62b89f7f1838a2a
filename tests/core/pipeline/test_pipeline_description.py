"""A pipeline that is described wrongly is a BadInputError: the field, what was found and what was expected."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from support.small_pipeline import EDGES, STAGES, pipeline
from trilane.errors import BadInputError
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.transport.packets import header_dtype


def stage(**values: Any) -> PipelineStage:
    return PipelineStage(**{"name": "a", "unit": "cpu", "factory": "module:build", **values})


def chain(stages: int, units: dict[str, UnitSettings], **values: Any) -> Pipeline:
    parts = {
        "stages": tuple(stage(name=f"s{number}") for number in range(stages)),
        "edges": (PipelineEdge(payload_bytes=8),) * (stages - 1),
        "units": units,
    }
    return Pipeline(**{**parts, **values})


CPU = {"cpu": UnitSettings(cores=(0,), threads=1)}
WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "factory": (lambda: stage(factory="module"), "PipelineStage.factory: found 'module', expected"),
    "pace": (lambda: stage(pace_ns=-1), "PipelineStage.pace_ns: found -1, expected"),
    "bytes": (lambda: PipelineEdge(payload_bytes=-1), "PipelineEdge.payload_bytes: found -1, expected"),
    "no threads": (lambda: UnitSettings(cores=(0,), threads=0), "UnitSettings.threads: found 0, expected"),
    "name": (lambda: stage(name="a b"), "PipelineStage.name: found 'a b', expected"),
    "long unit": (lambda: stage(unit="u" * 41), "PipelineStage.unit: found 'uuu.*, expected .*at most 40"),
    "unknown": (lambda: stage(speed=1), "PipelineStage.speed: found an unknown field, expected none"),
    "missing": (lambda: PipelineEdge(), "PipelineEdge.payload_bytes: found nothing, expected a value"),  # type: ignore[call-arg]
    "no cores": (lambda: UnitSettings(cores=(), threads=1), r"UnitSettings.cores: found \(\), expected"),
    "no settings": (lambda: chain(2, {}), "Pipeline: found no settings of unit cpu, expected them in `units`"),
    "rule": (
        lambda: chain(2, CPU, edges=(PipelineEdge(payload_bytes=8, rule="quad"),)),
        "Pipeline: found edge 'quad', expected single",
    ),
    "rule of a run": (lambda: pipeline().with_rule("no"), "the run's settings: found edge 'no', expected single"),
    "no stages": (
        lambda: chain(0, CPU, edges=()),
        r"Pipeline.stages: found \(\), expected Tuple should have at least 1",
    ),
    "latency": (lambda: chain(1, CPU, latency_to="none"), "Pipeline: found 0 edges and latency to 'none' for stages"),
    "too few edges": (lambda: chain(3, CPU, edges=()), "Pipeline: found 0 edges and latency"),
    "nested": (
        lambda: Pipeline.model_validate({"stages": [{"name": "a"}], "edges": [], "units": {}}),
        "PipelineStage.unit: found nothing",
    ),
    "too many edges": (lambda: chain(202, CPU), "Pipeline: found unit cpu at 201 edges, expected at most 200"),
}


HEADERS = (
    np.dtype([("t_sampled_ns", "<i8"), ("frame", "<u8")]),
    np.dtype([("frame", "<u8"), ("t_sampled_ns", "<i8")]),
    np.dtype([("frame", "<i8"), ("t_sampled_ns", "<i8"), ("epoch", "<u4")]),
    header_dtype([("own", "O")]),
    "5",
    "[('frame'",
    None,
)


@pytest.mark.parametrize("header", HEADERS)
def test_a_header_without_the_fields_of_a_frame_is_refused(header: Any) -> None:
    with pytest.raises(BadInputError, match=re.escape(f"PipelineEdge.header: found header {header!r}, expected")):
        PipelineEdge(payload_bytes=1, header=header)


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name: str) -> None:
    make, sentence = WRONG[name]
    with pytest.raises(BadInputError, match=sentence):
        make()


def test_a_description_answers_what_follows_from_it() -> None:
    described = pipeline()
    assert described.edge_names == ["in->mid", "mid->out"]
    assert described.joints["mid->out"] == (STAGES[1], (STAGES[2],))
    assert (described.rule, described.with_rule("double").rule) == ("single,fifo:3", "double")
    assert described.with_rule("double").edges[1] == EDGES[1].model_copy(update={"rule": "double"})
    assert (described.scheduler_cores, described.run_cores) == ((1, 0), (0, 1, 3))
    assert pipeline(stages=STAGES[:2], edges=EDGES[:1]).scheduler_cores == (1, 0)
    assert described.stages_of("left") == (STAGES[0], STAGES[2])
    graph = described.graph()
    assert [(stage.name, stage.unit) for stage in graph.stages] == [("in", "left"), ("mid", "right"), ("out", "left")]
    assert (graph.edges, graph.latency_to) == (("single", "fifo:3"), "out")
    assert pipeline(latency_to="mid").graph().latency_to == "mid"
    assert (PipelineEdge(payload_bytes=0).rule, PipelineEdge(payload_bytes=0).header) == ("double", header_dtype())
    assert len(chain(201, CPU).edges) == 200  # as many as a unit may have


def test_a_description_goes_through_json() -> None:
    assert Pipeline.model_validate_json(pipeline().model_dump_json()) == pipeline()
