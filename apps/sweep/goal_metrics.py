"""The figures that a search can improve or limit.

Rule: this module imports nothing of Trilane, so that `trilane tune --help` is quick.
"""

from __future__ import annotations

from typing import NamedTuple


class GoalMetric(NamedTuple):
    """A figure of a result that can be a goal or have a limit.

    `unit`: unit of the figure. `more_is_better`: whether larger values are better. `path`: keys that lead to the figure
    in the `--json` document; empty for the PSNR, which `entry_of` finds.
    """

    unit: str
    more_is_better: bool
    path: tuple[str, ...]


METRICS = {
    "fps": GoalMetric("fps", True, ("fps",)),
    "frame": GoalMetric("ms", False, ("frame_time_ms", "mean")),
    "p95": GoalMetric("ms", False, ("frame_time_ms", "p95")),
    "p99": GoalMetric("ms", False, ("frame_time_ms", "p99")),
    "latency": GoalMetric("ms", False, ("latency_ms", "mean")),
    "power": GoalMetric("W", False, ("power_w",)),
    "energy": GoalMetric("mJ", False, ("energy_mj_per_frame",)),
    "psnr": GoalMetric("dB", True, ()),
    "worst-psnr": GoalMetric("dB", True, ("check", "worst_psnr_db")),
}
