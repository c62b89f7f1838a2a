"""A picture of the calibration table: the error of the picture over the number of frames, a line for each method.

Rule: nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trilane.hw_profiles.plot import figure_for
from trilane.writing import write_atomically


def plot_calibrations(rows: Sequence[Mapping[str, Any]], recommendation: str, path: Path) -> None:
    """Draw `rows` of the calibration table into a file, with the `recommendation` above.

    `path`: its ending is one of SUFFIXES.
    Raises MissingPartError without Matplotlib, BadInputError for another ending or a file that cannot be written.
    """
    figure = figure_for(path, (9, 4.5))
    axes = figure.subplots()
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        axes.plot([row["count"] for row in own], [row["psnr_db"] for row in own], marker="o", label=method)
    counts = sorted({row["count"] for row in rows})
    axes.set_xscale("log")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set(xlabel="frames to calibrate on", ylabel="PSNR to the float network, dB")
    axes.set_title(f"recommended: {recommendation}", fontsize="medium")
    axes.grid(alpha=0.3)
    axes.legend(title="method", fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    with write_atomically(path) as draft:
        figure.savefig(draft, dpi=120)
