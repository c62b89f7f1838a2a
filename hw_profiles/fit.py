"""Fits a profile's efficiencies to measured rows.

Rule: fewer free numbers than measurements, each with a physical meaning and a prior; the prior of a number is the
value and the `spread` that the profile to be fitted states for it. Minimised is the sum of squares of
log(predicted / measured) / noise and of log(number / prior) / spread: the most probable numbers if both are normal.
The networks are fitted first, each unit alone, then the application on top of them.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError, MissingPartError
from trilane.hw_profiles.application import Plan, network_alone, reference_frame_ms
from trilane.hw_profiles.configuration_table import Row, read_table
from trilane.hw_profiles.load import load_tables, parse_profile
from trilane.hw_profiles.performance_profiles import corners_of
from trilane.hw_profiles.reference_networks import reference_network
from trilane.hw_profiles.schema import Profile
from trilane.units import SUSTAINED, UnitName

MEASURED_UNDER = SUSTAINED
NORMAL_OVER_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median absolute deviation

Keys = tuple[str, ...]


class Step(NamedTuple):
    """One stage of the fit. `free`: groups of keys that move together. `noise`: relative error of a measurement."""

    name: str
    columns: tuple[str, ...]
    free: tuple[Keys, ...]
    noise: float


def _efficiency(unit: str, *names: str) -> Keys:
    return tuple(f"units.{unit}.efficiency.{name}" for name in names)


STEPS = (
    Step(
        "network on the DSP",
        ("bench_dsp_ms",),
        (
            _efficiency("dsp", "convolution", "pointwise"),
            _efficiency(
                "dsp",
                "convolution_traffic",
                "depthwise_traffic",
                "pointwise_traffic",
                "normalisation",
                "resize",
                "elementwise",
            ),
            _efficiency("dsp", "permute"),
            ("units.dsp.input_ns_per_element",),
            ("units.dsp.permute_fixed_ms",),
            ("units.dsp.fallback_ns_per_element",),
        ),
        0.04,
    ),
    Step(
        "network on the GPU",
        ("bench_gpu_ms",),
        (
            _efficiency("gpu", "convolution", "pointwise"),
            _efficiency("gpu", "depthwise_traffic", "pointwise_traffic"),
            _efficiency("gpu", "normalisation"),
            _efficiency("gpu", "permute"),
            ("units.gpu.input_ns_per_element",),
            ("units.gpu.permute_fixed_ms",),
        ),
        0.12,
    ),
    Step(
        "application",
        ("app_dsp_ms", "app_gpu_ms"),
        (
            ("application.readback_ns_per_byte",),
            ("application.handover_ms",),
            ("memory.application_use_fraction",),
        ),
        0.1,
    ),
)
UNIT_OF_COLUMN: dict[str, UnitName] = {
    "bench_dsp_ms": "dsp",
    "bench_gpu_ms": "gpu",
    "app_dsp_ms": "dsp",
    "app_gpu_ms": "gpu",
}


class Measurement(NamedTuple):
    row: Row
    column: str
    ms: float


@dataclass(frozen=True)
class Residual:
    """One measurement beside the fit; `left_out_ms` is predicted by a fit that did not see it."""

    step: str
    row: Row
    column: str
    measured_ms: float
    fitted_ms: float
    left_out_ms: float

    @property
    def error(self) -> float:
        return self.fitted_ms / self.measured_ms - 1

    @property
    def left_out_error(self) -> float:
        return self.left_out_ms / self.measured_ms - 1


@dataclass(frozen=True)
class Fit:
    """`numbers`: value and relative spread by key. `data`: the tables of the fitted profile."""

    data: Mapping[str, Any]
    numbers: Mapping[str, tuple[float, float]]
    residuals: tuple[Residual, ...]
    free_count: int

    @property
    def columns(self) -> tuple[str, ...]:
        """The measured columns, in the order of the fit."""
        return tuple(dict.fromkeys(r.column for r in self.residuals))

    def median_error(self, column: str, *, left_out: bool = False) -> float:
        errors = [abs(r.left_out_error if left_out else r.error) for r in self.residuals if r.column == column]
        return median(errors) if errors else 0.0


def measurements(rows: Sequence[Row], step: Step) -> list[Measurement]:
    """What `rows` measured of `step`. An application's figure is the middle of its range."""
    found = []
    for row in rows:
        for column in step.columns:
            if column.startswith("bench"):
                value = row.number(column)
            else:
                ends = row.range(column)
                value = sum(ends) / 2 if ends else None
            if value is not None:
                found.append(Measurement(row, column, value))
    return found


def predicted_ms(profile: Profile, measured: Measurement) -> float:
    """What `profile` says for `measured`, under the performance profile of the measurements."""
    corners, unit = corners_of(profile, MEASURED_UNDER), UNIT_OF_COLUMN[measured.column]
    network = reference_network(measured.row.spec)
    if measured.column.startswith("bench"):
        return network_alone(profile, network, unit, corners).total_ms
    return reference_frame_ms(profile, Plan(network, unit), corners)


def fit_profile(name: str | Path, table: Path) -> Fit:
    """Fit the profile `name` to the measured rows of `table`. Raises BadInputError, MissingPartError."""
    data, path = load_tables(name)
    parse_profile(data, path)
    return fit(data, path, read_table(table))


def fit(data: Mapping[str, Any], path: Path, rows: Sequence[Row]) -> Fit:
    """Fit the profile of the tables `data` (of `path`) to `rows`.

    Raises BadInputError when there are no more measurements than free numbers, MissingPartError without SciPy.
    """
    fitted: Mapping[str, Any] = data
    numbers: dict[str, tuple[float, float]] = {}
    residuals: list[Residual] = []
    for step in STEPS:
        found = measurements(rows, step)
        if len(found) <= len(step.free):
            expected = f"more than the {len(step.free)} free numbers of the {step.name}"
            raise BadInputError(path, f"{len(found)} measurements", expected)
        start = fitted
        values, spreads = _solve(start, path, step, found)
        fitted = with_factors(start, step.free, values)
        profile = parse_profile(fitted, path)
        for index, one in enumerate(found):
            others = found[:index] + found[index + 1 :]
            without = parse_profile(with_factors(start, step.free, _solve(start, path, step, others)[0]), path)
            residuals.append(
                Residual(step.name, one.row, one.column, one.ms, predicted_ms(profile, one), predicted_ms(without, one))
            )
        for keys, spread in zip(step.free, spreads, strict=True):
            numbers |= {key: (_at(fitted, key)["value"], float(spread)) for key in keys}
    numbers |= _from_residuals(residuals, rows)
    return Fit(fitted, numbers, tuple(residuals), sum(len(step.free) for step in STEPS))


def _from_residuals(residuals: Sequence[Residual], rows: Sequence[Row]) -> dict[str, tuple[float, float]]:
    """The model's own error from what it says of rows left out, and the spread of frame times from their ranges."""
    numbers = {}
    for unit in ("dsp", "gpu"):
        errors = [abs(r.left_out_error) for r in residuals if r.column == f"bench_{unit}_ms"]
        numbers[f"units.{unit}.model_error_fraction"] = (NORMAL_OVER_MEDIAN * median(errors), 0.5)
    found = [row.range(column) for row in rows for column in ("app_dsp_ms", "app_gpu_ms")]
    ranges = [(ends[1] - ends[0]) / sum(ends) for ends in found if ends]
    numbers["application.ema20_half_range_fraction"] = (median(ranges), 1.0)
    return numbers


def _solve(data: Mapping[str, Any], path: Path, step: Step, found: Sequence[Measurement]) -> tuple[F64, F64]:
    """Factors on the priors of `step.free`, and the spread of each that is left after the fit."""
    priors = np.array([_at(data, keys[0]).get("spread", 0.5) for keys in step.free])

    def residuals(x: F64) -> F64:
        profile = parse_profile(with_factors(data, step.free, np.exp(x * priors)), path)
        errors = [np.log(predicted_ms(profile, one) / one.ms) / step.noise for one in found]
        return np.concatenate([errors, x])

    solution = _least_squares()(residuals, np.zeros(len(priors)))
    covariance = np.linalg.inv(solution.jac.T @ solution.jac)
    return np.exp(solution.x * priors), priors * np.sqrt(np.diag(covariance))


def _least_squares() -> Callable[..., Any]:
    try:
        from scipy.optimize import least_squares
    except ImportError:
        raise MissingPartError("fitting needs SciPy", extra="fit") from None
    solver: Callable[..., Any] = least_squares
    return solver


def with_factors(data: Mapping[str, Any], free: Sequence[Keys], factors: Sequence[float] | F64) -> dict[str, Any]:
    """A copy of the tables `data` with the values of each group of keys multiplied by its factor."""
    copied = copy.deepcopy(dict(data))
    for keys, factor in zip(free, factors, strict=True):
        for key in keys:
            quantity = _at(copied, key)
            quantity["value"] = quantity["value"] * float(factor)
    return copied


def _at(data: Mapping[str, Any], key: str) -> dict[str, Any]:
    table: Any = data
    for part in key.split("."):
        table = table[part]
    found: dict[str, Any] = table
    return found


def as_toml(result: Fit, name: str, title: str, extends: str, command: str) -> str:
    """The fitted profile as a TOML file that lays the fitted numbers over `extends`."""
    lines = [
        f"# Written by `{command}`: {result.free_count} numbers from {len(result.residuals)} measurements.",
        "# `spread` is what the fit leaves open, as the standard deviation of the logarithm.",
        f'extends = "{extends}"',
        f'name = "{name}"',
        f"title = {json.dumps(title)}",
    ]
    section, source = "", command.removeprefix("trilane ")
    for key in sorted(result.numbers, key=lambda k: k.rsplit(".", 1)):
        table, last = key.rsplit(".", 1)
        if table != section:
            lines += ["", f"[{table}]"]
            section = table
        value, spread = result.numbers[key]
        lines.append(
            f'{last} = {{ value = {value:.4g}, kind = "fitted", spread = {spread:.2g}, source = {json.dumps(source)} }}'
        )
    return "\n".join(lines) + "\n"
