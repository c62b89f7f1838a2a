"""A pipeline that is described wrongly is a BadInputError: the field, what was found and what was expected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from trilane.errors import BadInputError
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings


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
    "too few edges": (lambda: chain(3, CPU, edges=()), "Pipeline: found 0 edges and latency"),
    "nested": (
        lambda: Pipeline.model_validate({"stages": [{"name": "a"}], "edges": [], "units": {}}),
        "PipelineStage.unit: found nothing",
    ),
    "too many edges": (lambda: chain(202, CPU), "Pipeline: found unit cpu at 201 edges, expected at most 200"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name: str) -> None:
    make, sentence = WRONG[name]
    with pytest.raises(BadInputError, match=sentence):
        make()


def test_as_many_edges_as_a_unit_may_have() -> None:
    assert len(chain(201, CPU).edges) == 200
