"""What every command writes with: data on stdout, messages on stderr, JSON as one document.

Rule: nothing but a command's result goes to stdout, so that `trilane ... --json | jq` always works.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else there.")]


def stderr_console() -> Console:
    """Console for messages and progress. Rich obeys NO_COLOR and plain pipes by itself."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def stdout_console() -> Console:
    """Console for results that a person reads. A pipe gets 120 columns, so that tables are not cut."""
    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else 120)


@contextmanager
def stdout_kept() -> Iterator[None]:
    """Within it, what libraries write to file descriptor 1 goes to stderr: it is no result."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def print_json(document: Mapping[str, Any]) -> None:
    """Print `document` as JSON on stdout. Raises ValueError for NaN and infinities, which JSON has not."""
    sys.stdout.write(json.dumps(document, indent=1, allow_nan=False) + "\n")
    sys.stdout.flush()
