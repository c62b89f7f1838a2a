"""What the cross-validation of tensor engines says: a table in Markdown, a picture of predicted against published.

Rule: nothing is computed here but medians and shares of rows that a fit without their network predicted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from trilane.errors import BadInputError
from trilane.hw_profiles.engine_study import Study
from trilane.hw_profiles.fit_engines import LeftOut
from trilane.hw_profiles.plot import figure_for
from trilane.hw_profiles.schema import EngineName
from trilane.writing import write_atomically

BEGIN, END = "<!-- errors: written by `trilane profiles fit-chips` -->", "<!-- end of errors -->"
#: The engine whose errors are told by family and chip: bytes under the phone's usual runtime.
USUAL: EngineName = "int8_tflite"
CLOSE = 0.15


def errors_of(rows: Sequence[LeftOut]) -> dict[str, float]:
    """`rows`, `median` and `p90` of the absolute errors, `close`: share within 15 %, `bias`: median of the errors."""
    errors = np.array([row.error for row in rows])
    return {
        "rows": len(rows),
        "median": float(np.median(np.abs(errors))),
        "p90": float(np.quantile(np.abs(errors), 0.9)),
        "close": float(np.mean(np.abs(errors) <= CLOSE)),
        "bias": float(np.median(errors)),
    }


def as_markdown(study: Study) -> str:
    """Two tables: errors by engine, and those of USUAL by family and chip."""
    return "\n".join([*_by_engine(study), "", *_by_family(study.engines[USUAL].left_out)])


def _by_engine(study: Study) -> Iterator[str]:
    yield "| engine | rows | median | p90 | within 15 % | in the 80 % interval |"
    yield "|---|---|---|---|---|---|"
    for name, engine in study.engines.items():
        all_rows = errors_of(engine.left_out)
        shares = " | ".join(f"{100 * all_rows[key]:.0f} %" for key in ("median", "p90", "close"))
        yield f"| `{name}` | {all_rows['rows']:.0f} | {shares} | {100 * engine.coverage:.0f} % |"


def _by_family(rows: Sequence[LeftOut]) -> Iterator[str]:
    chips = sorted({row.row.chip for row in rows})
    yield f"| median error, `{USUAL}` | {' | '.join(chips)} | all |"
    yield "|---|" + "---|" * (len(chips) + 1)
    for family in [*sorted({row.row.family for row in rows}), ""]:
        of_family = [row for row in rows if family in ("", row.row.family)]
        cells = [_median([row for row in of_family if row.row.chip in of]) for of in (*([c] for c in chips), chips)]
        yield f"| {family or 'all'} | {' | '.join(cells)} |"


def _median(rows: Sequence[LeftOut]) -> str:
    return f"{100 * errors_of(rows)['median']:.0f} %" if rows else ""


def with_table(text: str, table: str, path: Path) -> str:
    """`text`, which is that of `path`, with `table` between BEGIN and END. Raises BadInputError where they are not."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise BadInputError(path, "no place for the table", f"a line {BEGIN} and a line {END}")
    return f"{before}{BEGIN}\n{table}\n{END}{after}"


def plot_errors(study: Study, path: Path) -> None:
    """Draw each left-out row: published against predicted time, by engine, on logarithmic axes.

    `path`: of the file; its ending is one of `trilane.hw_profiles.plot.SUFFIXES`.
    Raises MissingPartError without Matplotlib, BadInputError for another ending or a file that cannot be written.
    """
    figure = figure_for(path, (6.4, 6))
    axes = figure.subplots()
    for name, engine in study.engines.items():
        rows = engine.left_out
        axes.plot([r.row.ms for r in rows], [r.predicted_ms for r in rows], ".", markersize=4, alpha=0.6, label=name)
    ends = np.array([0.1, 200.0])
    axes.plot(ends, ends, color="black", linewidth=0.8)
    for factor in (1 + CLOSE, 1 / (1 + CLOSE)):
        axes.plot(ends, factor * ends, color="black", linewidth=0.5, linestyle="--")
    axes.set(xscale="log", yscale="log", xlabel="published, ms", ylabel="predicted by a fit without the network, ms")
    axes.set_title("Networks that the fit has not seen; dashed: 15 %")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize="small")
    with write_atomically(path) as draft:
        figure.savefig(draft, dpi=120)
