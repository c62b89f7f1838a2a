"""Published latencies of networks on chips, as a folder of data has them: rows of a CSV and the networks' graphs.

Rule: which rows count is decided here, by what the file says of them, and nowhere else.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from trilane.errors import BadInputError
from trilane.hw_profiles.engine_layers import Layers
from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.schema import EngineName

ENGINE_OF: dict[tuple[str, str], EngineName] = {
    ("w8a8", "tflite"): "int8_tflite",
    ("w8a8", "qnn_dlc"): "int8_qnn_dlc",
    ("float", "tflite"): "fp16_tflite",
    ("float", "qnn_dlc"): "fp16_qnn_dlc",
}
#: Rows that say so ran elsewhere, or fell off the engine.
NOT_OF_THE_ENGINE = ("layers on", "over 1 s")
COLUMNS = ("network", "chip", "hexagon", "precision", "runtime", "ms", "caution", "use")


class Latency(NamedTuple):
    """One published time. `hexagon`: generation of the engine. `anchor`: all that a chip is known by."""

    network: str
    family: str
    chip: str
    hexagon: str
    engine: EngineName
    ms: float
    anchor: bool = False


def read_latencies(folder: Path) -> list[Latency]:
    """The rows of `chip_rows.csv` that tell something of the engine. Raises BadInputError."""
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
    """The layers of a network of the folder."""
    return read_graph(folder / "networks" / f"{network}.onnx").work.layers


def layers_of_rows(folder: Path, rows: Sequence[Latency]) -> dict[str, Layers]:
    """The layers of every network that `rows` name."""
    return {name: layers_in(folder, name) for name in sorted({row.network for row in rows})}
