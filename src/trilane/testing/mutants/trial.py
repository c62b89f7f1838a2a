"""One fault against the tests. Rule: noticed is a test that fails or never ends, and nothing of a trial outlives it."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

from trilane.testing.mutants.tree_copy import TreeCopy

#: A trial may take this many times as long as its tests took, and this long besides.
TIMES, BESIDES_S = 5.0, 60.0
NO_TESTS = 5
PYTEST = ("-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=no", "--timeout=60")


class Trial(NamedTuple):
    """`noticed_by`: the first test that failed, or how pytest ended; empty when all passed. `seconds`: of the wall."""

    noticed_by: str
    seconds: float


def run_tests(tree: TreeCopy, test_files: Sequence[str], usual_s: float) -> Trial:
    """Run the test files in this order until one fails. `usual_s`: how long they take without a fault."""
    begin = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, *PYTEST, *test_files],
        cwd=tree.root,
        env=tree.environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=TIMES * usual_s + BESIDES_S)
        noticed_by = _noticed_by(process.returncode, output)
    except subprocess.TimeoutExpired:
        noticed_by = "the tests did not end"
    finally:
        _end(process)
        tree.clean()
    return Trial(noticed_by, time.monotonic() - begin)


def _noticed_by(code: int, output: str) -> str:
    if code in (0, NO_TESTS):
        return ""
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    return failed[1] if failed else f"pytest ended with {code}"


def _end(process: subprocess.Popen[str]) -> None:
    """Whatever the trial has started is in its session."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
