"""The trial without the fault. Rule: what the same tests say without a fault is never counted as noticed.

A test that fails by itself now and then, or that a busy machine is too slow for, would else notice whatever is tried.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from trilane.testing.mutants.fault import Fault
from trilane.testing.mutants.tree_copy import TreeCopy
from trilane.testing.mutants.trial import Trial, run_tests

#: Elsewhere tests start processes and wait for them: what else runs on the machine can make them fail.
FEEL_NO_LOAD = "tests/core/"
MOST_TRIALS = 2
Runner = Callable[[TreeCopy, Sequence[str], float], Trial]


class Controls:
    """Trials with their controls; `run`: what runs the tests. One object serves several threads.

    A test file of `FEEL_NO_LOAD` that passes without a fault is taken to do so again. Every other trial that noticed
    its fault has a control of its own, and so has each that a limit of time ended.
    """

    def __init__(self, run: Runner = run_tests) -> None:
        self._run = run
        self._sound: set[str] = set()

    def tried(self, fault: Fault, tree: TreeCopy, test_files: Sequence[str], usual_s: float) -> tuple[Trial, str]:
        """The trial and what came of its control: `""` when none was needed, `passed` or `failed`.

        A control that fails is no answer, so both are repeated; `failed` is the last of `MOST_TRIALS`.
        """
        for _ in range(MOST_TRIALS):
            with tree.with_fault(fault):
                trial = self._run(tree, test_files, usual_s)
            control = self._control(trial, tree, test_files, usual_s)
            if control != "failed":
                break
        return trial, control

    def _control(self, trial: Trial, tree: TreeCopy, test_files: Sequence[str], usual_s: float) -> str:
        noticing = trial.noticed_by.partition("::")[0]
        if not noticing or (noticing in self._sound and not trial.by_time):
            return ""
        until = test_files.index(noticing) + 1 if noticing in test_files else len(test_files)
        if self._run(tree, test_files[:until], usual_s).noticed_by:
            return "failed"
        if noticing.startswith(FEEL_NO_LOAD):
            self._sound.add(noticing)
        return "passed"
