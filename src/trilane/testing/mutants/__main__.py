"""The command of `make mutants`. Rule: results are kept as they come, so that a run that is cut short loses none."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import islice
from pathlib import Path

from trilane import machine
from trilane.testing.mutants.control import Controls
from trilane.testing.mutants.draw import code_files, draw
from trilane.testing.mutants.fault import Fault
from trilane.testing.mutants.reach import Reach, digest_of, measure_reach
from trilane.testing.mutants.results import (
    Result,
    append_result,
    controls_table,
    fails,
    load_results,
    load_unchanging,
    table,
)
from trilane.testing.mutants.tree_copy import FreeCopies, TreeCopy, copied_tree, tracked_files

ROOT = Path(__file__).resolve().parents[4]
UNCHANGING = ROOT / "tests" / "unchanging.toml"
REACH = ROOT / ".venv" / "mutants-reach.json"
TESTS = ("tests/core/", "tests/conformance/", "tests/golden/", "tests/process/")
RESULTS = ROOT / ".venv" / "mutants.jsonl"


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="make mutants ARGS=…",
        description="Put small faults into a copy of the code, one at a time, and see which the tests notice.",
        epilog="Example: make mutants ARGS='--seed 3 --count 40 --only scheduler/ --only shaders/'",
    )
    parser.add_argument("--seed", type=int, default=1, help="the same seed draws the same faults [1]")
    parser.add_argument("--count", type=int, default=400, help="how many faults [400]")
    parser.add_argument("--minutes", type=float, default=120.0, help="begin no trial later than this [120]")
    parser.add_argument("--seconds", type=float, default=60.0, help="tests run for one fault, quickest first [60]")
    parser.add_argument("--workers", type=int, default=machine.here.core_count(), help="trials at a time [the cores]")
    parser.add_argument("--only", action="append", default=[], metavar="PREFIX", help="only files that begin so; often")
    parser.add_argument("--tests", action="append", metavar="PREFIX", help="only tests that begin so; often [all]")
    parser.add_argument(
        "--again",
        type=Path,
        metavar="FILE",
        help="instead of drawing: what these results have as survived or not tried",
    )
    parser.add_argument("--list", action="store_true", help="print the faults and try none")
    parser.add_argument("--reach", type=Path, default=REACH, help="where to keep which tests reach which lines")
    parser.add_argument("--out", type=Path, default=RESULTS, help="results, a line of JSON each, written anew")
    return parser.parse_args(words)


def main() -> int:
    options = arguments()
    tracked = tracked_files(ROOT)
    sources = [path for path in code_files(tracked) if not options.only or path.startswith(tuple(options.only))]
    faults = _faults(options, sources)
    if options.list:
        print(*faults, sep="\n")
        return 0
    options.out.parent.mkdir(exist_ok=True)
    options.out.write_text("", encoding="utf-8")
    with ExitStack() as stack:
        trees = [stack.enter_context(copied_tree(ROOT, tracked)) for _ in range(options.workers)]
        tests = [
            path
            for path in tracked
            if path.startswith(tuple(options.tests or TESTS)) and Path(path).name.startswith("test_")
        ]
        reach = measure_reach(trees, tests, code_files(tracked), options.reach, _say)
        results = list(_tried(options, faults, reach, trees))
    return _report(results, len(faults))


def _faults(options: argparse.Namespace, sources: Sequence[str]) -> list[Fault]:
    unchanging = load_unchanging(UNCHANGING)
    drawn: Iterable[Fault] = draw(ROOT, sources, options.seed)
    if options.again:
        left = [result.fault for result in load_results(options.again) if not (result.noticed_by and result.counts)]
        drawn = [fault for fault in left if fault.still_fits((ROOT / fault.path).read_text(encoding="utf-8"))]
        _say(f"{len(left)} survivors and untried, {len(left) - len(drawn)} of them in lines that are no longer there")
    return list(islice((fault for fault in drawn if not any(row.is_it(fault) for row in unchanging)), options.count))


def _tried(
    options: argparse.Namespace, faults: Sequence[Fault], reach: Reach, trees: Sequence[TreeCopy]
) -> Iterator[Result]:
    """Results in the order of the faults; as many trials at a time as there are copies."""
    free = FreeCopies(trees)
    end = time.monotonic() + 60 * options.minutes
    controls = Controls()

    def one(fault: Fault) -> Result | None:
        if time.monotonic() > end:
            return None
        with free.taken() as tree:
            return _try(fault, reach, tree, options.seconds, controls)

    with ThreadPoolExecutor(len(trees)) as pool:
        for number, result in enumerate(pool.map(one, faults), start=1):
            if result is not None:
                append_result(options.out, result)
                _say(f"{number} of {len(faults)}, {result.seconds:.0f} s: {result.fault}: {_word(result)}")
                yield result


def _word(result: Result) -> str:
    if not result.counts:
        return f"NOT TRIED: {result.noticed_by} fails without the fault too"
    return f"noticed by {result.noticed_by}" if result.noticed_by else f"SURVIVED {result.tests} test files"


def _try(fault: Fault, reach: Reach, tree: TreeCopy, most_s: float, controls: Controls) -> Result:
    reaching = reach.tests_of(fault, digest_of(tree.root / fault.path))
    chosen, usual_s = reach.within(reaching, most_s)
    if not chosen:
        return Result(fault, "", 0.0, 0, 0)
    trial, control = controls.tried(fault, tree, chosen, usual_s)
    seconds = round(trial.seconds, 1)
    return Result(fault, trial.noticed_by, seconds, len(chosen), len(reaching), trial.by_time, control)


def _report(results: Sequence[Result], drawn: int) -> int:
    trials = [result for result in results if result.counts]
    print(*table(trials), sep="\n")
    print(*controls_table(results), sep="\n")
    survivors = [result for result in trials if not result.noticed_by]
    if survivors:
        print(f"\nSurvivors ({len(survivors)}); the test files tried, of those that reach the line:")
        print(*(f"  {result.tests} of {result.reaching}  {result.fault}" for result in survivors), sep="\n")
    if len(results) < drawn:
        print(f"\nThe time was up: {len(results)} of {drawn} tried.")
    few = fails(trials)
    if few:
        print(f"\nToo few noticed: {', '.join(few)}")
    return 1 if few else 0


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
