"""The journal gives back what was added, as it grows and after; whatever else is in the file is refused by name."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgpack
import pytest

from trilane.errors import BadInputError, UnwrittenError
from trilane.hw_profiles.application import application_graph
from trilane.pipeline.journal import (
    MAX_ENTRIES,
    SCHEMA,
    Accounted,
    Begun,
    Counted,
    Ended,
    JournalReader,
    JournalWriter,
    Record,
    Said,
    Sampled,
    Stepped,
    Stopped,
    Worked,
    config_of,
    journal_of,
    read_journal,
)
from trilane.pipeline.journal_values import RunValues
from trilane.pipeline.timeline import Span, Timeline
from trilane.pipeline.unit_history import UNEXPLAINED, IdleSlice
from trilane.scheduler.events import Dispatch, Finish, Job, JobDone, Outcome, OutcomeKind, Settings, UnitReady, chain
from trilane.scheduler.ledger import ASSIGNED, JobRecord
from trilane.scheduler.virtual import Simulation, simulate
from trilane.unexpected_value import UnexpectedValue

SETTINGS = Settings(3, period_ns=9, works=(1000, 500), follow=("infer",))
BEGUN = Begun(SCHEMA, application_graph(), SETTINGS, {"clock": "host"})
REST: tuple[Record, ...] = (
    Stepped(5, (UnitReady("cpu"),), (Dispatch(Job(0, "cpu", "pose", 0, -1, 0, 0, fresh=True, rung=1)),)),
    Accounted(5, "gpu", 1),
    Stepped(9, (JobDone("cpu", 0, 6, 8, 6, skips=True),), (Finish(Outcome(OutcomeKind.GAVE_UP, "gpu")),)),
    Worked(JobRecord("pose", "cpu", 0, 5, 5, 6, 8, preempted_ns=1), {"visible": 1.0}),
    Counted(9, {"died:gpu": 1}, {"raster->infer:stale": 2}),
    Sampled(9, {"temperature_c.device": 31.5}),
    Said(9, "unit gpu could not be kept alive"),
    Stopped(9, "dsp"),
    Ended(9, {"fps": 0.0, "frames": {"presented": 1}}),
)


def _write(path: Path, records: Sequence[Record]) -> Path:
    with JournalWriter(path) as journal:
        for record in records:
            journal.add(record)
    return path


def test_what_was_added_is_read(tmp_path: Path) -> None:
    assert list(read_journal(_write(tmp_path / "j", (BEGUN, *REST)))) == [BEGUN, *REST]


def test_a_reader_follows_a_file_that_grows_by_single_bytes(tmp_path: Path) -> None:
    whole = _write(tmp_path / "whole", (BEGUN, *REST)).read_bytes()
    reader, seen = JournalReader(tmp_path / "growing"), []
    with (tmp_path / "growing").open("wb", buffering=0) as file:
        for place in range(len(whole)):
            file.write(whole[place : place + 1])
            seen.append(list(reader.new()))
    assert [record for records in seen for record in records] == [BEGUN, *REST]
    assert max(map(len, seen)) == 1


def test_only_flushed_records_are_seen_while_it_is_written(tmp_path: Path) -> None:
    with JournalWriter(tmp_path / "j") as journal:
        reader = JournalReader(tmp_path / "j")
        journal.add(BEGUN)
        assert list(reader.new()) == []
        journal.flush()
        assert list(reader.new()) == [BEGUN]
    with pytest.raises(BadInputError, match="no such file"):
        list(JournalReader(tmp_path / "none").new())


def test_a_record_cut_off_at_the_end_is_left_out(tmp_path: Path) -> None:
    path = _write(tmp_path / "j", (BEGUN, *REST))
    path.write_bytes(path.read_bytes()[:-1])
    assert list(read_journal(path)) == [BEGUN, *REST[:-1]]


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "an empty file"),
        (msgpack.packb([0, 99])[:1], "no record"),
        (b"\xc1", "record 1: found bytes that are no MessagePack"),
        (msgpack.packb([1, 5, [], []]), "a record before the header"),
        (msgpack.packb([0, 99, {}, {}, {}]), "schema 99"),
        (None, "no such file"),
        (msgpack.packb([7, 5]), "before the header"),
        (msgpack.packb([-1, 5, {}]), r"\(-1, 5"),
        (msgpack.packb(3), "record 1: found 3, expected one of Begun"),
        (msgpack.packb([{}] * (MAX_ENTRIES + 1)), "a list of more than 16384"),
        (msgpack.packb([[{}] * MAX_ENTRIES] * 200), "more than 1048576 bytes"),
    ],
)
def test_what_is_no_journal_is_refused(tmp_path: Path, content: bytes | None, found: str) -> None:
    path = tmp_path / "j"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(BadInputError, match=found):
        list(read_journal(path))


JOB = ("pose", "cpu", 0, 5, 5, 6, 8, 0, 0, 0)


@pytest.mark.parametrize(
    ("row", "found"),
    [
        ([1, 5, [["Burn"]], []], "'Burn'"),
        ([1, 3, [], []], "time 3 of a step"),
        ([1, 9, [["UnitReady", "npu"]], []], "unit 'npu'"),
        ([2, 9, "npu", 1], "unit 'npu'"),
        ([2, 9, "gpu", 7], "account 7"),
        ([3, ["own", *JOB[1:]], {}], "stage 'own'"),
        ([3, [["pose"], *JOB[1:]], {}], "job"),
        ([3, [*JOB[:5], float("nan"), *JOB[6:]], {}], "job"),
        ([3, [*JOB[:6], -5, *JOB[7:]], {}], "times from 0 to its end"),
        ([3, JOB, {}], "no job comes twice"),
        ([3, JOB[:9], {}], "job"),
        ([3, [*JOB[:2], 1, *JOB[3:]], {"visible": "x"}], "numbers by name"),
        ([4, 9, {"died:gpu": -1}, {}], "whole numbers"),
        ([5, 9, {"duty.gpu": float("inf")}], "finite"),
        ([6, -1, "text"], "time -1"),
        ([6, 9, 3], "text 3"),
        ([7, 5], "Ended with now_ns, report"),
    ],
)
def test_a_record_with_a_strange_value_is_refused_by_its_number(tmp_path: Path, row: list[object], found: str) -> None:
    path = _write(tmp_path / "j", (BEGUN, *REST[:1], Worked(JobRecord(*JOB), {})))
    with path.open("ab") as file:
        file.write(msgpack.packb(row))
    with pytest.raises(BadInputError, match=f"j, record 4: found .*{found}"):
        list(read_journal(path))


def test_no_journal_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "j").touch()
    with pytest.raises(FileExistsError):
        JournalWriter(tmp_path / "j")


def test_a_disk_that_is_full_is_said_with_the_file(tmp_path: Path) -> None:
    """/dev/full takes nothing: what is written, flushed and left over at the end is refused alike, but once."""
    (tmp_path / "j").touch()

    class Full(JournalWriter):
        def __init__(self) -> None:
            super().__init__(tmp_path / "none")
            self._file.close()
            self._file = Path("/dev/full").open("wb", buffering=64)  # noqa: SIM115 - the writer closes it

    said = f"^{tmp_path}/none: no space left on device; free space there or choose another --out$"
    writer = Full()
    with pytest.raises(UnwrittenError, match=said), writer:
        writer.add(Said(1, "short"))
    (tmp_path / "none").unlink()
    writer = Full()
    with pytest.raises(UnwrittenError, match=said):
        writer.add(Said(1, "long" * 100))
    assert re.match(said, str(writer.failure))
    writer.add(Said(1, "short"))
    writer.flush()
    writer.__exit__(None, None, None)
    (tmp_path / "none").unlink()
    writer = Full()
    with pytest.raises(UnwrittenError, match=said):
        writer.add(Said(1, "short"))
        writer.flush()
    writer.__exit__(None, None, None)


def test_a_journal_that_was_removed_is_told_at_the_next_flush(tmp_path: Path) -> None:
    with JournalWriter(tmp_path / "j") as writer:
        writer.add(Said(1, "a"))
        writer.flush()
        (tmp_path / "j").unlink()
        writer.add(Said(2, "b"))
        with pytest.raises(UnwrittenError, match=f"^{tmp_path}/j: it was removed while it was written$"):
            writer.flush()


# A run cut while it goes on has the slices of the whole.

MS = 1_000_000
TWO = chain((("a", "u"), ("b", "v")), "double", "b")


def a_run(frames: int = 5, **options: object) -> Simulation:
    """a takes 2 ms, b 5; v dies at 9 ms and is back at 29."""
    service = {"a": 2 * MS, "b": 5 * MS}
    faults = [(9 * MS, "v")] if not options else []
    return simulate(
        TWO,
        Settings(frames, **options),  # type: ignore[arg-type]
        lambda stage, *_: service[stage],
        keep=True,
        restart_ns=20 * MS,
        faults=faults,
    )


def records(done: Simulation) -> Iterator[Record]:
    assert done.recording is not None
    return journal_of(done.recording, done.jobs, {"clock": "virtual"}, done.report)


def test_slices_come_as_soon_as_they_are_known() -> None:
    """(unit, cause, begin, end) in ms, by the time of the step with which they were handed back.

    The timeline is that of test_accounts.py: u is blocked from 4 to 7 and from 11 to 34, v down from 9 to 29.
    """
    timeline, seen = Timeline(TWO, Settings(5), idle=True), []
    for record in records(a_run()):
        found = [fact for fact in timeline.add(record) if isinstance(fact, IdleSlice)]
        assert not found or isinstance(record, Stepped)
        if isinstance(record, Stepped):
            seen += [(record.now_ns // MS, one.unit, one.cause, one.begin_ns // MS, one.end_ns // MS) for one in found]
    rest = [(one.unit, one.cause, one.begin_ns // MS, one.end_ns // MS) for one in timeline.end()]
    assert seen == [
        (4, "v", "starved", 0, 2),
        (9, "u", "blocked", 4, 7),
        (36, "v", "overhead", 7, 29),
        (36, "u", "blocked", 11, 34),
    ]
    assert rest == [("u", "starved", 36, 44)]
    assert timeline.span == Span(0, 44 * MS)


def test_time_that_nobody_explains_has_its_own_name() -> None:
    """A unit that is up and has no job, whose account says that it has one."""
    timeline = Timeline(chain((("a", "u"),), "single", "a"), Settings(1), idle=True)
    told = (Stepped(5, (UnitReady("u"),), ()), Accounted(5, "u", ASSIGNED), Stepped(9, (), ()))
    assert [timeline.add(record) for record in told] == [[], [], []]
    assert timeline.end() == [IdleSlice("u", UNEXPLAINED, 5, 9)]


def test_a_journal_of_before_jobs_had_their_cpu_time_is_read() -> None:
    row = ("a", "u", 3, 1, 2, 3, 9, 0, 1, 0)
    assert RunValues(TWO).job(row) == JobRecord(*row, cpu_ns=0)
    assert RunValues(TWO).job((*row, 4)).cpu_ns == 4
    with pytest.raises(UnexpectedValue, match="texts and whole numbers"):
        RunValues(TWO).job(row[:-1])


@pytest.mark.parametrize(
    "config",
    [
        *(5, {"units": 5}, {"units": {"cpu": 5}}, {"units": {"cpu": {"cores": 5}}}, {"scene": {"fps": "x"}}),
        *({"units": {"cpu": {"threads": "x"}}}, {"units": {"cpu": {"threads": 0}}}),
        *({"scene": {"output": 5}}, {"pipeline": 5}, {"pipeline": {"run": 5}}, {"scene": None}),
    ],
    ids=str,
)
def test_a_configuration_of_another_form_is_refused(config: object) -> None:
    with pytest.raises(BadInputError, match="found a configuration of another form"):
        config_of(BEGUN._replace(facts={"config": config}))
