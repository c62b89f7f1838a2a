"""The tests of one fault, with it and without. Rule: one limit of time holds for both, and nothing outlives them."""

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
#: How pytest, pytest-timeout, subprocess, queues and sockets name the end of a limit.
OF_TIME = r"(?i)time-?out|timed out|did not (?:end|answer|come)"
PYTEST = ("-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=no", "--timeout=60")


class Trial(NamedTuple):
    """`noticed_by`: the first test that failed, or how pytest ended; empty when all passed. `by_time`: whether it was a
    limit of time that ended it, of pytest or of the test itself. `seconds`: of the wall."""

    noticed_by: str
    by_time: bool
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
        noticed_by, by_time = noticed(process.returncode, output)
    except subprocess.TimeoutExpired:
        noticed_by, by_time = "the tests did not end", True
    finally:
        _end(process)
        tree.clean()
    return Trial(noticed_by, by_time, time.monotonic() - begin)


def noticed(code: int, output: str) -> tuple[str, bool]:
    """(what noticed the fault, whether a limit of time did) from pytest's exit code and what it printed."""
    if code in (0, NO_TESTS):
        return "", False
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)(.*)", output, re.MULTILINE)
    if failed:
        return failed[1], bool(re.search(OF_TIME, failed[2]))
    return f"pytest ended with {code}", bool(re.search(OF_TIME, output))


def _end(process: subprocess.Popen[str]) -> None:
    """Whatever the trial has started is in its session."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
