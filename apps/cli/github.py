"""What a gate tells GitHub: annotations on the log, and a summary in Markdown.

Rule: texts of files and names are escaped, so that none of them is a command to GitHub or Markdown. Annotations go to
stderr, which GitHub reads too, so that --json on stdout stays one document.

Sources of the formats: docs.github.com, "Workflow commands for GitHub Actions" and "Adding a job summary".
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from trilane.apps.cli.console import stderr_console
from trilane.apps.compare.gate import Judged, Outcome, whole
from trilane.errors import BadInputError
from trilane.writing import WRITABLE

SUMMARY: Final = "GITHUB_STEP_SUMMARY"
#: GitHub keeps at most 1 MiB of a step's summary.
MAX_SUMMARY_BYTES: Final = 1 << 20
LEVELS: Final = {Outcome.KEPT: "notice", Outcome.BROKEN: "error", Outcome.UNKNOWN: "warning"}


def write_to_github(judged: Sequence[Judged], verdict: str) -> None:
    """Write an annotation for each limit, and add a summary to the file that GITHUB_STEP_SUMMARY names, if any.

    Raises BadInputError for a file that cannot be written.
    """
    for each in judged:
        stderr_console().file.write(annotation(each) + "\n")
    if not (name := os.environ.get(SUMMARY)):
        return
    try:
        with Path(name).open("a", encoding="utf-8") as file:
            file.write(summary(judged, verdict))
    except OSError as error:
        raise BadInputError.of_os_error(f"{SUMMARY}={name}", error, WRITABLE) from None


def annotation(judged: Judged) -> str:
    """Return a workflow command, such as `::error title=slower=5%25 broken::infer takes longer`."""
    title = f"{judged.gate.text} {judged.outcome}"
    in_title = _escaped(title).replace(":", "%3A").replace(",", "%2C")
    return f"::{LEVELS[judged.outcome]} title={in_title}::{_escaped(f'{judged.name}: {judged.reason}')}"


def _escaped(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def summary(judged: Sequence[Judged], verdict: str) -> str:
    """Return the summary: the gate's outcome, the verdict on the runs, and a table with a row for each limit.

    It has as many rows as GitHub keeps.
    """
    rows = [
        f"| {_plain(each.name)} | {_plain(each.gate.text)} | {each.outcome} | {_plain(each.reason)} |\n"
        for each in judged
    ]
    text = f"### Trilane: {whole(judged)}\n\n{_plain(verdict)}\n\n| run | limit | outcome | why |\n|---|---|---|---|\n"
    for row in rows:
        if len((text + row).encode()) > MAX_SUMMARY_BYTES:
            break
        text += row
    return text + "\n"


def _plain(text: str) -> str:
    """Return `text` on one line, as Markdown that shows it as it is."""
    return re.sub(r"([\\`*_{}\[\]<>()#+!|~&])", r"\\\1", " ".join(text.split()))
