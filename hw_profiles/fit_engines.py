"""Fits tensor engines to published latencies of networks on chips, and checks profiles with two of these networks.

`read_latencies` decides which rows count, by their column `caution`. The fit has seen both networks of the check among
some thirty others. Therefore `check_published` says only how well the fit holds; `trilane profiles fit-chips` says how
well unseen networks are predicted. Source: Qualcomm AI Hub Models, `unet_segmentation` (milesial's U-Net of 31.0 M
parameters on 640x1280x3) and `resnet18`, w8a8, TFLite and QNN runtimes, QAIRT 2.41 (BSD-3-Clause,
github.com/quic/ai-hub-models, perf.yaml).

The fit finds the factors of the terms, which all chips share, and six rates of each chip. Every number has a prior, its
value and spread before any latency is known. The fit minimises, over the logarithms of all numbers,

    sum over rows of (NU + 1) log(1 + r^2 / NU) + sum over numbers of (log(number / prior) / spread)^2,
    r = log(predicted / published) / NOISE,

by Gauss and Newton's method with Levenberg's damping and the exact derivatives of `unit_times.join`. This gives the
most probable numbers if errors follow Student's t distribution. With that distribution, a row with a large error counts
little.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trilane.arrays import F64, I64
from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.network_work import Work, count_work
from trilane.hw_profiles.operators import NAMES, RATES, TERMS, Layers
from trilane.hw_profiles.reference_networks import GraphBuilder, TensorRef, resnet18
from trilane.hw_profiles.schema import KEY_OF_RATE, EngineName, EngineRuntime, Profile, corners_of
from trilane.hw_profiles.unit_times import amounts, join, time_on
from trilane.units import UNITS

Times = Mapping[str, Mapping[EngineRuntime, float]]

UNET_SIZE = (640, 1280)
UNET_WIDTHS = (64, 128, 256, 512, 1024)

#: Published time of each network in ms, by the engine's runtime.
_QCS8450: Times = {"unet": {"tflite": 54.07, "qnn_dlc": 57.895}, "resnet18": {"tflite": 0.609, "qnn_dlc": 0.743}}
#: Published times of the two networks in ms, by the profile's name. The times of the 8 Gen 1 were published for the
#: QCS8450, which Qualcomm also uses for the XR2 Gen 2. The times of the 8 Gen 2 were published for the QCS8550.
PUBLISHED_MS: dict[str, Times] = {
    "qcs6490": {"unet": {"tflite": 267.749, "qnn_dlc": 267.845}, "resnet18": {"tflite": 1.481, "qnn_dlc": 1.811}},
    "sa8295p": {"unet": {"tflite": 63.621, "qnn_dlc": 63.575}, "resnet18": {"tflite": 0.774, "qnn_dlc": 0.957}},
    "snapdragon-8-gen-1": _QCS8450,
    "snapdragon-xr2-gen-2": _QCS8450,
    "snapdragon-8-gen-2": {
        "unet": {"tflite": 34.543, "qnn_dlc": 34.657},
        "resnet18": {"tflite": 0.391, "qnn_dlc": 0.548},
    },
    "snapdragon-x-elite": {"unet": {"qnn_dlc": 35.669}, "resnet18": {"qnn_dlc": 0.622}},
    "snapdragon-8-gen-3": {
        "unet": {"tflite": 26.398, "qnn_dlc": 26.4},
        "resnet18": {"tflite": 0.293, "qnn_dlc": 0.405},
    },
    "snapdragon-8-elite": {
        "unet": {"tflite": 21.567, "qnn_dlc": 21.896},
        "resnet18": {"tflite": 0.246, "qnn_dlc": 0.299},
    },
    "snapdragon-8-elite-gen-5": {"unet": {"tflite": 15.895}, "resnet18": {"tflite": 0.233}},
}

ENGINE_OF: dict[tuple[str, str], EngineName] = {
    ("w8a8", "tflite"): "int8_tflite",
    ("w8a8", "qnn_dlc"): "int8_qnn_dlc",
    ("float", "tflite"): "fp16_tflite",
    ("float", "qnn_dlc"): "fp16_qnn_dlc",
}
#: Words in the column `caution` of rows whose network did not run, or not wholly, on the engine.
NOT_OF_THE_ENGINE = ("layers on", "over 1 s")
COLUMNS = ("network", "chip", "hexagon", "precision", "runtime", "ms", "caution", "use")


class PublishedTime(NamedTuple):
    """A published time and the predicted time, both for the same runtime.

    `independent`: True if no number of the profile comes from this published time.
    """

    profile: str
    network: str
    runtime: EngineRuntime
    independent: bool
    published_ms: float
    predicted_ms: float

    @property
    def error(self) -> float:
        return self.predicted_ms / self.published_ms - 1


@lru_cache(maxsize=1)
def unet_work() -> Work:
    """Return the work of the published U-Net."""
    b = GraphBuilder("batch")
    x = _double(b, b.input("image", 3, *UNET_SIZE), UNET_WIDTHS[0])
    skips = []
    for width in UNET_WIDTHS[1:]:
        skips.append(x)
        x = b.op("MaxPool", [x.name], (x.channels, x.height // 2, x.width // 2), kernel_shape=[2, 2], strides=[2, 2])
        x = _double(b, x, width)
    for width, skip in zip(reversed(UNET_WIDTHS[:-1]), reversed(skips), strict=True):
        weight = b.weight((x.channels, width, 2, 2))
        x = b.op("ConvTranspose", [x.name, weight], (width, *skip[2:]), kernel_shape=[2, 2], strides=[2, 2])
        x = _double(b, b.op("Concat", [skip.name, x.name], (2 * width, *skip[2:]), axis=1), width)
    out = b.conv(x, 2, 1, bias=True)
    return count_work(b.model("unet", [out]))


def _double(b: GraphBuilder, x: TensorRef, width: int) -> TensorRef:
    return b.unit(b.unit(x, width, 3), width, 3)


@lru_cache(maxsize=1)
def resnet18_work() -> Work:
    """Return the work of ResNet18: it normalises a 224x224 picture, and classifies it into 1000 classes."""
    b = GraphBuilder("batch")
    picture = b.same("Sub", b.input("image", 3, 224, 224), b.weight((1, 3, 1, 1)))
    x = resnet18(b, b.same("Div", picture, b.weight((1, 3, 1, 1))))[-1]
    out = b.conv(b.op("GlobalAveragePool", [x.name], (x.channels, 1, 1)), 1000, 1, bias=True)
    return count_work(b.model("resnet18", [out]))


WORK = {"unet": unet_work, "resnet18": resnet18_work}


def check_published(name: str, profile: Profile) -> list[PublishedTime]:
    """Return the published times of the chip `name`, with the times that `profile` predicts under `burst`.

    A runtime is left out if the profile has no tensor engine for it. The list is empty for a chip without published
    times.
    """
    unit = profile.units["dsp"]
    clock = unit.clock(corners_of(profile, "burst")[UNITS.index("dsp")])
    checks = []
    for network, by_runtime in PUBLISHED_MS.get(name, {}).items():
        for runtime, ms in by_runtime.items():
            running = unit.model_copy(update={"engine_runtime": runtime})
            if running.engine is not None:
                predicted = time_on(running, profile.memory, WORK[network](), clock).total_ms
                checks.append(PublishedTime(name, network, runtime, False, ms, predicted))
    return checks


class Latency(NamedTuple):
    """One published time.

    `family`: family of the network by `networks.csv`.
    `hexagon`: generation of the chip's Hexagon.
    `ms`: time of one inference.
    `anchor`: whether the table marks the row as an anchor. A chip with anchors has only a few rows; its prior comes
    from the chip before it.
    """

    network: str
    family: str
    chip: str
    hexagon: str
    engine: EngineName
    ms: float
    anchor: bool = False


def read_latencies(folder: Path) -> list[Latency]:
    """Return the rows of `chip_rows.csv` whose networks ran on the engine, without the split `extra` of `networks.csv`.

    Raises BadInputError if a table cannot be read, lacks columns or has a damaged row.
    """
    networks = _table(folder / "networks.csv", ("name", "split", "family"))
    families = {row["name"]: row["family"] for _, row in networks if row["split"] != "extra"}
    return [
        Latency(
            row["network"],
            families[row["network"]],
            row["chip"],
            row["hexagon"],
            *_engine_and_ms(place, row),
            row["use"] == "anchor",
        )
        for place, row in _table(folder / "chip_rows.csv", COLUMNS)
        if row["network"] in families and not any(words in row["caution"] for words in NOT_OF_THE_ENGINE)
    ]


def _engine_and_ms(place: str, row: Mapping[str, str]) -> tuple[EngineName, float]:
    ran = row["precision"], row["runtime"]
    if ran not in ENGINE_OF:
        raise BadInputError(place, ", ".join(ran), f"one of {'; '.join(', '.join(each) for each in ENGINE_OF)}")
    try:
        ms = float(row["ms"])
    except ValueError:
        ms = math.nan
    if not 0 < ms < math.inf:
        raise BadInputError(f"{place}: ms", repr(row["ms"]), "a time in ms above 0")
    return ENGINE_OF[ran], ms


def _table(path: Path, columns: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Return pairs (file and line, cells by column) of a table, with "" for a cell that its row lacks."""
    reader = csv.DictReader(read_text(path, "a CSV file").splitlines(), restval="")
    if missing := [column for column in columns if column not in (reader.fieldnames or ())]:
        raise BadInputError(path, f"no column {', '.join(missing)}", f"the columns {', '.join(columns)}")
    if not (rows := [(f"{path}: line {reader.line_num}", row) for row in reader]):
        raise BadInputError(path, "no row below the columns", "one or more")
    return rows


@lru_cache(maxsize=128)
def layers_in(folder: Path, network: str) -> Layers:
    """Return the layers of a network in `folder`/networks. Raises BadInputError for a file that cannot be read."""
    return read_graph(folder / "networks" / f"{network}.onnx").work.layers


def layers_of_rows(folder: Path, rows: Sequence[Latency]) -> dict[str, Layers]:
    """Return the layers of every network that `rows` name."""
    return {name: layers_in(folder, name) for name in sorted({row.network for row in rows})}


NOISE, NU = 0.08, 3.0
STEPS, ENOUGH = 60, 1e-5
#: The only network that determines the peak rate; it is in every fit.
ALWAYS = "unet_segmentation"
FOLDS = 5
RATE_OF_TERM = np.array([RATES.index(TERMS[name]) for name in NAMES])
COSTS = ("operator", "job")


class Numbers(NamedTuple):
    """Logarithms of an engine's numbers.

    `factors`: logarithms of the factors of the terms (terms,).
    `rates`: logarithms of the seconds per unit of each rate (chips, 6).
    """

    factors: F64
    rates: F64

    @property
    def flat(self) -> F64:
        return np.concatenate([self.factors, self.rates.ravel()])


def _from_flat(flat: F64) -> Numbers:
    return Numbers(flat[: len(NAMES)], flat[len(NAMES) :].reshape(-1, len(RATES)))


@dataclass(frozen=True)
class Fitted:
    """The numbers of an engine for `chips`.

    `spreads`: spread of each number after the fit.
    `seen`: for each network of the fit, the share of each term in its time (terms,), as the mean over all chips.
    """

    engine: EngineName
    chips: tuple[str, ...]
    numbers: Numbers
    spreads: Numbers
    seen: Mapping[str, F64] = field(default_factory=dict)

    def unlike(self, shares: F64) -> float:
        """Return the distance, 0 to 1, of a network from the nearest network of the fit.

        `shares`: share of each term in the network's time (terms,).
        """
        return min((float(np.abs(shares - others).sum()) / 2 for others in self.seen.values()), default=1.0)

    def rates_of(self, chip: str) -> dict[str, Prior]:
        """Return (value in the unit of a profile, relative spread) of the six rates of `chip`, by key of a profile."""
        row = self.chips.index(chip)
        values, spreads = self.numbers.rates[row], self.spreads.rates[row]
        return {
            KEY_OF_RATE[rate][0]: Prior(as_stated(self.engine, rate, math.exp(value)), float(spread))
            for rate, value, spread in zip(RATES, values, spreads, strict=True)
        }


def as_stated(engine: EngineName, rate: str, seconds: float) -> float:
    """Return the value of the key `rate` in the unit of a profile. `seconds`: seconds per unit of the rate."""
    unit = KEY_OF_RATE[rate][1]
    return seconds / unit if rate in COSTS else _bytes(engine, rate) / (seconds * unit)


def _seconds(engine: EngineName, rate: str, stated: float) -> float:
    unit = KEY_OF_RATE[rate][1]
    return stated * unit if rate in COSTS else _bytes(engine, rate) / (stated * unit)


def _bytes(engine: EngineName, rate: str) -> int:
    return 2 if engine.startswith("fp16") and rate != "arithmetic" else 1


class _Rows:
    """Rows of one engine as arrays: chip, network and time of each, and amounts of their different layers."""

    def __init__(self, rows: Sequence[Latency], layers: Mapping[str, Layers], chips: Sequence[str]) -> None:
        tables = [_distinct(layers[row.network], _room(row)) for row in rows]
        self.chip: I64 = np.array([chips.index(row.chip) for row in rows])
        self.network = np.array([row.network for row in rows])
        self.ms: F64 = np.array([row.ms for row in rows])
        self.table = np.concatenate([table for table, _ in tables])
        self.count = np.concatenate([count for _, count in tables])
        self.starts = np.cumsum([0, *(len(table) for table, _ in tables[:-1])])
        self.row = np.repeat(np.arange(len(rows)), [len(table) for table, _ in tables])

    def predict(self, numbers: Numbers) -> tuple[F64, F64]:
        """Return (time of each row in ms (rows,), share of each term in this time (rows, terms)).

        A share is the derivative of the time's logarithm by the logarithm of the term's cost. The shares of a row sum
        to 1.
        """
        seconds = np.exp(numbers.factors + numbers.rates[self.chip][:, RATE_OF_TERM])
        costs = self.table * seconds[self.row]
        joined, slopes = join(costs)
        whole = np.add.reduceat(joined.sum(axis=1) * self.count, self.starts)
        grown = np.add.reduceat(costs * slopes * self.count[:, None], self.starts, axis=0)
        return 1e3 * whole, grown / whole[:, None]

    def slopes(self, shares: F64, chips: int) -> F64:
        """Return the derivatives of the logarithm of each row's time by the logarithm of each number (rows, numbers).

        `shares`: second result of `predict`.
        `chips`: number of chips.
        """
        by_rate = np.stack([shares[:, rate == RATE_OF_TERM].sum(axis=1) for rate in range(len(RATES))], axis=1)
        of_chips = np.zeros((len(shares), chips, len(RATES)))
        of_chips[np.arange(len(shares)), self.chip] = by_rate
        return np.concatenate([shares, of_chips.reshape(len(shares), -1)], axis=1)


def _room(row: Latency) -> int:
    return ON_CHIP_MB[row.hexagon] * 2**20 // (2 if row.engine.startswith("fp16") else 1)


@cache
def _distinct(layers: Layers, room: int) -> tuple[F64, F64]:
    """Return (amounts of each different layer, number of times that it occurs). `room`: as for `amounts`."""
    # Many layers of a network are alike, and every step of the fit prices each kind once.
    table, count = np.unique(amounts(layers, room), axis=0, return_counts=True)
    return table, count.astype(np.float64)


def priors(engine: EngineName, chips: Sequence[str]) -> tuple[Numbers, Numbers]:
    """Return (logarithms of the values, spreads) of an engine's numbers for `chips` before the fit."""
    factors = [factor_prior(engine, name) for name in NAMES]
    rates = [[rate_prior(engine, chip, KEY_OF_RATE[rate][0]) for rate in RATES] for chip in chips]
    values = [[math.log(_seconds(engine, r, p.value)) for r, p in zip(RATES, row, strict=True)] for row in rates]
    return (
        Numbers(np.log([p.value for p in factors]), np.array(values)),
        Numbers(np.array([p.spread for p in factors]), np.array([[p.spread for p in row] for row in rates])),
    )


def fit_engine(rows: Sequence[Latency], layers: Mapping[str, Layers], start: Numbers | None = None) -> Fitted:
    """Return the numbers of one engine, fitted to its `rows`.

    `layers`: layers of each network, by name.
    `start`: numbers at which the search begins; None for the priors.
    """
    engine, chips = rows[0].engine, tuple(sorted({row.chip for row in rows}))
    return solve(engine, chips, _Rows(rows, layers, chips), priors(engine, chips), start)


def solve(
    engine: EngineName,
    chips: tuple[str, ...],
    data: _Rows,
    prior: tuple[Numbers, Numbers],
    start: Numbers | None = None,
) -> Fitted:
    """Return the most probable numbers of an engine.

    `engine`: engine to fit.
    `chips`: names of the chips of the rows.
    `data`: rows to fit.
    `prior`: (logarithms of the numbers, their standard deviations) before the fit.
    `start`: numbers at which the search begins; None for the prior.
    """
    mean, spread = (numbers.flat for numbers in prior)
    at, damping = (mean if start is None else start.flat), 1e-2
    cost = _cost(at, data, mean, spread)
    for _ in range(STEPS):
        gradient, curvature = _derivatives(at, data, mean, spread, len(chips))
        while damping < 1e6:
            step = np.clip(np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -gradient), -1, 1)
            lower = _cost(at + step, data, mean, spread)
            if lower <= cost:
                break
            damping *= 4
        else:
            break
        at, damping, gain, cost = at + step, damping / 5, cost - lower, lower
        if gain < ENOUGH * abs(cost):
            break
    covariance = np.linalg.inv(_derivatives(at, data, mean, spread, len(chips))[1])
    shares = data.predict(_from_flat(at))[1]
    seen = {str(name): shares[data.network == name].mean(axis=0) for name in np.unique(data.network)}
    return Fitted(engine, chips, _from_flat(at), _from_flat(np.sqrt(np.diag(covariance))), seen)


def _cost(at: F64, data: _Rows, mean: F64, spread: F64) -> float:
    misses = np.log(data.predict(_from_flat(at))[0] / data.ms) / NOISE
    return float(((NU + 1) * np.log1p(misses**2 / NU)).sum() + (((at - mean) / spread) ** 2).sum())


def _derivatives(at: F64, data: _Rows, mean: F64, spread: F64, chips: int) -> tuple[F64, F64]:
    """Return (half the gradient of `_cost`, half its curvature as if `predict` were linear).

    `at`, `mean`, `spread`: logarithms of the numbers, their prior means and deviations (numbers,).
    """
    ms, shares = data.predict(_from_flat(at))
    misses = np.log(ms / data.ms) / NOISE
    weights = (NU + 1) / (NU + misses**2)  # rows with a large error count little
    slopes = data.slopes(shares, chips) / NOISE
    gradient = slopes.T @ (weights * misses) + (at - mean) / spread**2
    return gradient, slopes.T @ (weights[:, None] * slopes) + np.diag(1 / spread**2)


class LeftOut(NamedTuple):
    """A row with its prediction by a fit that has not seen its network.

    `unsure`: relative error that the spread of the fit's numbers causes in the prediction.
    `unlike`: distance of the network from the nearest network of the fit, 0 to 1 (`Fitted.unlike`).
    """

    row: Latency
    predicted_ms: float
    unsure: float
    unlike: float = 1.0

    @property
    def error(self) -> float:
        return self.predicted_ms / self.row.ms - 1


def folds(networks: Sequence[str]) -> Iterator[frozenset[str]]:
    """Yield FOLDS disjoint parts of the networks, the same at each call. No part has the network ALWAYS."""
    others = sorted(set(networks) - {ALWAYS})
    drawn = np.random.default_rng(0).permutation(len(others))
    for fold in range(FOLDS):
        yield frozenset(others[index] for index in drawn[fold::FOLDS])


def cross_validate(
    rows: Sequence[Latency], layers: Mapping[str, Layers], start: Numbers, parts: Sequence[frozenset[str]] | None = None
) -> list[LeftOut]:
    """Return the rows whose network some fit left out, each with its prediction by that fit.

    A row is missing if its chip has no rows of other networks in that fit.

    `rows`: rows of one engine.
    `layers`: layers of each network, by name.
    `start`: numbers at which the search of each fit begins.
    `parts`: networks that are left out together; None for the parts of `folds`.
    """
    result = []
    for out in folds([row.network for row in rows]) if parts is None else parts:
        fitted = fit_engine([row for row in rows if row.network not in out], layers, start)
        result += predict_rows(fitted, [row for row in rows if row.network in out], layers)
    return result


def predict_rows(fitted: Fitted, rows: Sequence[Latency], layers: Mapping[str, Layers]) -> list[LeftOut]:
    """Return the rows whose chip `fitted` knows, each with its prediction by `fitted`.

    `layers`: layers of each network, by name.
    """
    known = [row for row in rows if row.chip in fitted.chips]
    data = _Rows(known, layers, fitted.chips)
    ms, shares = data.predict(fitted.numbers)
    unsure = np.linalg.norm(data.slopes(shares, len(fitted.chips)) * fitted.spreads.flat, axis=1)
    unlike = [fitted.unlike(of_row) for of_row in shares]
    found = zip(known, ms, unsure, unlike, strict=True)
    return [LeftOut(row, float(m), float(u), distance) for row, m, u, distance in found]


def fit_anchors(fitted: Fitted, before: str, rows: Sequence[Latency], layers: Mapping[str, Layers]) -> Fitted:
    """Return the numbers of a chip that has only the anchors `rows`.

    The prior of its rates is one STEP faster than the rates of the chip `before` it. The factors of `fitted` stay.

    `fitted`: numbers of all other chips.
    `layers`: layers of each network, by name.
    """
    chip = (rows[0].chip,)
    rates = fitted.numbers.rates[[fitted.chips.index(before)]] - math.log(STEP.value)
    prior = (
        Numbers(fitted.numbers.factors, rates),
        Numbers(np.full(len(NAMES), 1e-6), np.full((1, len(RATES)), STEP.spread)),
    )
    return solve(fitted.engine, chip, _Rows(rows, layers, chip), prior)


class Prior(NamedTuple):
    """A number and its relative spread."""

    value: float
    spread: float


#: Terms whose factor is 1 by definition, because they define the units of the six rates.
UNITS_OF_RATES = ("convolution", "moved", "spill", "weights", "operator", "job")
#: Prior cost of a term in INT8, relative to the term that defines the unit of its rate. The vector unit does depthwise
#: products. Strides break the blocks in which activations are stored. Bilinear interpolation reads four elements.
#: Bytes cannot be divided.
FACTORS: dict[str, Prior] = {
    "grouped": Prior(1, 0.7),
    "first": Prior(1, 0.7),
    "depthwise": Prior(10, 1),
    "stride": Prior(1, 0.7),
    "depthwise_stride": Prior(100, 1),
    "dilation": Prior(1, 0.7),
    "moved_depthwise": Prior(1, 0.7),
    "pool": Prior(1, 0.7),
    "reduction": Prior(1, 0.7),
    "bilinear": Prior(5, 1),
    "nearest": Prior(1, 0.7),
    "concat": Prior(0.3, 1),
    "constant": Prior(1, 0.3),
    "divide": Prior(40, 1),
    "elementwise": Prior(1, 0.7),
    "batch_norm": Prior(10, 0.7),
    "normalisation": Prior(10, 1),
    "shuffle": Prior(10, 1),
    "depth_to_space": Prior(1, 0.7),
    "activation": Prior(1, 0.7),
    "leaky": Prior(1, 0.7),
    "swish": Prior(2, 0.7),
    "clip": Prior(1, 0.7),
    "pad": Prior(0.5, 1),
    "other": Prior(2, 1),
    "input": Prior(2, 1),
    "output": Prior(10, 1),
}
#: In FP16 a batch normalisation of its own is one multiplication and addition, not several passes with new scales.
FP16_FACTORS = {**FACTORS, "batch_norm": Prior(2, 0.7)}
#: Prior of the six rates of the 8 Gen 2 in INT8. They are half of the claimed 26 to 35 TOPS, 200 GB/s of a vector unit,
#: half and two thirds of the memory's 67 GB/s, and the costs of an operator and of a call over FastRPC.
RATES_OF_8_GEN_2: dict[str, float] = {
    "arithmetic_tmac_s": 17,
    "activation_gb_s": 200,
    "spill_gb_s": 30,
    "weight_gb_s": 40,
    "operator_us": 1,
    "job_us": 80,
}
#: Rates in FP16, divided by the rates in INT8. Rates of bytes are the same, and fixed costs are a little larger.
FP16_OVER_INT8 = {"arithmetic_tmac_s": 0.25, "operator_us": 1.5, "job_us": 1.5}
RATE_SPREAD = 0.5
#: Prior slowness of each chip: how many times slower than the 8 Gen 2 it is, by claimed TOPS and memory.
SLOWER = {"qcs6490": 4, "sa8295p": 1.8, "8gen1": 1.7, "8gen2": 1, "8gen3": 0.75, "8elite": 0.6, "xelite": 1}
#: On-chip memory of the engine for activations, in MiB: the VTCM of its generation.
ON_CHIP_MB = {"v66": 4, "v68": 4, "v69": 4, "v73": 8, "v75": 8, "v79": 8, "v81": 8}
#: Speed-up from one generation to the next, as seen in the other chips. The prior of a chip with only a few anchors is
#: the chip before it, with all rates faster by this factor, and with this spread.
STEP = Prior(1.25, 0.15)


def rate_prior(engine: EngineName, chip: str, key: str) -> Prior:
    """Return the prior of the rate `key`, a key of a profile, for `engine` on `chip`."""
    value = RATES_OF_8_GEN_2[key] * (FP16_OVER_INT8.get(key, 1) if engine.startswith("fp16") else 1)
    slower = SLOWER.get(chip, 1)
    return Prior(value * slower if key in ("operator_us", "job_us") else value / slower, RATE_SPREAD)


def factor_prior(engine: EngineName, term: str) -> Prior:
    """Return the prior of the factor of `term` on `engine`."""
    if term in UNITS_OF_RATES:
        return Prior(1, 1e-6)
    return (FP16_FACTORS if engine.startswith("fp16") else FACTORS)[term]
