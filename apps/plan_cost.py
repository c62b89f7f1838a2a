"""What a tensor of a shape costs: pixels, products, and milliseconds by a hardware profile. Rule: computed, never
measured, by the same model as `trilane predict`; joints and vertices count for each avatar in view.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from trilane.avatars.network_file import NetworkFile, reshaped
from trilane.errors import BadInputError
from trilane.hw_profiles.application import Plan, Variant, stage_times_ms, steady, workers_of
from trilane.hw_profiles.host import host_cores, usable_cores
from trilane.hw_profiles.load import HOST, load_runnable
from trilane.hw_profiles.network_work import Network, count_work
from trilane.hw_profiles.performance_profiles import corners_of
from trilane.hw_profiles.placed_host import place_units
from trilane.hw_profiles.placement_facts import NS_PER_MS, described
from trilane.hw_profiles.schema import Profile
from trilane.scheduler.placement import Ranked
from trilane.shapes import Shape
from trilane.units import UNITS, UnitName

PIPELINED = Variant("pipelined", "double")
#: Stages that a frame needs even with nobody in view.
ALWAYS = ("pose", "composite", "present")


@dataclass(frozen=True)
class FrameCost:
    """Of one frame. `pixels`: of its tensor. `gmac`: of the network. `work_ms`: of all stages, one after the other.

    `frame_ms`: between frames of its kind when they are pipelined.
    """

    pixels: int
    gmac: float
    work_ms: float
    frame_ms: float

    def as_json(self) -> dict[str, Any]:
        return {"pixels": self.pixels, "gmac": self.gmac, "work_ms": self.work_ms, "frame_ms": self.frame_ms}


def least_frame_ms(chip: Profile, times: Mapping[tuple[str, UnitName], float]) -> float:
    """Time between frames whose jobs take `times`, by stage and unit: the busiest core's, or that of the display."""
    worker = workers_of(chip)
    busy = (sum(ms for (_, unit), ms in times.items() if worker[unit] == one) for one in set(worker.values()))
    return max(*busy, chip.application.display_ms.or_else(0))


class CostModel:
    """Costs of frames on the chip `profile`. Raises BadInputError for an unknown profile."""

    def __init__(self, network: NetworkFile, profile: str, performance_profile: str) -> None:
        self._network, self._chip = network, load_runnable(profile)
        self._corners = corners_of(self._chip, performance_profile)
        self.of = cache(self._of)

    def _of(self, shape: Shape | None, avatars: int = 1) -> FrameCost:
        """The cost of a frame whose tensor has `shape`, None for one that needs none, with so many `avatars` in view.

        With nobody in view somebody is looked for, which counts as one avatar's pose.
        """
        plan = self._plan(shape, avatars)
        times = stage_times_ms(self._chip, plan, self._corners)
        if shape is None:
            kept = {key: ms for key, ms in times.items() if key[0] in ALWAYS}
            return FrameCost(0, 0.0, sum(kept.values()), least_frame_ms(self._chip, kept))
        steady_ms = steady(self._chip, plan, self._corners, quick=True).frame_ms
        return FrameCost(shape[0] * shape[1], plan.network.work.macs / 1e9, sum(times.values()), steady_ms)

    def placement(
        self, shape: Shape | None, avatars: int = 1, asked: Mapping[str, tuple[int, ...]] | None = None
    ) -> dict[str, Any]:
        """Where the units are best placed for frames of `shape` with so many `avatars` in view, and why.

        By the model, as `trilane predict` has it. `asked`: cores of units of this machine. Raises BadInputError when a
        chip's are asked for.
        """
        asked = asked or {}
        if self._chip.name != HOST:
            if asked:
                raise BadInputError("--cores", f"cores of {self._chip.name}", f"--profile {HOST}, which has cores")
            return {
                "units": None,
                "predicted_ms": None,
                "why": f"each unit of {self._chip.name} is hardware of its own",
            }
        plan = self._plan(shape, avatars)
        cores = sorted({*usable_cores(), *(core for own in asked.values() for core in own)})
        placed = place_units(self._chip, plan, self._corners, host_cores(cores), asked)
        chosen = {key: placed.facts[key] for key in ("units", "predicted_ms")}
        return {**chosen, "why": f"{described(placed.best.placement)}: {_why(asked, placed.rule)}"}

    def _plan(self, shape: Shape | None, avatars: int) -> Plan:
        described = self._described(shape or self._network.shape[1:3])
        return Plan(described, "dsp", PIPELINED, avatars=max(1, avatars))

    def _described(self, shape: Shape) -> Network:
        work = count_work(reshaped(self._network, *shape).model)
        return Network({}, *shape, self._network.channels, "packed", work)


def _why(asked: Mapping[str, tuple[int, ...]], rule: Ranked) -> str:
    if len(asked) == len(UNITS):
        return "as asked"
    how = "as asked, the others for the least predicted frame time" if asked else "the least predicted frame time"
    by_rule = f"{described(rule.placement)}, {rule.frame_ns / NS_PER_MS:.1f} ms"
    return f"{how}; by the rule for any run, {by_rule}. A run measures and decides anew"
