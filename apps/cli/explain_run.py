"""`trilane explain RUN`: where the time of a run went, as tables.

Rule: every figure is one of the document's (`trilane.apps.explain.explained_run`); nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from trilane.apps.cli.console import print_json, spinner, stderr_console, stdout_console, without_controls
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from rich.table import Table

SLOWEST: Final = 10
MOST_SLOWEST: Final = 1000
LEAST_SHARE: Final = 0.005  # of the frame time, for a row
#: Options that mean something with a run folder.
OF_A_RUN = frozenset({"scene", "slowest", "jobs", "json"})
#: Options that mean nothing with a scene.
NOT_OF_A_SCENE = frozenset({"slowest", "jobs"})
READ_SO = (
    "a job begins when the last thing that it needs is there; the path goes on with the job that brought it, so that "
    "the rows sum to the frame time; it is one path through the whole run, to its last frame: what held the rate back"
)
SLOWEST_SO = (
    "each frame's own path, from the frame presented before it to its end, beside the medians of all frames: it may "
    "blame what the path through the whole run above does not, where other jobs hid that time"
)


def run_folder(name: str) -> Path | None:
    """The run folder that `trilane explain NAME` means, found as `trilane top` finds it; None: a scene is meant.

    A name that a scene of Trilane's has means that scene. Raises BadInputError for a folder whose journal is a link to
    nothing.
    """
    from trilane.apps.live.followed_run import EXPECTED, follow, without_journal
    from trilane.pipeline.journal import NAME
    from trilane.scene.schema import scene_names

    folder = Path(name)
    if any((folder / file).exists() for file in ("report.json", NAME)):
        return folder
    if (folder / NAME).is_symlink():
        raise BadInputError(folder, without_journal(folder), EXPECTED)
    if folder.is_file() or name in scene_names():
        return None
    try:
        return follow(folder).folder
    except BadInputError:  # the scene's own message names what was expected
        return None


def refuse_options(typed: set[str], *, of_a_run: bool) -> None:
    """Raises BadInputError for options that the other kind of `trilane explain` has."""
    useless = typed - OF_A_RUN if of_a_run else typed & NOT_OF_A_SCENE
    if useless:
        names = ", ".join(sorted(f"--{name.replace('_', '-')}" for name in useless))
        kind, expected = ("a run folder", "--slowest, --jobs or --json") if of_a_run else ("a scene", "a run folder")
        raise BadInputError("options", f"{names} with {kind}", expected)


def explain_folder(folder: Path, slowest: int, jobs: Path | None, as_json: bool) -> None:
    """Print where the time of the run in `folder` went. `jobs`: write its jobs there. Raises BadInputError."""
    from trilane.apps.explain.explained_run import check_ending, explain_run, write_jobs
    from trilane.writing import require_writable

    if jobs is not None:
        check_ending(jobs)
        require_writable(jobs)
    with spinner("reading the journal"):
        document = explain_run(folder, slowest)
        count = write_jobs(folder, jobs) if jobs is not None else 0
    if jobs is not None:
        stderr_console().print(f"jobs: {jobs}, {count} rows", soft_wrap=True, markup=False)
    if as_json:
        print_json(document)
        return
    _show(without_controls(document))


def _show(document: Mapping[str, Any]) -> None:
    console = stdout_console()
    for line in _head(document):
        console.print(line, soft_wrap=True, markup=False)
    if not document["budget"]:
        return
    console.print(_budget(document))
    for line in _shared(document["shared_cores"]):
        console.print(line, soft_wrap=True, markup=False)
    console.print(_waits(document["waits"]))
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
    if frame_ms and document["nobodys_ms"] >= LEAST_SHARE * frame_ms:
        yield (
            f"other programs: {document['nobodys_ms']:.1f} of {frame_ms:.1f} ms a frame were nobody's of this run: a "
            "stage on the path had no core, and no job of this run had it"
        )
    yield from _efficiency(document)
    if document["failure"]:
        yield f"the run failed: {document['failure']}"
    for name, facts in document["accuracy"].items():
        if "psnr_db_by_band" in facts:
            bands = ", ".join(f"{band} {value:.1f}" for band, value in facts["psnr_db_by_band"].items())
            yield f"avatar {name}: PSNR on held-out views, dB: {bands} ({facts['source']})"
        else:
            yield f"avatar {name}: {facts.get('source', 'no figures')} of accuracy"


def _efficiency(document: Mapping[str, Any]) -> Iterator[str]:
    """What bounded the run, and what all cores did."""
    if bound := document.get("bound"):
        from trilane.apps.explain.reasons import bound_text

        yield f"bound: {bound_text(bound)}"
    if document["cores"]:
        numbers, efficiency = ",".join(map(str, document["cores"]["numbers"])), document["machine_efficiency"]
        cpu_ms, had_ms = document["cores"]["cpu_ms"], document["cores"]["had_ms"]
        yield (
            f"cores {numbers}: jobs had {cpu_ms:.2f} of {had_ms:.2f} ms of CPU time a frame, {efficiency:.0%}; the "
            f"fullest {document['core_efficiency']:.0%}; the slowest unit {document['efficiency']:.0%}"
        )


def _budget(document: Mapping[str, Any]) -> Table:
    """What bounded the frame time, by stage and cause."""
    from rich.table import Table

    table = Table(
        "stage (unit)",
        "what",
        "ms a frame",
        "share",
        title="What bounded the frame time",
        title_justify="left",
        caption=READ_SO,
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
    """Of each stage whose unit lacked a core for a noticeable time: who had it."""
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
        causes = ", ".join(f"{cause} {ms:.2f}" for cause, ms in row["causes_ms"].items() if ms >= 0.005)
        table.add_row(f"{row['stage']} ({row['unit']})", str(row["jobs"]), f"{row['wait_ms']:.2f}", causes or "-")
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
            f"{row['latency_ms']:.1f}",
            "\n".join([*row["notes"], *reasons]) or "hardly longer than the median",
        )
    return table
