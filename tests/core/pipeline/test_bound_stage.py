"""A stage in its slots: what it is told, what it may skip, and how a bypass joins two edges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from support.small_pipeline import EDGES, OWN, STAGES, packets, pipeline
from trilane.errors import BadInputError, TrilaneError
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.stage import Skip, UnitContext
from trilane.pipeline.unit_loop import BoundStage
from trilane.transport.packets import header_dtype

UNIT = UnitSettings(cores=(0,), threads=1)


class Skipping:
    """Notes what it is asked; every frame skips."""

    def __init__(self) -> None:
        self.forgot = 0

    def bind(self, inputs: Any, outputs: Any) -> None:
        self.bound = inputs, outputs

    def run(self, frame: int, *_slots: int | None) -> Mapping[str, float]:
        return Skip(frame=frame)

    def forget(self) -> None:
        self.forgot += 1

    def close(self) -> None:
        pass


def test_a_stage_is_told_to_forget_and_may_skip_only_where_a_bypass_begins() -> None:
    unit = UnitContext("left", UNIT, {})
    stage = Skipping()
    bound = BoundStage("a", stage, [], packets(OWN, 1), 0, unit, may_skip=True)
    assert (bound.run(3, -1, 0, 0), stage.forgot) == (Skip(frame=3), 0)
    bound.run(4, -1, 0, 0, fresh=True)
    assert stage.forgot == 1
    other = BoundStage("b", stage, [], packets(OWN, 1), 0, unit)
    with pytest.raises(TrilaneError, match="stage b returned a Skip, and the pipeline's bypass does not begin at it"):
        other.run(3, -1, 0, 0, fresh=True)
    assert stage.forgot == 1


def test_a_header_is_passed_on_from_either_edge_at_the_end_of_a_bypass() -> None:
    inputs, outputs = packets(OWN, 3), packets(OWN, 1)
    bound = BoundStage("c", Skipping(), inputs, outputs, 0, UnitContext("right", UNIT, {}), may_skip=True)
    inputs[2].header["frame"] = 77
    bound.run(77, 2, 0, 5)
    assert (int(outputs[0].header["frame"]), int(outputs[0].header["epoch"])) == (77, 5)


def test_a_bypass_joins_edges_of_one_header() -> None:
    names = (STAGES[0].name, STAGES[2].name)
    alike = tuple(edge.model_copy(update={"header": OWN}) for edge in EDGES)
    made = pipeline(edges=alike, bypass=names)
    assert made.edges_into(names[1]) == ("mid->out", "in->mid")
    assert made.edges_into("mid") == ("in->mid",) and made.edges_into("in") == ()
    assert made.graph().bypass == names
    unlike = (alike[0], alike[1].model_copy(update={"header": header_dtype()}))
    with pytest.raises(BadInputError, match="different headers of edges mid->out, in->mid"):
        pipeline(edges=unlike, bypass=names)
    with pytest.raises(BadInputError, match="bypass"):
        pipeline(edges=alike, bypass=("in", "mid"))
