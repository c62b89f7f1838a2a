"""The window into a run: the newest picture out, the steering in, between two mappings of the same memory."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest

from trilane.transport import live_window
from trilane.transport.live_window import LOOKED_NS, LiveWindow, Steering, create_window, path_of

HEIGHT, WIDTH = 4, 6


@pytest.fixture
def ends() -> Iterator[tuple[LiveWindow, LiveWindow]]:
    """Who looks, and the run."""
    fd = create_window(HEIGHT, WIDTH)
    yield LiveWindow(fd, HEIGHT, WIDTH), LiveWindow.opened(path_of(fd), HEIGHT, WIDTH)
    os.close(fd)


def picture(value: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), value, np.uint8)


def test_the_newest_picture_is_seen_once(ends: tuple[LiveWindow, LiveWindow]) -> None:
    looker, run = ends
    assert looker.newest(-1) is None
    for frame in range(7):
        run.show(frame, frame / 30, 1000 + frame, picture(frame))
    seen = looker.newest(-1)
    assert seen is not None and (seen.frame, seen.media_s, seen.sampled_ns) == (6, 0.2, 1006)
    assert (seen.pixels == 6).all() and seen.pixels.shape == (HEIGHT, WIDTH, 3)
    assert looker.newest(6) is None
    run.show(7, 0.25, 1007, picture(7))
    assert (seen.pixels == 6).all()  # it is the looker's own
    assert looker.newest(6) is not None


def test_a_picture_that_changes_while_it_is_read_is_not_shown(
    ends: tuple[LiveWindow, LiveWindow], monkeypatch: pytest.MonkeyPatch
) -> None:
    looker, run = ends
    run.show(0, 0.0, 0, picture(1))
    times = iter(range(1, 100))

    class Torn(np.ndarray):
        """Two newer pictures come while a buffer is copied."""

        def copy(self, order: str = "K") -> np.ndarray:  # type: ignore[override]  # noqa: ARG002
            half = np.array(self)
            for _ in range(2):
                frame = next(times)
                run.show(frame, 0.0, 0, picture(frame))
            return half

    monkeypatch.setattr(looker, "_pixels", looker._pixels.view(Torn))
    assert looker.newest(-1) is None
    monkeypatch.undo()
    seen = looker.newest(-1)
    assert seen is not None and (seen.pixels == seen.frame).all()


def test_a_run_whose_presenting_unit_was_killed_while_it_wrote_goes_on(ends: tuple[LiveWindow, LiveWindow]) -> None:
    looker, run = ends
    run.show(5, 0.0, 0, picture(5))
    run._head["number"][0, 1 - int(run._head["newest"][0])] = live_window.CLOSED
    seen = looker.newest(-1)
    assert seen is not None and seen.frame == 5
    run.show(6, 0.0, 0, picture(6))
    run.show(7, 0.0, 0, picture(7))
    seen = looker.newest(-1)
    assert seen is not None and seen.frame == 7 and (seen.pixels == 7).all()


def test_pictures_are_wanted_for_a_while_after_a_look(
    ends: tuple[LiveWindow, LiveWindow], monkeypatch: pytest.MonkeyPatch
) -> None:
    looker, run = ends
    now_ns = 10 * LOOKED_NS
    monkeypatch.setattr(live_window.time, "monotonic_ns", lambda: now_ns)
    assert not run.is_looked_at
    looker.look()
    assert run.is_looked_at
    now_ns += LOOKED_NS - 1
    assert run.is_looked_at
    now_ns += 1
    assert not run.is_looked_at


def test_the_camera_is_steered(ends: tuple[LiveWindow, LiveWindow]) -> None:
    looker, run = ends
    assert run.steering == Steering(0.0, 0.0, 1.0)
    looker.steer(Steering(10.0, -5.0, 2.5))
    assert run.steering == Steering(10.0, -5.0, 2.5)


def test_a_window_is_not_mapped_for_larger_pictures(ends: tuple[LiveWindow, LiveWindow]) -> None:  # noqa: ARG001
    fd = create_window(HEIGHT, WIDTH)
    with pytest.raises(ValueError, match="a window of"):
        LiveWindow(fd, 100, 100)
    os.close(fd)
