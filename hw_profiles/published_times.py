"""Published latencies of networks on chips: a folder of rows to fit to, and two networks to check profiles by.

`read_latencies` decides which rows count, by what the file says of them. `fit_engines.py` has seen both networks among
some thirty others, so `check_published` says how well the fit holds; `trilane profiles fit-chips` says how well unseen
networks are predicted. Source: Qualcomm AI Hub Models, `unet_segmentation` (milesial's U-Net of 31.0 M parameters on
640x1280x3) and `resnet18`, w8a8, TFLite and QNN runtimes, QAIRT 2.41 (BSD-3-Clause, github.com/quic/ai-hub-models,
perf.yaml).
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from trilane.errors import BadInputError
from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.network_work import Work, count_work
from trilane.hw_profiles.operators import Layers
from trilane.hw_profiles.reference_networks import GraphBuilder, TensorRef, resnet18
from trilane.hw_profiles.schema import EngineName, EngineRuntime, Profile, corners_of
from trilane.hw_profiles.unit_times import time_on
from trilane.units import UNITS

Times = Mapping[str, Mapping[EngineRuntime, float]]

UNET_SIZE = (640, 1280)
UNET_WIDTHS = (64, 128, 256, 512, 1024)

#: Milliseconds of each network, by the engine's runtime.
_QCS8450: Times = {"unet": {"tflite": 54.07, "qnn_dlc": 57.895}, "resnet18": {"tflite": 0.609, "qnn_dlc": 0.743}}
#: The times of the 8 Gen 1 were published for the QCS8450, which Qualcomm also takes for the XR2 Gen 2; those of the
#: 8 Gen 2 for the QCS8550.
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
#: Rows that say so ran elsewhere, or fell off the engine.
NOT_OF_THE_ENGINE = ("layers on", "over 1 s")
COLUMNS = ("network", "chip", "hexagon", "precision", "runtime", "ms", "caution", "use")


class PublishedTime(NamedTuple):
    """A published time beside the predicted one, both of the same runtime.

    `independent`: whether no number of the profile comes from this time.
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
    """Return the work of ResNet18 as a classifier of 224x224 pictures, which it normalises, into 1000 classes."""
    b = GraphBuilder("batch")
    picture = b.same("Sub", b.input("image", 3, 224, 224), b.weight((1, 3, 1, 1)))
    x = resnet18(b, b.same("Div", picture, b.weight((1, 3, 1, 1))))[-1]
    out = b.conv(b.op("GlobalAveragePool", [x.name], (x.channels, 1, 1)), 1000, 1, bias=True)
    return count_work(b.model("resnet18", [out]))


WORK = {"unet": unet_work, "resnet18": resnet18_work}


def check_published(name: str, profile: Profile) -> list[PublishedTime]:
    """Return published times of the chip `name` beside those that `profile` predicts under `burst`; empty for none.

    A runtime for which the profile has no numbers of the tensor engine is left out.
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
    """One published time. `hexagon`: generation of the engine. `anchor`: whether the table marks the
    row as an anchor: its chip has a few rows only, and begins at the numbers of the chip before it."""

    network: str
    family: str
    chip: str
    hexagon: str
    engine: EngineName
    ms: float
    anchor: bool = False


def read_latencies(folder: Path) -> list[Latency]:
    """Return the rows of `chip_rows.csv` that tell something of the engine. Raises BadInputError."""
    families = {row["name"]: row["family"] for row in _table(folder / "networks.csv") if row["split"] != "extra"}
    rows = _table(folder / "chip_rows.csv")
    if not rows or set(COLUMNS) - rows[0].keys():
        raise BadInputError(folder / "chip_rows.csv", "other columns", "the columns " + ", ".join(COLUMNS))
    return [
        Latency(
            row["network"],
            families[row["network"]],
            row["chip"],
            row["hexagon"],
            ENGINE_OF[row["precision"], row["runtime"]],
            float(row["ms"]),
            row["use"] == "anchor",
        )
        for row in rows
        if row["network"] in families and not any(words in row["caution"] for words in NOT_OF_THE_ENGINE)
    ]


def _table(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))
    except OSError as error:
        raise BadInputError.of_os_error(path, error, "a CSV file that can be read") from None


@lru_cache(maxsize=128)
def layers_in(folder: Path, network: str) -> Layers:
    """Return the layers of a network of the folder."""
    return read_graph(folder / "networks" / f"{network}.onnx").work.layers


def layers_of_rows(folder: Path, rows: Sequence[Latency]) -> dict[str, Layers]:
    """Return the layers of every network that `rows` name."""
    return {name: layers_in(folder, name) for name in sorted({row.network for row in rows})}
