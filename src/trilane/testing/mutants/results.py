"""What came of every fault. Rule: survivors stand by name; those that change nothing are a list with a reason each."""

from __future__ import annotations

import json
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from trilane.testing.mutants.fault import Fault

IN_ALL, IN_EACH = 0.85, 0.80
#: Folders with fewer faults than this are not judged by themselves: one survivor would decide.
FEWEST = 5


@dataclass(frozen=True)
class Result:
    """`noticed_by`: a test, or how the tests ended; empty for a survivor. `tests`: how many test files were tried of
    the `reaching` ones that reach the line. `by_time`: a limit of time ended the trial. `control`: what the same tests
    did without the fault, `passed` or `failed`; empty where none was needed."""

    fault: Fault
    noticed_by: str
    seconds: float
    tests: int
    reaching: int
    by_time: bool = False
    control: str = ""

    @property
    def counts(self) -> bool:
        """Whether the trial says anything: its tests pass without the fault."""
        return self.control != "failed"


@dataclass(frozen=True)
class Unchanging:
    """A fault that changes nothing that anybody could see, and why; as it stands in unchanging.toml."""

    path: str
    before: str
    after: str
    reason: str

    def is_it(self, fault: Fault) -> bool:
        return (self.path, self.before, self.after) == (fault.path, fault.before, fault.after)


def load_unchanging(file: Path) -> list[Unchanging]:
    """Raises TypeError for a row with other keys."""
    return [Unchanging(**row) for row in tomllib.loads(file.read_text(encoding="utf-8")).get("fault", [])]


def append_result(file: Path, result: Result) -> None:
    """A line of JSON."""
    with file.open("a", encoding="utf-8") as lines:
        lines.write(json.dumps(asdict(result) | {"fault": result.fault._asdict()}) + "\n")


def load_results(file: Path) -> list[Result]:
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return [Result(**(row | {"fault": Fault(**row["fault"])})) for row in rows]


def table(results: Iterable[Result]) -> list[str]:
    """A line for each folder: noticed of tried, and the share. All results have to count."""
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    for result in results:
        for name in (result.fault.folder, "in all"):
            counts[name][0] += bool(result.noticed_by)
            counts[name][1] += 1
    order = sorted(counts, key=lambda name: (name == "in all", name))
    return [f"{name:14} {counts[name][0]:4} of {counts[name][1]:4}  {_share(*counts[name]):6.1%}" for name in order]


def controls_table(results: Sequence[Result]) -> list[str]:
    """How many trials a limit of time ended, how many controls there were, and the faults that count as not tried."""
    untried = [result for result in results if not result.counts]
    held = sum(result.control == "passed" for result in results)
    by_time = sum(result.by_time and result.counts for result in results)
    return [
        f"Noticed by a limit of time: {by_time}. Controls without the fault: {held} passed, {len(untried)} failed.",
        *(f"  not tried  {result.fault}: {result.noticed_by} fails without it too" for result in untried),
    ]


def fails(results: Sequence[Result]) -> list[str]:
    """The folders that notice too few. All results have to count."""
    by_folder: dict[str, list[Result]] = defaultdict(list)
    for result in results:
        by_folder[result.fault.folder].append(result)
    few = [
        name
        for name, rows in by_folder.items()
        if len(rows) >= FEWEST and _share(sum(bool(row.noticed_by) for row in rows), len(rows)) < IN_EACH
    ]
    noticed = sum(bool(row.noticed_by) for row in results)
    return [*sorted(few), *(["in all"] if _share(noticed, len(results)) < IN_ALL else [])]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 1.0
