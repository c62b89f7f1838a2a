"""A picture of frame rate and temperature over minutes, for several performance profiles.

Rule: nothing is computed here. Matplotlib is an optional dependency; where it is missing, the error names it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trilane.errors import BadInputError, MissingPartError
from trilane.hw_profiles.over_time import Moment
from trilane.writing import write_atomically

SUFFIXES = (".png", ".svg", ".pdf")


def figure_for(path: Path, inches: tuple[float, float]) -> Any:
    """Return an empty `matplotlib.figure.Figure`, `inches` wide and high, that can be drawn into the file.

    `path`: path of the file; its ending is one of SUFFIXES.
    Raises MissingPartError without Matplotlib, BadInputError for another ending.
    """
    if path.suffix not in SUFFIXES:
        raise BadInputError(path, f"the ending {path.suffix!r}", "one of " + ", ".join(SUFFIXES))
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingPartError("drawing needs Matplotlib", extra="plot") from None
    return Figure(figsize=inches, layout="constrained")


def plot_over_time(runs: Mapping[str, Sequence[Moment]], limit_c: float, title: str, path: Path) -> None:
    """Draw frame rates and temperatures into a file.

    `runs`: label of each curve -> its moments.
    `limit_c`: temperature that is marked.
    `title`: title of the picture.
    `path`: path of the file; its ending is one of SUFFIXES.
    Raises MissingPartError without Matplotlib, BadInputError for another ending or a file that cannot be written.
    """
    figure = figure_for(path, (8, 6))
    rate, temperature = figure.subplots(2, 1, sharex=True)
    for label, moments in runs.items():
        minutes = [m.t_s / 60 for m in moments]
        (line,) = rate.plot(minutes, [1e3 / m.frame_ms for m in moments], label=label)
        colour = line.get_color()
        temperature.plot(minutes, [m.device_c for m in moments], color=colour, label=f"{label}: device")
        temperature.plot(
            minutes, [m.junction_c for m in moments], color=colour, linestyle=":", label=f"{label}: junction"
        )
    temperature.axhline(limit_c, color="black", linewidth=0.8, linestyle="--", label=f"device limit {limit_c:g} °C")
    rate.set(ylabel="frames per second", title=title)
    rate.set_ylim(0, 1.15 * rate.get_ylim()[1])
    temperature.set(xlabel="minutes (virtual clock)", ylabel="temperature, °C")
    for axes in (rate, temperature):
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", fontsize="small")
    with write_atomically(path) as draft:
        figure.savefig(draft, dpi=120)
