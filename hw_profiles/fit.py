"""Fits a profile's efficiencies to measured rows.

There are fewer free numbers than measurements. Each free number has a physical meaning and a prior: the value and the
`spread` that the profile states before the fit. The fit minimises the sum of the squares of
log(predicted / measured) / noise and of log(number / prior) / spread. This gives the most probable numbers if both
logarithms are normally distributed. Each of `STEPS` starts from the numbers of the earlier steps. The steps of the
network come first, unit by unit, then the step of the application.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError, MissingPartError
from trilane.hw_profiles.application import Plan, isolated_job_time, reference_frame_ms
from trilane.hw_profiles.profile_files import load_tables, parse_profile
from trilane.hw_profiles.reference_networks import ConfigurationRow, read_table, reference_network
from trilane.hw_profiles.schema import Profile, corners_of
from trilane.units import SUSTAINED, UnitName

MEASURED_UNDER = SUSTAINED
NORMAL_OVER_MEDIAN = 1.4826  # standard deviation of a normal distribution, divided by its median absolute deviation

#: A group of keys of a profile that are multiplied by the same factor.
Keys = tuple[str, ...]


class TableCell(NamedTuple):
    """One measured cell of a table of configurations: its row, its column, and its value in milliseconds."""

    row: ConfigurationRow
    column: str
    ms: float


@dataclass(frozen=True)
class Residual:
    """One measurement with its predictions.

    `fitted_ms`: prediction by the fit to all measurements of the step.
    `left_out_ms`: prediction by a fit to all other measurements of the step.
    """

    step: str
    row: ConfigurationRow
    column: str
    measured_ms: float
    fitted_ms: float
    left_out_ms: float

    @property
    def error(self) -> float:
        """Relative error of the fit."""
        return self.fitted_ms / self.measured_ms - 1

    @property
    def left_out_error(self) -> float:
        """Relative error of the prediction that the fit to all other measurements gives."""
        return self.left_out_ms / self.measured_ms - 1


@dataclass(frozen=True)
class ProfileFit:
    """The result of a fit.

    `data`: tables of the fitted profile.
    `numbers`: value and relative spread of each fitted key.
    `residuals`: measurements with their predictions.
    `free_count`: number of free numbers.
    """

    data: Mapping[str, Any]
    numbers: Mapping[str, tuple[float, float]]
    residuals: tuple[Residual, ...]
    free_count: int

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the table that have measurements, in the order of the fit."""
        return tuple(dict.fromkeys(r.column for r in self.residuals))

    def median_error(self, column: str, *, left_out: bool = False) -> float:
        """Return the median absolute relative error of `column`; 0 without measurements.

        `left_out`: whether each error comes from a fit without its measurement.
        """
        errors = [abs(r.left_out_error if left_out else r.error) for r in self.residuals if r.column == column]
        return median(errors) if errors else 0.0


def measurements(rows: Sequence[ConfigurationRow], step: Step) -> list[TableCell]:
    """Return the measurements of `step` in `rows`; the frame time of an application is the middle of its range."""
    result = []
    for row in rows:
        for column in step.columns:
            if column.startswith("bench"):
                value = row.number(column)
            else:
                ends = row.range(column)
                value = sum(ends) / 2 if ends else None
            if value is not None:
                result.append(TableCell(row, column, value))
    return result


def predicted_ms(profile: Profile, measured: TableCell) -> float:
    """Return the time in ms that `profile` predicts for a measurement, under the performance profile MEASURED_UNDER."""
    corners, unit = corners_of(profile, MEASURED_UNDER), UNIT_OF_COLUMN[measured.column]
    network = reference_network(measured.row.spec)
    if measured.column.startswith("bench"):
        return isolated_job_time(profile, network, unit, corners).total_ms
    return reference_frame_ms(profile, Plan(network, unit), corners)


def fit_profile(name: str | Path, table: Path) -> ProfileFit:
    """Fit the profile `name` to the measured rows in the file `table`. Raises BadInputError, MissingPartError."""
    data, path = load_tables(name)
    parse_profile(data, path)
    return fit(data, path, read_table(table))


def fit(data: Mapping[str, Any], path: Path, rows: Sequence[ConfigurationRow]) -> ProfileFit:
    """Fit a profile to measured rows.

    `data`: tables of the profile.
    `path`: file of these tables, for messages.
    `rows`: measured rows.

    Raises BadInputError if there are no more measurements than free numbers, MissingPartError without SciPy.
    """
    fitted: Mapping[str, Any] = data
    numbers: dict[str, tuple[float, float]] = {}
    residuals: list[Residual] = []
    for step in STEPS:
        measured = measurements(rows, step)
        if len(measured) <= len(step.free):
            expected = f"more than the {len(step.free)} free numbers of the {step.name}"
            raise BadInputError(path, f"{len(measured)} measurements", expected)
        start = fitted
        values, spreads = _solve(start, path, step, measured)
        fitted = with_factors(start, step.free, values)
        profile = parse_profile(fitted, path)
        for index, measurement in enumerate(measured):
            others = measured[:index] + measured[index + 1 :]
            without = parse_profile(with_factors(start, step.free, _solve(start, path, step, others)[0]), path)
            row, column, ms = measurement
            fitted_ms, left_out_ms = predicted_ms(profile, measurement), predicted_ms(without, measurement)
            residuals.append(Residual(step.name, row, column, ms, fitted_ms, left_out_ms))
        for keys, spread in zip(step.free, spreads, strict=True):
            numbers |= {key: (_at(fitted, key)["value"], float(spread)) for key in keys}
    numbers |= _from_residuals(residuals, rows)
    return ProfileFit(fitted, numbers, tuple(residuals), sum(len(step.free) for step in STEPS))


def _from_residuals(residuals: Sequence[Residual], rows: Sequence[ConfigurationRow]) -> dict[str, tuple[float, float]]:
    """Return (value, spread) of two keys, by key: the model's own error, and the range of frame times.

    The model's error comes from predictions of left-out measurements, the range from the measured ranges.
    """
    numbers = {}
    for unit in ("dsp", "gpu"):
        errors = [abs(r.left_out_error) for r in residuals if r.column == f"bench_{unit}_ms"]
        numbers[f"units.{unit}.model_error_fraction"] = (NORMAL_OVER_MEDIAN * median(errors), 0.5)
    measured_ranges = [row.range(column) for row in rows for column in ("app_dsp_ms", "app_gpu_ms")]
    ranges = [(ends[1] - ends[0]) / sum(ends) for ends in measured_ranges if ends]
    numbers["application.ema20_half_range_fraction"] = (median(ranges), 1.0)
    return numbers


def _solve(data: Mapping[str, Any], path: Path, step: Step, measured: Sequence[TableCell]) -> tuple[F64, F64]:
    """Fit to `measured`. Return (factor on each group of keys `step.free` in `data`, spread of each factor)."""
    try:
        from scipy.optimize import least_squares
    except ImportError:
        raise MissingPartError("fitting needs SciPy", extra="fit") from None
    priors = np.array([_at(data, keys[0]).get("spread", 0.5) for keys in step.free])

    def residuals(x: F64) -> F64:
        profile = parse_profile(with_factors(data, step.free, np.exp(x * priors)), path)
        errors = [np.log(predicted_ms(profile, each) / each.ms) / step.noise for each in measured]
        return np.concatenate([errors, x])

    solution = least_squares(residuals, np.zeros(len(priors)))
    covariance = np.linalg.inv(solution.jac.T @ solution.jac)
    return np.exp(solution.x * priors), priors * np.sqrt(np.diag(covariance))


def with_factors(data: Mapping[str, Any], free: Sequence[Keys], factors: Sequence[float] | F64) -> dict[str, Any]:
    """Return a copy of the tables `data`, with the values of each group of keys in `free` multiplied by its factor."""
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
    quantity: dict[str, Any] = table
    return quantity


def as_toml(
    numbers: Mapping[str, tuple[float, float]], head: Mapping[str, str], command: str, measurements: str
) -> str:
    """Return the text of a TOML file with fitted numbers.

    `numbers`: value and spread of each key.
    `head`: keys `extends`, `name` and `title` of the new profile; the profile that it extends has all other numbers.
    `command`: command that made the file; it becomes the source of every number.
    `measurements`: description of the measurements, for the first line.
    """
    lines = [
        f"# Written by `{command}`: {measurements}.",
        "# `spread` is what the fit leaves open, as the standard deviation of the logarithm.",
        *(f"{key} = {json.dumps(value)}" for key, value in head.items()),
    ]
    section, source = "", command.removeprefix("trilane ")
    for key in sorted(numbers, key=lambda k: k.rsplit(".", 1)):
        table, last = key.rsplit(".", 1)
        if table != section:
            lines += ["", f"[{table}]"]
            section = table
        value, spread = numbers[key]
        stated = f'value = {value:.4g}, kind = "fitted", spread = {spread:.2g}, source = {json.dumps(source)}'
        lines.append(f"{last} = {{ {stated} }}")
    return "\n".join(lines) + "\n"


class Step(NamedTuple):
    """One step of the fit.

    `columns`: measured columns that it fits.
    `free`: groups of keys; one factor multiplies all keys of a group.
    `noise`: relative error of a measurement.
    """

    name: str
    columns: tuple[str, ...]
    free: tuple[Keys, ...]
    noise: float


def _efficiency(unit: str, *names: str) -> Keys:
    return tuple(f"units.{unit}.efficiency.{name}" for name in names)


def _engine(name: str) -> Keys:
    return (f"units.dsp.engines.int8_tflite.{name}",)


STEPS = (
    Step(
        "network on the DSP",
        ("bench_dsp_ms",),
        (
            _engine("rates.arithmetic_tmac_s"),
            _engine("rates.spill_gb_s"),
            _engine("factors.normalisation"),
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
#: The unit that runs the network, by the measured column.
UNIT_OF_COLUMN: dict[str, UnitName] = {
    "bench_dsp_ms": "dsp",
    "bench_gpu_ms": "gpu",
    "app_dsp_ms": "dsp",
    "app_gpu_ms": "gpu",
}
