"""What benches ask of OpenGL and of the queue of requests, call by call."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.bench.lib import gpu_buffering, load
from trilane.bench.lib.gpu_buffering import READBACKS, UPLOADS
from trilane.bench.lib.load import Load, Queries, bound_ms, queries_needed, tail, verdict
from trilane.errors import TrilaneError


class Noted:
    """A buffer or framebuffer that notes what is done to it under its name."""

    def __init__(self, log: list[Any], name: str) -> None:
        self._log, self._name = log, name

    def __repr__(self) -> str:
        return self._name

    def __getattr__(self, what: str) -> Any:
        return lambda *asked, **options: self._log.append((self._name, what, *asked, options))


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What is done, fences included, which are numbered from 1."""
    done: list[Any] = []

    def fence() -> int:
        done.append("fence")
        return done.count("fence")

    monkeypatch.setattr(
        gpu_buffering, "opengl", SimpleNamespace(fence=fence, wait_fence=lambda n: done.append(("wait", n)))
    )
    return done


def context(log: list[Any]) -> Any:
    made: list[Noted] = []

    def buffer(reserve: int) -> Noted:
        assert reserve == 160
        made.append(Noted(log, f"buffer {len(made)}"))
        return made[-1]

    return SimpleNamespace(buffer=buffer, made=made)


BOX = (0, 0, 4, 2)
READ = {"components": 3, "dtype": "u4", "alignment": 1}


@pytest.mark.parametrize(
    ("name", "buffers", "lag"), [("direct", 0, 0), ("pbo", 1, 0), ("pbo-orphan", 1, 0), ("pbo-ring", 3, 2)]
)
def test_a_readback_by_its_calls(log: list[Any], name: str, buffers: int, lag: int) -> None:
    """Four frames: those of the ring are copied when their buffer is needed again, each after its own fence."""
    ctx = context(log)
    way, target = READBACKS[name](ctx, 160), Noted(log, "target")
    tensors = [np.zeros(10 + n, np.uint8) for n in range(4)]
    expected: list[Any] = []

    def copied(n: int, buffer: Noted) -> Any:
        return (f"{buffer}", "read_into", n, {"size": 10 + n})

    for n, tensor in enumerate(tensors):
        way.submit(target, BOX, 3, tensor)
        if name == "direct":
            expected += [("target", "read_into", n, BOX, READ)]
        elif name == "pbo-ring":
            expected += [("target", "read_into", f"{ctx.made[n % 3]}", BOX, READ), "fence"]
            if n >= 2:
                expected += [("wait", n - 1), copied(n - 2, ctx.made[n - 2])]
        else:
            expected += [("buffer 0", "orphan", {})] * (name == "pbo-orphan")
            expected += [("target", "read_into", "buffer 0", BOX, READ), copied(n, ctx.made[0])]
    way.drain()
    if name == "pbo-ring":
        expected += [("wait", 3), copied(2, ctx.made[2]), ("wait", 4), copied(3, ctx.made[0])]
    named = {id(tensor): n for n, tensor in enumerate(tensors)}

    def plain(entry: Any) -> Any:
        if not isinstance(entry, tuple):
            return entry
        return tuple(named.get(id(part), f"{part}" if isinstance(part, Noted) else part) for part in entry)

    assert [plain(entry) for entry in log] == expected
    assert (len(ctx.made), way.lag) == (buffers, lag)


@pytest.mark.parametrize(("name", "buffers"), [("sub", 0), ("orphan", 1), ("ring", 3)])
def test_an_upload_by_its_calls(log: list[Any], name: str, buffers: int) -> None:
    """Four images: the fourth waits for the fence of the first, whose buffer it takes."""
    ctx = context(log)
    way, texture, image = UPLOADS[name](ctx, 160), Noted(log, "texture"), b"image"
    for _ in range(4):
        way.write(texture, image)  # type: ignore[arg-type]
    expected: list[Any] = []
    for n in range(4):
        if name == "sub":
            expected += [("texture", "write", image, {"alignment": 1})]
            continue
        place = n % 3 if name == "ring" else 0
        expected += [("buffer 0", "orphan", {})] if name == "orphan" else [("wait", 1)] * (n == 3)
        expected += [(f"buffer {place}", "write", image, {}), ("texture", "write", ctx.made[place], {"alignment": 1})]
        expected += ["fence"] * (name == "ring")
    assert log == expected and len(ctx.made) == buffers


class Condition:
    """Stands for a condition: `wait` answers what is told, and notes how long it would wait."""

    def __init__(self, *answers: bool) -> None:
        self._answers, self.waited, self.notified = [*answers], [], 0

    def __enter__(self) -> Condition:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to let go."""

    def wait(self, seconds: float) -> bool:
        self.waited.append(seconds)
        return self._answers.pop(0)

    def notify_all(self) -> None:
        self.notified += 1


def test_whoever_waits_is_told_of_every_answer_and_of_the_end() -> None:
    condition: Any = Condition(True, False)
    queries = Queries(size=2, changed=condition, asked_s=[1.0])
    queries.answered(0)
    assert condition.notified == 0
    queries.answered(1)
    assert condition.notified == 1
    queries.wait()
    assert condition.waited == []
    queries.asked_s.append(2.0)
    with pytest.raises(TrilaneError, match=r"^no query was answered for 60 s$"):
        queries.wait()
    assert condition.waited == [60.0, 60.0]
    queries.unanswered({"a:late": 2, "b": 1})
    assert condition.notified == 2 and queries.over
    cause = (
        r"^frames of queries were dropped or lost \(a:late 2, b 1\), and every query must be answered: single, double"
    )
    with pytest.raises(TrilaneError, match=cause):
        queries.wait()


def test_a_server_stops_asking_when_the_run_is_over_and_waits_for_each_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaps of 2 s on a clock that stands at 10: 12, 14, 16, but the run ends after the second query."""
    slept: list[float] = []
    monkeypatch.setattr(load, "time", SimpleNamespace(monotonic=lambda: 13.0 if slept else 10.0, sleep=slept.append))
    seeds: list[int] = []
    monkeypatch.setattr(
        load.random, "Random", lambda seed: seeds.append(seed) or SimpleNamespace(expovariate=lambda rate: rate / 2)
    )
    queries, asked = Queries(), []

    def request(count: int) -> None:
        asked.append(count)
        queries.over = len(asked) == 2

    load._poisson(Load("server", 1.0, rate=4.0, seed=9), SimpleNamespace(request=request), queries)  # type: ignore[arg-type]
    assert (slept, asked, seeds) == ([2.0, 1.0], [1, 1], [9])


def test_verdicts_in_words() -> None:
    """At the limit is in time. 662 queries of a server may be late once, and two late ones are too many."""
    server = Load("server", seconds=2.0, limit_ms=100.0)
    assert verdict(server, [100.0] * 661 + [101.0], 2.0) == []
    late = verdict(server, [100.0] * 660 + [101.0, 102.0], 1.94)
    words = "2 of 662 queries took longer than 100 ms, too many for 99 % within it"
    assert late == ["it lasted 1.9 s, expected 2 s", words]
    assert verdict(server, [500.0] * 661, 2.0) == ["661 queries, expected 662 for the 99th percentile"]
    assert verdict(Load("offline", 1.0, limit_ms=1.0), [500.0] * 64, 1.0) == []


def test_queries_that_are_needed_are_the_least_that_are_enough() -> None:
    for percentile, late in ((0.9, 1), (0.9, 2), (0.9, 5), (0.99, 1), (0.5, 1)):
        needed = queries_needed(percentile, late)
        assert tail(needed, late, 1 - percentile) <= 0.01 + 1e-12 < tail(needed - 1, late, 1 - percentile)
    assert tail(1, 5, 0.5) == 1.0
    for count in (63, 64, 88, 89, 90, 112, 200):
        latencies = [float((7 * n) % count) for n in range(count)] if count % 7 else [float(n) for n in range(count)]
        late = max((k for k in range(1, 40) if queries_needed(0.9, k) <= count), default=0)
        assert bound_ms(latencies, 0.9) == (count - late if late else None)
