"""A pytest plugin for CI: a skipped test has to be on the list. Rule: every test runs, or somebody wrote why not.

Use: `pytest -p trilane.testing.skips`. The list is tests/allowed-skips.toml: `[[skip]]` with `test`, a pattern of test
names as pytest prints them, and `reason`, a pattern of what it says; both as a shell writes them.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

LIST = Path(__file__).resolve().parents[3] / "tests" / "allowed-skips.toml"


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
    config.pluginmanager.register(SkipList(load_allowed()), "trilane-skip-list")
