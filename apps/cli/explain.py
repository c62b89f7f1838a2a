"""`trilane explain`: where the time of a run went.

Rule: this module reads options and shows results; everything is decided and computed elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from trilane.apps.cli.commands import Commands, JsonOption, NewestRunArgument
from trilane.apps.cli.console import (
    print_json,
    print_verdict,
    shown_messages,
    spinner,
    stderr_console,
    stdout_console,
    without_controls,
)

if TYPE_CHECKING:
    from rich.table import Table

app = Commands()
EPILOG = """\b
Examples:
  trilane explain
  trilane explain runs/20261122T070136Z-default --slowest 20
  trilane explain walk --json
  trilane explain walk --frame 57
  trilane explain /tmp/run --jobs jobs.csv
"""
SLOWEST: Final = 10
MOST_SLOWEST: Final = 1000
LEAST_SHARE: Final = 0.005  # of the frame time, for a row
SlowestOption = Annotated[int, typer.Option(min=1, max=MOST_SLOWEST, help="Number of the slowest frames to explain.")]
FrameOption = Annotated[
    int | None, typer.Option(min=0, help="Say instead what became of this frame: its jobs, or why it was dropped.")
]
JobsOption = Annotated[Path | None, typer.Option(help="File for a table of all jobs (.csv, .parquet).")]
READ_PATH_SO = (
    "a job begins when the last thing that it needs is there; the path goes on with the job that brought it, so that "
    "the rows sum to the frame time; it is one path through the whole run, to its last frame: what held the rate back"
)
SLOWEST_SO = (
    "each frame's own path, from the frame presented before it to its end, beside the medians of all frames: it may "
    "blame what the path through the whole run above does not, where other jobs hid that time"
)


@app.command(epilog=EPILOG)
def explain(
    run: NewestRunArgument = None,
    slowest: SlowestOption = SLOWEST,
    frame: FrameOption = None,
    jobs: JobsOption = None,
    json: JsonOption = False,
) -> None:
    """Say where the time of a run went.

    The output is the stage or wait that bounded the run, why jobs waited, and why the slowest frames were slow
    (docs/explain.md). `trilane plan` explains a scene before it runs.
    """
    from trilane.apps.explain.explained_run import check_ending, explain_frame, explain_run, write_jobs
    from trilane.apps.watch.followed_run import follow
    from trilane.writing import require_writable

    if jobs is not None:
        check_ending(jobs)
        require_writable(jobs)
    folder = follow(run).folder
    with spinner("reading the journal"):
        document = explain_run(folder, slowest) if frame is None else explain_frame(folder, frame)
        count = write_jobs(folder, jobs) if jobs is not None else 0
    if jobs is not None:
        stderr_console().print(f"jobs: {jobs}, {count} rows", soft_wrap=True, markup=False)
    if json:
        print_json(document)
        return
    (_show_run if frame is None else _show_frame)(without_controls(document))


def _show_frame(document: Mapping[str, Any]) -> None:
    from rich.table import Table

    after = "" if document["after_ms"] is None else f" {document['after_ms']:.1f} ms after its release"
    cause = "" if document["cause"] is None else f", cause {document['cause']} (docs/policies-and-edges.md)"
    latency = "" if document["latency_ms"] is None else f", latency {document['latency_ms']:.1f} ms"
    console = stdout_console()
    console.print(f"Frame {document['frame']}: {document['outcome']}{after}{cause}{latency}", soft_wrap=True)
    if not document["jobs"]:
        console.print("no job of it began")
        return
    table = Table("stage (unit)", "began, ms", "took, ms", "waited, ms", "why, ms")
    for row in document["jobs"]:
        times = [f"{row[key]:.2f}" for key in ("begin_ms", "took_ms", "wait_ms")]
        table.add_row(f"{row['stage']} ({row['unit']})", *times, _causes(row["causes_ms"]))
    console.print(table)


def _causes(causes_ms: Mapping[str, float]) -> str:
    return ", ".join(f"{cause} {ms:.2f}" for cause, ms in causes_ms.items() if ms >= 0.005) or "-"


def _show_run(document: Mapping[str, Any]) -> None:
    console = stdout_console()
    if document["verdict"] and not document["remark"]:
        print_verdict(document["verdict"]["lines"])
        console.print()
    for line in _head(document):
        console.print(line, soft_wrap=True, markup=False)
    if not document["budget"]:
        return
    console.print(_budget(document))
    for line in _shared(document["shared_cores"]):
        console.print(line, soft_wrap=True, markup=False)
    console.print(_waits(document["waits"]))
    for row in document.get("joins", ()):
        from trilane.apps.explain.joins import said

        console.print(said(row), soft_wrap=True, markup=False)
    console.print(_slowest(document))
    for line in document["advice"]:
        console.print(f"try: {line}", soft_wrap=True, markup=False)
    console.print(f"times: {document['sources']['frames, waits_ms, service_ms, preempted_ms']}", soft_wrap=True)


def _head(document: Mapping[str, Any]) -> Iterator[str]:
    if document["remark"]:
        yield document["remark"]
    frame_ms = document["frame_ms"]
    mean = "fewer than two frames: no frame time" if frame_ms is None else f"{frame_ms:.2f} ms a frame"
    scene = f"scene {document['scene']}, " if document["scene"] else ""
    yield f"Run {document['run']}: {scene}policy {document['policy']}, {document['frames']} frames, {mean}"
    for kind, counts in document["left"].items():
        causes = ", ".join(f"{cause} {count}" for cause, count in counts.items())
        yield f"frames {kind}: {sum(counts.values())} ({causes})"
    if frame_ms and document["nobodys_ms"] >= LEAST_SHARE * frame_ms:
        yield (
            f"other programs: {document['nobodys_ms']:.1f} of {frame_ms:.1f} ms a frame were nobody's of this run: a "
            "stage on the path had no core, and no job of this run had it"
        )
    yield from _efficiency(document)
    if document["failure"]:
        yield f"the run failed: {document['failure']}"
    yield from (f"in the run: {message}" for message in shown_messages(document["messages"], document["failure"]))
    for name, facts in document["accuracy"].items():
        if "psnr_db_by_band" in facts:
            bands = ", ".join(f"{band} {value:.1f}" for band, value in facts["psnr_db_by_band"].items())
            yield f"avatar {name}: PSNR on held-out views, dB: {bands} ({facts['source']})"
        else:
            yield f"avatar {name}: {facts.get('source', 'no figures')} of accuracy"


def _efficiency(document: Mapping[str, Any]) -> Iterator[str]:
    """Say what bounded the run, and what all cores did."""
    if bound := document.get("bound"):
        from trilane.apps.explain.reasons import bound_text

        yield f"bound: {bound_text(bound)}"
    if document["cores"]:
        numbers, efficiency = ",".join(map(str, document["cores"]["numbers"])), document["machine_efficiency"]
        cpu_ms, had_ms = document["cores"]["cpu_ms"], document["cores"]["had_ms"]
        yield (
            f"efficiency: {document['efficiency']:.0%} of the slowest unit, {document['core_efficiency']:.0%} of the "
            f"fullest cores, {efficiency:.0%} of all (cores {numbers}: {cpu_ms:.2f} of {had_ms:.2f} ms a frame in jobs)"
        )


def _budget(document: Mapping[str, Any]) -> Table:
    """Return a table of what bounded the frame time, by stage and cause."""
    from rich.table import Table

    table = Table(
        "stage (unit)",
        "what",
        "ms a frame",
        "share",
        title="What bounded the frame time",
        title_justify="left",
        caption=READ_PATH_SO,
        caption_justify="left",
    )
    small = [row for row in document["budget"] if row["share"] < LEAST_SHARE]
    for row in document["budget"]:
        if row["share"] >= LEAST_SHARE:
            table.add_row(f"{row['stage']} ({row['unit']})", row["why"], f"{row['ms']:.2f}", f"{row['share']:.1%}")
    if small:
        ms, share = (sum(row[key] for row in small) for key in ("ms", "share"))
        table.add_row("", f"smaller parts, {len(small)}: --json has them", f"{ms:.2f}", f"{share:.1%}")
    return table


def _shared(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Name the stages that had the core while the unit of another stage lacked it for a noticeable time."""
    for row in rows:
        if row["preempted_ms"] < LEAST_SHARE * row["service_ms"]:
            continue
        lead = f"{row['stage']}: {row['preempted_ms']:.2f} of {row['service_ms']:.2f} ms a job without a core"
        found = [
            f"{ms:.2f} ms of it {other} had it, on core"
            f"{'s' if len(row['shared'][other]) > 1 else ''} {','.join(map(str, row['shared'][other]))}"
            for other, ms in row["taken_ms"].items()
        ]
        found.append(f"{row['others_ms']:.2f} ms nobody of this run")
        yield f"{lead}; {'; '.join(found)}"


def _waits(rows: list[dict[str, Any]]) -> Table:
    from rich.table import Table

    table = Table("stage (unit)", "jobs", "wait, ms", "why, ms", title="Why jobs waited", title_justify="left")
    for row in rows:
        waited = f"{row['wait_ms']:.2f}"
        table.add_row(f"{row['stage']} ({row['unit']})", str(row["jobs"]), waited, _causes(row["causes_ms"]))
    return table


def _slowest(document: Mapping[str, Any]) -> Table:
    from rich.table import Table

    usual = document["usual"]["frame_ms"]
    title = f"The slowest frames (the median takes {usual:.2f} ms)"
    table = Table(
        "frame",
        "ms",
        "latency, ms",
        "why",
        title=title,
        title_justify="left",
        caption=SLOWEST_SO,
        caption_justify="left",
    )
    for row in document["slowest"]:
        reasons = [f"{reason['longer_ms']:.1f} ms: {reason['text']}" for reason in row["why"]]
        table.add_row(
            str(row["frame"]),
            f"{row['frame_ms']:.1f}",
            "-" if row["latency_ms"] is None else f"{row['latency_ms']:.1f}",
            "\n".join([*row["notes"], *reasons]) or "hardly longer than the median",
        )
    return table
