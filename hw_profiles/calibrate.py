"""Fits a chip's profile to a few of the user's measurements, and says how well it predicts rows that it did not see.

    rows = read_own_rows(Path("chip.csv"), Path("networks"))
    moved = calibrate("snapdragon-8-gen-2", rows)
    moved.numbers, moved.rows[0].after

A row is one measurement. The profile's numbers are the prior. For another chip, the main unknown is its speed as a
whole. Therefore the prior lets all rates move together by CHIP, and each single rate by less:

    covariance of two log rates = CHIP^2 + RATE^2 [same rate] + ENGINE^2 [same engine] + OWN^2 [same rate and engine]

The fit minimises, over the deviations d of all log rates from the profile's,

    sum over rows of (NU + 1) log(1 + r^2 / NU) + d' covariance^-1 d,    r = log(predicted / measured) / NOISE,

by Gauss and Newton's method, as `fit_engines.py` does with many rows. A unit without a tensor engine has one factor on
all its times. Every row is predicted by a fit to the rows of other networks.

The errors of these predictions show whether the profile's stated error is too large or too small for this chip. The
misses z, in units of the stated error, are assumed to be normal with an unknown variance k^2. The stated error itself,
k = 1, counts as one more row. Therefore k^2 has a scaled inverse chi-square distribution, and the miss of a new row
divided by

    s = ((1 + sum of z^2) / (1 + n))^(1/2)

has Student's t distribution with 1 + n degrees of freedom (Gelman et al., Bayesian Data Analysis, section 2.6). A
unit's `error_scale` is s times the 80 % quantile of t, divided by the same quantile of a normal distribution. With this
scale, 80 % of new rows lie in their 80 % interval again.
"""

from __future__ import annotations

import copy
import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from statistics import fmean, median
from typing import Any, Final, NamedTuple, get_args

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError, did_you_mean
from trilane.files import read_text
from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.network_time import Interval, in_precision, interval, price, spread_of, under_runtime
from trilane.hw_profiles.network_work import Work
from trilane.hw_profiles.operators import NAMES, RATES, TERMS
from trilane.hw_profiles.profile_files import load_tables, parse_profile
from trilane.hw_profiles.reference_networks import header_of, numbered_lines
from trilane.hw_profiles.schema import (
    KEY_OF_RATE,
    MOST_ERROR_SCALE,
    SHARE,
    SIGMAS,
    EngineName,
    EngineRuntime,
    Profile,
    corners_of,
    interval_around,
)
from trilane.hw_profiles.unit_times import amounts, join, numbers_of, time_on
from trilane.pipeline.file_keys import LONGEST_MS
from trilane.scheduler.stats import student_quantile
from trilane.units import BURST, UNITS, UnitName

#: Spreads of the prior, as standard deviations of logarithms: of a chip's speed, of one rate relative to other rates,
#: of one engine relative to other engines, and of one rate of one engine.
CHIP, RATE, ENGINE, OWN = 1.0, 0.2, 0.2, 0.15
NOISE, NU = 0.12, 3.0
#: Number of rows that the profile's stated error counts as.
STATED_ROWS = 1
STEPS, ENOUGH = 50, 1e-6
#: Factors by which a row's time differs from the other rows: from the first on there is a note, and from the second on
#: the time is probably in another unit of time.
FAR_OFF, A_UNIT = 10.0, 100.0
LEAST_ROWS, MOST_ROWS = 2, 1000
RATE_OF_TERM = np.array([RATES.index(TERMS[name]) for name in NAMES])
PRECISIONS: Final = {"int8": "int8", "w8a8": "int8", "fp16": "fp16", "float": "fp16", "fp32": "fp32"}
RUNTIMES: Final[tuple[EngineRuntime, ...]] = get_args(EngineRuntime)
#: Times of a unit without a tensor engine, which grow if the unit is slower.
COSTS: Final = ("job_fixed_ms", "operator_fixed_us", "input_ns_per_element", "permute_fixed_ms")
MOST_EFFICIENCY: Final = 4.0


class OwnRow(NamedTuple):
    """One of the user's measurements.

    `place`: file and line.
    `network`: path of the network as the table states it.
    `work`: work of one frame.
    `ms`: time of a job.
    `silent`: whether the table states no precision although the network's file has floats.
    """

    place: str
    network: str
    work: Work
    ms: float
    unit: UnitName
    precision: str
    runtime: EngineRuntime
    silent: bool = False


class CheckedRow(NamedTuple):
    """A row with two predictions and their 80 % intervals.

    `before_ms`, `before`: by the unchanged profile.
    `after_ms`, `after`: by the profile after a fit to the rows of all other networks.
    """

    row: OwnRow
    before_ms: float
    before: Interval
    after_ms: float
    after: Interval

    @property
    def error_before(self) -> float:
        return self.before_ms / self.row.ms - 1

    @property
    def error_after(self) -> float:
        return self.after_ms / self.row.ms - 1


@dataclass(frozen=True)
class Calibrated:
    """The result of a calibration.

    `data`: tables of the calibrated profile.
    `numbers`: value and relative spread of each changed key.
    `rows`: rows with predictions before and after the fit.
    """

    data: Mapping[str, Any]
    numbers: Mapping[str, tuple[float, float]]
    rows: tuple[CheckedRow, ...]

    @property
    def notes(self) -> list[str]:
        """Sentences about rows whose precision was assumed, and about rows whose time is far from the other rows.

        For each row, the measured time is divided by the time predicted before the fit. A row is far from the others if
        this ratio differs from the median ratio of all rows by more than a factor of FAR_OFF.
        """
        silent = sum(each.row.silent for each in self.rows)
        notes = []
        if silent:
            counted = "1 row without a precision is" if silent == 1 else f"{silent} rows without a precision are"
            notes = [f"{counted} counted as int8, though the network's file is of floats"]
        scales = [math.log(each.row.ms / each.before_ms) for each in self.rows]
        usual = median(scales)
        for each, scale in zip(self.rows, scales, strict=True):
            times = math.exp(abs(scale - usual))
            if times > FAR_OFF:
                unit = "us" if scale > usual else "s"
                guess = f"in {unit}" if times >= A_UNIT else "of this network and unit"
                how = f"{times:.0f} times" if scale > usual else f"1/{times:.0f} of"
                notes.append(f"{each.row.place}: {each.row.ms:g} ms is {how} what the rows suggest; is it {guess}?")
        return notes


def is_own_table(path: Path) -> bool:
    """Return whether the table `path` lists networks in files. A table of reference networks has a column `encoder`.

    Raises BadInputError for a file that is no text, and for a column that comes twice.
    """
    if not path.is_file():
        return False
    lines = numbered_lines(read_text(path, "a table of measured rows"))
    return not lines or "encoder" not in header_of(path, *lines[0])


def read_own_rows(path: Path, folder: Path) -> list[OwnRow]:
    """Return the user's rows: columns network, ms, and maybe unit, precision and runtime; other columns are ignored.

    `folder`: folder that the networks' paths are relative to; no path may lead out of it.

    Raises BadInputError if the table or a network cannot be read, or if the table has a wrong cell.
    """
    numbered = numbered_lines(read_text(path, "a table of measured rows"))
    if not LEAST_ROWS <= len(numbered) - 1 <= MOST_ROWS:
        raise BadInputError(path, f"{max(len(numbered) - 1, 0)} rows", f"{LEAST_ROWS} to {MOST_ROWS}")
    first, line = numbered[0]
    header = header_of(path, first, line)
    if not {"network", "ms"} <= set(header):
        expected = f"network and ms, and maybe {', '.join(column for column, *_ in WORDS)}"
        remedy = "separate cells by commas" if ";" in line or "\t" in line else "name the columns so in the first line"
        raise BadInputError(f"{path}: line {first}", f"the columns {line.strip()!r}", expected, remedy)
    rows = []
    for number, line in numbered[1:]:
        place, cells = f"{path}: line {number}", next(csv.reader([line]), [])
        if len(cells) != len(header):
            raise BadInputError(place, f"{len(cells)} cells", f"{len(header)} as in the header")
        rows.append(_own_row(place, dict(zip(header, (cell.strip() for cell in cells), strict=True)), folder))
    return rows


def _own_row(place: str, cells: Mapping[str, str], folder: Path) -> OwnRow:
    try:
        ms = float(cells["ms"])
    except ValueError:
        ms = math.nan
    if not 0 < ms <= LONGEST_MS:
        raise BadInputError(f"{place}: ms", repr(cells["ms"]), "a time in ms above 0, at most an hour")
    unit, precision, runtime = (_word(place, cells, *each) for each in WORDS)
    graph = read_graph(network_file(f"{place}: network", cells["network"], folder))
    silent = graph.numbers == "float" and not cells.get("precision")
    return OwnRow(place, cells["network"], graph.work, ms, unit, PRECISIONS[precision], runtime, silent)  # type: ignore[arg-type]


#: (column, allowed words, word that is assumed without it) of the columns that may be left out.
WORDS: Final[tuple[tuple[str, Sequence[str], str], ...]] = (
    ("unit", UNITS, "dsp"),
    ("precision", tuple(PRECISIONS), "int8"),
    ("runtime", RUNTIMES, "tflite"),
)


def _word(place: str, cells: Mapping[str, str], column: str, known: Sequence[str], usual: str) -> str:
    word = cells.get(column) or usual
    if word not in known:
        raise BadInputError(f"{place}: {column}", repr(word), f"one of {', '.join(known)}", did_you_mean(word, known))
    return word


def network_file(place: str, name: str, folder: Path, remedy: str = "--networks names another folder") -> Path:
    """Return the path of a network's file. Raises BadInputError for a path outside of `folder`.

    `place`, `remedy`: place and remedy for the error.
    `name`: path relative to `folder`; `.onnx` may be left out.
    """
    inner = PurePosixPath(name)
    if not name or inner.is_absolute() or ".." in inner.parts or "\0" in name or "\\" in name:
        raise BadInputError(place, repr(name), f"a path inside {folder}", remedy)
    return folder / (name if inner.suffix == ".onnx" else f"{name}.onnx")


def on_chip(profile: Profile, row: OwnRow) -> Profile:
    """Return `profile` with the row's unit in the row's precision, and its tensor engine under the row's runtime.

    Raises BadInputError if the unit has tensor engines, but none for this precision and runtime.
    """
    chip = in_precision(profile, row.unit, "not said", row.precision)
    return under_runtime(chip, row.unit, row.runtime) if chip.units[row.unit].engines else chip


def calibrate(name: str | Path, rows: Sequence[OwnRow]) -> Calibrated:
    """Fit the profile `name` to `rows`. Raises BadInputError for a row that the profile cannot predict."""
    data, path = load_tables(name)
    return calibrate_tables(data, path, rows)


def calibrate_tables(data: Mapping[str, Any], path: Path, rows: Sequence[OwnRow]) -> Calibrated:
    """Fit a profile's tables `data` to `rows`. `path`: file of the tables, for messages. Raises BadInputError."""
    profile = parse_profile(data, path)
    for row in rows:
        try:
            on_chip(profile, row)
        except BadInputError as error:
            raise BadInputError(row.place, error.found, error.expected) from None
    left_out = []
    for row in rows:
        others = with_numbers(data, _moved(profile, [each for each in rows if each.network != row.network]))
        left_out.append(CheckedRow(row, *_predicted(profile, row), *_predicted(parse_profile(others, path), row)))
    checked = []
    for each in left_out:
        ends = interval_around(each.after_ms, error_scale(misses(left_out, each)) * spread_of(each.after))
        checked.append(each._replace(after=Interval(*ends, each.after.why)))
    numbers = _moved(profile, rows) | _error_scales(profile, left_out)
    return Calibrated(with_numbers(data, numbers), numbers, tuple(checked))


def misses(left_out: Sequence[CheckedRow], of: CheckedRow | UnitName) -> list[float]:
    """Return the mean miss of each network: log(measured / predicted), in units of the stated error.

    All rows of one network count as one miss, because they share the same error. If the unit has rows of only one
    network, the result is empty, because no row was predicted by a fit to other rows.

    `left_out`: rows with a prediction by a fit to all other networks, and with the interval that the profile states.
    `of`: a unit, for all its networks; or a row, for all other networks of its unit.
    """
    unit, own = (of, "") if isinstance(of, str) else (of.row.unit, of.row.network)
    told: dict[str, list[float]] = {}
    for each in left_out:
        if each.row.unit == unit:
            miss = math.log(each.row.ms / each.after_ms) / spread_of(each.after)
            told.setdefault(each.row.network, []).append(miss)
    return [fmean(each) for network, each in told.items() if network != own] if len(told) > 1 else []


def error_scale(told: Sequence[float]) -> float:
    """Return the factor on the stated error, at most MOST_ERROR_SCALE. `told`: misses in units of the stated error."""
    freedom = STATED_ROWS + len(told)
    scale = math.sqrt((STATED_ROWS + sum(miss**2 for miss in told)) / freedom)
    return min(scale * student_quantile(freedom, SHARE) / SIGMAS, MOST_ERROR_SCALE)


def _error_scales(profile: Profile, left_out: Sequence[CheckedRow]) -> dict[str, tuple[float, float]]:
    """Return (value, spread) of the key `error_scale` of each unit with rows, by key.

    The value is the factor that the rows give, times the `error_scale` that the profile states.
    """
    numbers = {}
    for unit in dict.fromkeys(each.row.unit for each in left_out):
        told, stated = misses(left_out, unit), profile.units[unit].error_scale
        scale = error_scale(told) * (1.0 if stated is None else stated.or_else(1.0))
        spread = math.sqrt(1 / 2 / (STATED_ROWS + len(told)))  # of the logarithm of a deviation, to first order
        numbers[f"units.{unit}.error_scale"] = (min(scale, MOST_ERROR_SCALE), spread)
    return numbers


def _predicted(profile: Profile, row: OwnRow) -> tuple[float, Interval]:
    chip = on_chip(profile, row)
    time = price(chip, row.work, row.unit, corners_of(chip, BURST))
    return time.total_ms, interval(chip, row.work, time)


def _moved(profile: Profile, rows: Sequence[OwnRow]) -> dict[str, tuple[float, float]]:
    """Return (value, spread) of each key that a fit to `rows` changes."""
    numbers: dict[str, tuple[float, float]] = {}
    for unit in UNITS:
        of_unit = [row for row in rows if row.unit == unit]
        on_engine = [row for row in of_unit if on_chip(profile, row).units[unit].engine is not None]
        if on_engine:
            numbers |= _engine_numbers(profile, unit, on_engine)
        elif of_unit:
            numbers |= _unit_numbers(profile, unit, of_unit)
    return numbers


def with_numbers(data: Mapping[str, Any], numbers: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
    """Return a copy of the tables `data` with `numbers`, the value and spread of each fitted key."""
    moved = copy.deepcopy(dict(data))
    for key, (value, spread) in numbers.items():
        table: Any = moved
        *folders, last = key.split(".")
        for part in folders:
            table = table[part]
        stated = table.get(last, {"source": "own rows"})
        table[last] = {**stated, "value": value, "spread": spread, "kind": "fitted"}
    return moved


class _EngineRow:
    """A measured time on a tensor engine, and its prediction as a function of deviations of the engine's log rates."""

    def __init__(self, profile: Profile, row: OwnRow) -> None:
        chip = on_chip(profile, row)
        unit, self.ms = chip.units[row.unit], row.ms
        clock = unit.clock(corners_of(chip, BURST)[UNITS.index(row.unit)])
        assert unit.engine is not None
        self.engine = next(name for name, engine in unit.engines.items() if engine is unit.engine)
        numbers = numbers_of(unit.engine, clock)
        runs = [layer.op_type not in unit.fallback for layer in row.work.layers.layers]
        self._costs = amounts(row.work.layers, numbers.room) * numbers.seconds * np.array([*runs, True])[:, None]
        self._beside_s = 0.0
        whole = time_on(unit, chip.memory, row.work, clock).total_ms / 1e3
        self._beside_s = whole - self.predict(np.zeros(len(RATES)))[0] / 1e3

    def predict(self, deviations: F64) -> tuple[float, F64]:
        """Return (time in ms, derivative of its logarithm by each deviation (6,)).

        `deviations`: deviations of the logarithms of the seconds per unit of each rate from the profile's (6,).
        """
        costs = self._costs * np.exp(deviations)[RATE_OF_TERM]
        joined, slopes = join(costs[:-1])
        whole = joined.sum() + costs[-1].sum() + self._beside_s
        by_term = (costs[:-1] * slopes).sum(axis=0) + costs[-1]
        by_rate = np.bincount(RATE_OF_TERM, by_term, len(RATES))
        return 1e3 * float(whole), by_rate / whole


def prior_covariance(engines: Sequence[EngineName]) -> F64:
    """Return the covariance of the log rates of `engines`, (6 x engines, 6 x engines), six rates of each in turn."""
    same_engine = np.kron(np.eye(len(engines)), np.ones((len(RATES), len(RATES))))
    same_rate = np.kron(np.ones((len(engines), len(engines))), np.eye(len(RATES)))
    return CHIP**2 + RATE**2 * same_rate + ENGINE**2 * same_engine + OWN**2 * same_engine * same_rate


def _engine_numbers(profile: Profile, unit: UnitName, rows: Sequence[OwnRow]) -> dict[str, tuple[float, float]]:
    """Return (value, spread) of the fitted rates of all engines of the unit, by key."""
    engines = list(profile.units[unit].engines)
    deviations, covariance = _solve([_EngineRow(profile, row) for row in rows], engines)
    spreads = np.sqrt(np.diag(covariance))
    numbers = {}
    for index, engine in enumerate(engines):
        for rate, (key, _) in KEY_OF_RATE.items():
            place = index * len(RATES) + RATES.index(rate)
            value = getattr(profile.units[unit].engines[engine].rates, key).or_else(1.0)
            # a cost grows with the seconds of a unit, a rate falls
            factor = math.exp(deviations[place] if key.endswith("_us") else -deviations[place])
            numbers[f"units.{unit}.engines.{engine}.rates.{key}"] = (value * factor, float(spreads[place]))
    return numbers


def _solve(rows: Sequence[_EngineRow], engines: Sequence[EngineName]) -> tuple[F64, F64]:
    """Return (most probable deviations of the log rates (6 x engines,), their covariance)."""
    precision: F64 = np.linalg.inv(prior_covariance(engines)).astype(np.float64)
    at: F64
    at, places = np.zeros(len(precision)), [len(RATES) * engines.index(row.engine) for row in rows]
    damping, (cost, gradient, curvature) = 1e-3, _derivatives(at, rows, places, precision)
    for _ in range(STEPS):
        step = np.clip(np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -gradient), -1, 1)
        lower, *derivatives = _derivatives(at + step, rows, places, precision)
        if lower > cost:
            damping *= 8
            if damping > 1e6:
                break
            continue
        gain, at, cost, damping = cost - lower, at + step, lower, damping / 5
        gradient, curvature = derivatives
        if gain < ENOUGH * (1 + cost):
            break
    return at, np.linalg.inv(curvature).astype(np.float64)


def _derivatives(at: F64, rows: Sequence[_EngineRow], places: Sequence[int], precision: F64) -> tuple[float, F64, F64]:
    """Return (value that the fit minimises, half its gradient, half its curvature as if predictions were linear).

    `at`: deviations of the log rates (6 x engines,).
    `places`: index of the first rate of each row's engine in `at`.
    """
    cost, gradient, curvature = float(at @ precision @ at), precision @ at, precision.copy()
    for row, place in zip(rows, places, strict=True):
        span = slice(place, place + len(RATES))
        ms, growth = row.predict(at[span])
        miss = math.log(ms / row.ms) / NOISE
        weight = (NU + 1) / (NU + miss**2)
        cost += (NU + 1) * math.log1p(miss**2 / NU)
        gradient[span] += weight * miss * growth / NOISE
        curvature[span, span] += weight * np.outer(growth, growth) / NOISE**2
    return cost, gradient, curvature


def _unit_numbers(profile: Profile, unit: UnitName, rows: Sequence[OwnRow]) -> dict[str, tuple[float, float]]:
    """Return (value, spread) of each known number of a unit without a tensor engine, by key.

    The fit finds one factor on all times of the unit. It divides the efficiencies by this factor, up to
    MOST_EFFICIENCY, and multiplies the COSTS by it. The spread of each number stays as in `profile`.
    """
    own = profile.units[unit]
    noise = max(NOISE, own.model_error_fraction.or_else(0.3))
    misses = np.array([math.log(row.ms / _predicted(profile, row)[0]) for row in rows])
    slower = 0.0
    for _ in range(STEPS):
        weights = (NU + 1) / (NU + ((misses - slower) / noise) ** 2)
        slower = float((weights * misses).sum() / noise**2 / (weights.sum() / noise**2 + 1 / CHIP**2))
    factor = math.exp(slower)
    numbers = {}
    for key, quantity in own.efficiency:
        if quantity.value is not None:
            value = min(quantity.value / factor, MOST_EFFICIENCY)
            numbers[f"units.{unit}.efficiency.{key}"] = (value, quantity.relative_error)
    for key in COSTS:
        quantity = getattr(own, key)
        if quantity.value is not None:
            numbers[f"units.{unit}.{key}"] = (quantity.value * factor, quantity.relative_error)
    return numbers


class NamedRow(NamedTuple):
    """The cells of a table's row as texts, without the time."""

    network: str
    unit: str
    precision: str
    runtime: str


def fit_row(table: Path, network: str | None, unit: str | None, precision: str | None, runtime: str | None) -> NamedRow:
    """Return the checked cells of a new row of `table`. For None, the usual word of WORDS is taken.

    Raises BadInputError for a wrong cell, no `network`, or a network's file that cannot be read.
    """
    if not network:
        raise BadInputError("--network", "nothing", "the network that was measured", "a path beside the table")
    cells = {"unit": unit or "", "precision": precision or "", "runtime": runtime or ""}
    words = [_word("--rows", cells, *each) for each in WORDS]
    remedy = f"put the network into the folder of {table.name}, and give --network its path from there"
    read_graph(network_file("--network", network, table.absolute().parent, remedy))
    return NamedRow(network, *words)
