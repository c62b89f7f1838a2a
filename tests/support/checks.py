"""Style, types and tests in one piece. Rule: every check runs, whatever failed; the last line names each failure.

Use: `python tests/support/checks.py [--slow | --rest]`, as `make test`, `make test-all` and `make test-rest` call it.
The file is also the pytest plugin that tells the runner what failed and what was skipped (`-p support.checks`). With
`--listed-skips` a test that is skipped has to be on tests/allowed-skips.toml: `[[skip]]` with `test`, a pattern of test
names as pytest prints them, and `reason`, a pattern of what it says, both as a shell writes them.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any, Final, NamedTuple

import pytest

BIN = Path(sys.executable).parent
TESTS = Path(__file__).resolve().parents[1]
STYLE = (["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"])
#: Tests share the cores, a file of them on one worker. Files that wait the longest come first, small ones at the end.
FOLDERS = ("process", "conformance", "golden", "core")
#: No worker takes the place of one that died: with `loadfile` it meets the same test again, and pytest never ends.
WORKERS = ("--numprocesses", "auto", "--dist", "loadfile", "--max-worker-restart", "0")
#: A worker has one core. OpenMP takes all in each, and its threads wait for one another where another worker computes.
ONE_CORE = {"OMP_NUM_THREADS": "1"}
GROUPS = ([*WORKERS, *(f"tests/{folder}" for folder in FOLDERS)],)
#: Beside the packages that decide what is skipped: the tests that `make test` skipped here, for `make test-rest`.
SKIPPED = Path(sys.prefix) / "skipped-tests.txt"
INTERRUPTED = 130
LIST = TESTS / "allowed-skips.toml"


#: Tests that this process's pytest was to run.
COLLECTED: Final = pytest.StashKey[set[str]]()


class Outcome(NamedTuple):
    """What one check found. `complete`: no test was left without an answer."""

    failures: list[str]
    passed: int = 0
    skipped: tuple[str, ...] = ()
    complete: bool = True


def said(outcomes: Sequence[Outcome], seconds: float) -> str:
    """The last line: the failures by name, or that there are none."""
    failures = [failure for outcome in outcomes for failure in outcome.failures]
    passed, skipped = sum(outcome.passed for outcome in outcomes), sum(len(outcome.skipped) for outcome in outcomes)
    counts = f"{passed} tests passed, {skipped} skipped, in {int(seconds // 60)} min {int(seconds % 60)} s"
    if not failures:
        return f"no failures: {len(outcomes)} checks, {counts}"
    return f"{len(failures)} failure{'s' * (len(failures) > 1)} ({counts}): {'; '.join(failures)}"


def check_style(command: Sequence[str]) -> Outcome:
    """Runs a tool; what it says goes to this process's output."""
    done = subprocess.run([BIN / command[0], *command[1:]], check=False)
    return Outcome([" ".join(command)] if done.returncode else [])


def check_tests(arguments: Sequence[str], told: Path) -> Outcome:
    """Runs pytest with `arguments`. `told`: a file for what the plugin tells."""
    told.unlink(missing_ok=True)
    command = [
        str(BIN / "pytest"),
        "-p",
        "support.checks",
        f"--tell={told}",
        "--continue-on-collection-errors",
        *arguments,
    ]
    path = os.pathsep.join(filter(None, (str(TESTS), os.environ.get("PYTHONPATH"))))
    code = subprocess.run(command, env={**ONE_CORE, **os.environ, "PYTHONPATH": path}, check=False).returncode
    if not told.is_file():
        return Outcome([f"pytest {' '.join(arguments)} (exit code {code}, nothing told)"], complete=False)
    found = json.loads(told.read_text(encoding="utf-8"))
    told.unlink()
    failures = [*found["failed"]]
    if code and not failures:
        failures = [f"pytest {' '.join(arguments)} (exit code {code})"]
    return Outcome(failures, found["passed"], tuple(found["skipped"]), not found["missing"])


def main(words: Sequence[str]) -> int:
    """The exit code: 0 where every check passed, 130 after Ctrl-C, else 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slow", action="store_true", help="run slow tests too, and refuse skips that are not listed")
    parser.add_argument("--rest", action="store_true", help="run only slow tests and those that the last run skipped")
    asked = parser.parse_args(words)
    begin_s = time.monotonic()
    told = SKIPPED.with_suffix(".json")
    extra = ["--slow", "--listed-skips"] if asked.slow or asked.rest else []
    if asked.rest:
        if not SKIPPED.is_file():
            parser.error("nothing says what `make test` skipped here: run it first")
        extra.append(f"--only-rest={SKIPPED}")
    checks = [] if asked.rest else [partial(check_style, command) for command in STYLE]
    checks += [partial(check_tests, [*extra, *group], told) for group in GROUPS]
    with interrupts() as interrupt:
        outcomes = list(outcomes_of(checks, interrupt))
    if not (asked.slow or asked.rest or interrupt.is_set()) and all(outcome.complete for outcome in outcomes):
        lines = (f"{test}\n" for outcome in outcomes for test in outcome.skipped)
        SKIPPED.write_text("".join(lines), encoding="utf-8")
    line = said(outcomes, time.monotonic() - begin_s)
    if interrupt.is_set():
        print(f"interrupted; {line}", flush=True)
        return INTERRUPTED
    print(line, flush=True)
    return int(any(outcome.failures for outcome in outcomes))


def outcomes_of(checks: Sequence[Callable[[], Outcome]], interrupt: Event) -> Iterator[Outcome]:
    """Those of the checks until the interrupt, and what one that it ended has told."""
    with suppress(KeyboardInterrupt):
        for check in checks:
            outcome = check()
            if not interrupt.is_set() or outcome.passed or not outcome.complete:
                yield outcome
            if interrupt.is_set():
                return


@contextmanager
def interrupts() -> Iterator[Event]:
    """Set by the first Ctrl-C, which ends the check that runs and lets it tell what it knows; the second kills it."""
    interrupt = Event()

    def interrupted(*_: object) -> None:
        if interrupt.is_set():
            raise KeyboardInterrupt
        interrupt.set()

    before = signal.signal(signal.SIGINT, interrupted)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, before)


def pytest_addoption(parser: Any) -> None:
    parser.addoption("--tell", type=Path, help="a JSON file for what failed, how many passed, and what was skipped")
    parser.addoption("--listed-skips", action="store_true", help="fail for a skip that tests/allowed-skips.toml lacks")
    parser.addoption("--only-rest", type=Path, help="only slow tests and those that this file names, one in a line")


def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    """With `--only-rest`, leave out what `make test` has run. A file that was skipped whole is named without a test."""
    file = config.getoption("--only-rest")
    if file is None:
        return
    named = set(file.read_text(encoding="utf-8").splitlines())
    done = [
        item
        for item in items
        if item.get_closest_marker("slow") is None
        and item.nodeid not in named
        and item.nodeid.partition("::")[0] not in named
    ]
    config.hook.pytest_deselected(items=done)
    items[:] = [item for item in items if item not in set(done)]


def pytest_collection_finish(session: Any) -> None:
    session.config.stash[COLLECTED] = {item.nodeid for item in session.items}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any, ids: Sequence[str]) -> None:
    node.config.stash[COLLECTED] = set(ids)


def pytest_terminal_summary(terminalreporter: Any, config: Any) -> None:
    file = config.getoption("--tell")
    if file is None:
        return
    stats = terminalreporter.stats

    def names(*kinds: str) -> list[str]:
        return list(dict.fromkeys(report.nodeid for kind in kinds for report in stats.get(kind, ())))

    done = names("passed", "failed", "error", "skipped", "xfailed", "xpassed")
    missing = len(config.stash.get(COLLECTED, set()).difference(done))
    not_run = [f"{missing} test{'s' * (missing > 1)} not run"] if missing else []
    failed = names("failed", "error") + not_run
    told = {"failed": failed, "skipped": names("skipped"), "passed": len(stats.get("passed", ())), "missing": missing}
    file.write_text(json.dumps(told), encoding="utf-8")


@dataclass(frozen=True)
class Allowed:
    """`why`: what the test needs that CI does not have."""

    test: str
    reason: str
    why: str


@dataclass(frozen=True)
class Skip:
    """One test that was skipped, or a file that could not be collected without a part."""

    test: str
    reason: str

    def __str__(self) -> str:
        return f"{self.test}: {self.reason}"


def load_allowed(file: Path = LIST) -> list[Allowed]:
    """Raises TypeError for a row with other keys."""
    return [Allowed(**row) for row in tomllib.loads(file.read_text(encoding="utf-8")).get("skip", [])]


def not_allowed(skips: Iterable[Skip], allowed: Iterable[Allowed]) -> list[Skip]:
    """The skips that no row covers."""
    rows = list(allowed)
    return [
        skip
        for skip in skips
        if not any(fnmatchcase(skip.test, row.test) and fnmatchcase(skip.reason, row.reason) for row in rows)
    ]


class SkipList:
    """Collects what is skipped, and fails the run for what is not on the list."""

    def __init__(self, allowed: list[Allowed]) -> None:
        self._allowed = allowed
        self.skips: list[Skip] = []

    def _note(self, report: Any) -> None:
        if report.skipped and not hasattr(report, "wasxfail"):
            _, _, reason = report.longrepr
            self.skips.append(Skip(report.nodeid, reason.removeprefix("Skipped: ")))

    pytest_runtest_logreport = _note
    pytest_collectreport = _note

    def pytest_sessionfinish(self, session: Any, exitstatus: int) -> None:
        if exitstatus == 0 and not_allowed(self.skips, self._allowed):
            session.exitstatus = 1

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        terminalreporter.section("skips and the list of those that CI allows")
        unknown = not_allowed(self.skips, self._allowed)
        terminalreporter.line(f"{len(self.skips)} skipped, {len(unknown)} of them not on {LIST.name}")
        for skip in unknown:
            terminalreporter.line(f"not on the list: {skip}")


def pytest_configure(config: Any) -> None:
    if config.getoption("--listed-skips"):
        config.pluginmanager.register(SkipList(load_allowed()), "trilane-skip-list")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
