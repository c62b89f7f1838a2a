"""The plugin that CI runs with: a skip that is not on the list fails the run, one that is does not."""

from __future__ import annotations

import pytest

from support.checks import Allowed, Skip, SkipList, load_allowed, not_allowed

ROW = Allowed("tests/*::test_video*", "no codec *", "a codec")


@pytest.mark.parametrize(
    ("skip", "is_allowed"),
    [
        (Skip("tests/core/test_a.py::test_video_is_read", "no codec x264"), True),
        (Skip("tests/core/test_a.py::test_video_is_read", "could not import 'av'"), False),
        (Skip("tests/core/test_a.py::test_audio", "no codec x264"), False),
    ],
)
def test_both_the_test_and_its_reason_must_match(skip: Skip, is_allowed: bool) -> None:
    assert not_allowed([skip], [ROW]) == ([] if is_allowed else [skip])


class Report:
    """What pytest reports of one test."""

    def __init__(self, reason: str) -> None:
        self.skipped, self.nodeid, self.longrepr = True, "tests/a.py::test_a", ("a.py", 1, f"Skipped: {reason}")


class Session:
    exitstatus = 0


@pytest.mark.parametrize(("reason", "status"), [("hard to do", 1), ("no gpu", 0)])
def test_an_unknown_skip_fails_a_run_that_passed(reason: str, status: int) -> None:
    plugin, session = SkipList([Allowed("*", "no gpu", "a GPU")]), Session()
    plugin.pytest_runtest_logreport(Report(reason))
    plugin.pytest_sessionfinish(session, 0)
    assert plugin.skips == [Skip("tests/a.py::test_a", reason)]
    assert session.exitstatus == status


def test_every_row_of_the_list_says_why() -> None:
    assert all(row.why and row.reason and row.test.startswith("tests/") for row in load_allowed())
