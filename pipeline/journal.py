"""The journal of a run: one file that records what happens, in order, during the run. Readers may follow it.

Rule: a run keeps nothing in memory only because a reader may need it later. Readers take everything from the journal,
during the run or after it.

The file is MessagePack. Each record is an array: the index of the record's type in RECORDS, then the record's fields.
The first record is a `Begun`. The record of a step is followed by the accounts, jobs and counts that result from the
step, and only then by the next step. A journal that ends within a record, or without `Ended`, belongs to a run that was
killed or still goes on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, NamedTuple, NoReturn, Self, TypeGuard

import msgpack

from trilane.errors import BadInputError, UnwrittenError
from trilane.files import require_file
from trilane.pipeline import journal_values as values
from trilane.pipeline.journal_values import RunValues
from trilane.scheduler.core import Core
from trilane.scheduler.events import NEVER, Action, Event, Graph, JobDone, Settings
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import Recording, row_of
from trilane.unexpected_value import UnexpectedValue
from trilane.units import NS_PER_S, TARGET_FPS
from trilane.writing import require_name

NAME = "journal.msgpack"
SCHEMA: Final = 1
#: Bounds of a record, against hostile files. The longest record of a run has a few kB, and its largest map 25 entries.
#: An empty map is 1 byte in the file and 72 bytes in memory. A list takes 8 bytes for each entry that it announces, in
#: each of at most 1024 nested lists.
MAX_RECORD_BYTES: Final = 1 << 20
MAX_ENTRIES: Final = 1 << 14
MAX_TEXT_BYTES: Final = 1 << 16
CHUNK_BYTES: Final = 1 << 20
EXPECTED = "the journal of a run"


class Begun(NamedTuple):
    """The first record.

    `facts`: JSON values that are known before the first frame, by their keys in report.json. They may be `clock`
    ("host" or "virtual"), `began_at` (UTC, ISO 8601), `config`, `machine`, `made`, `accuracy` and `units`. Another key
    is `target_period_ns`, as for `trilane.scheduler.stats.due_ns`; journals of an older Trilane lack it.
    """

    schema: int
    graph: Graph
    settings: Settings
    facts: Mapping[str, Any]


class Stepped(NamedTuple):
    """A step of the scheduler at `now_ns`: the events that it received and its actions."""

    now_ns: int
    events: tuple[Event, ...]
    actions: tuple[Action, ...]


class Accounted(NamedTuple):
    """From `now_ns` on, the time of `unit` goes to `account` (`trilane.scheduler.ledger`)."""

    now_ns: int
    unit: str
    account: int


class Worked(NamedTuple):
    """A job that has ended. `figures`: metrics of its stage for this job, by name."""

    job: JobRecord
    figures: Mapping[str, float]


class Counted(NamedTuple):
    """Numbers of frames that were `lost` and `dropped` until `now_ns`, each by the cause's key in the report.

    The record is written after each step that changes one of these numbers.
    """

    now_ns: int
    lost: Mapping[str, int]
    dropped: Mapping[str, int]


class Sampled(NamedTuple):
    """Measured values at `now_ns`, by dotted name, such as `temperature_c.device` or `duty.gpu`."""

    now_ns: int
    values: Mapping[str, float]


class Said(NamedTuple):
    """A message of the run to its user, at `now_ns`."""

    now_ns: int
    text: str


class Ended(NamedTuple):
    """The last record. `report`: report of the whole run, as `RunMetrics.as_json()` returns it."""

    now_ns: int
    report: Mapping[str, Any]


class Stopped(NamedTuple):
    """A signal has stopped the process of `unit`, as seen at `now_ns`; there is one record for each stop."""

    now_ns: int
    unit: str


Record = Begun | Stepped | Accounted | Worked | Counted | Sampled | Said | Ended | Stopped
RECORDS: tuple[type[Any], ...] = (Begun, Stepped, Accounted, Worked, Counted, Sampled, Said, Ended, Stopped)
_PLACES = {kind: place for place, kind in enumerate(RECORDS)}


class JournalWriter:
    """Context manager that writes records: `add` buffers a record; `flush` or the context's end writes all.

    If the file cannot be written, such as on a full disk, the method that notices this raises an UnwrittenError. After
    that, nothing more is written.

    `path`: path of a file that does not exist yet.
    `failure`: the UnwrittenError that was raised, or None.

    Raises OSError if the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] = path.open("xb", buffering=CHUNK_BYTES)
        self._packer = msgpack.Packer()
        self.failure: UnwrittenError | None = None

    def add(self, record: Record) -> None:
        if self.failure is not None:
            return
        kind = type(record)
        fields = _FIELDS[kind](record) if kind in _FIELDS else record
        try:
            self._file.write(self._packer.pack([_PLACES[kind], *fields]))
        except OSError as error:
            self._fail(UnwrittenError(self._path, error))

    def flush(self) -> None:
        """Write all added records to the file, so that the file's readers see them.

        Raises UnwrittenError if the file cannot be written, or was removed.
        """
        if self.failure is not None:
            return
        try:
            self._file.flush()
            require_name(self._path, self._file.fileno())
        except OSError as error:
            self._fail(UnwrittenError(self._path, error))
        except UnwrittenError as error:
            self._fail(error)

    def _fail(self, error: UnwrittenError) -> NoReturn:
        self.failure = error
        raise error from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._file.close()
        except OSError as failed:
            if self.failure is None:
                raise UnwrittenError(self._path, failed) from None


class JournalReader:
    """Reads the journal at `path` while the journal grows. If the file is moved, set `path` to its new path.

    `new` raises BadInputError for a file that is no journal. The error names the number of a bad record, from 1.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._unpacker = msgpack.Unpacker(
            max_buffer_size=MAX_RECORD_BYTES + CHUNK_BYTES,
            max_array_len=MAX_ENTRIES,
            max_map_len=MAX_ENTRIES,
            max_str_len=MAX_TEXT_BYTES,
            max_bin_len=0,
            max_ext_len=0,
            use_list=False,
        )
        self._read_bytes = self._open_bytes = self._count = 0
        self._run: _Checks | None = None

    def new(self) -> Iterator[Record]:
        """Yield each record that was completed since the last call, in order."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._read_bytes)
                while chunk := file.read(CHUNK_BYTES):
                    self._read_bytes += len(chunk)
                    yield from self._parsed(chunk)
        except OSError as error:
            raise BadInputError.of_os_error(self.path, error, EXPECTED) from None

    def _parsed(self, chunk: bytes) -> Iterator[Record]:
        """Yield the records that end in `chunk`, the next bytes of the file."""
        count = self._count
        try:
            self._unpacker.feed(chunk)
            for row in self._unpacker:
                self._count += 1
                yield self._record(row)
        except UnexpectedValue as error:
            raise BadInputError.at(f"{self.path}, record {self._count}", error) from None
        except (ValueError, msgpack.UnpackException) as error:
            raise self._refused(next(found for kind, found in _UNREADABLE if isinstance(error, kind))) from None
        self._open_bytes = self._open_bytes + len(chunk) if self._count == count else 0
        if self._open_bytes > MAX_RECORD_BYTES:
            raise self._refused(f"more than {MAX_RECORD_BYTES} bytes")

    def _refused(self, found: str) -> BadInputError:
        """Return the error for the next record, which cannot be read. `found`: the record's defect."""
        return BadInputError(f"{self.path}, record {self._count + 1}", found, EXPECTED)

    def _record(self, row: Any) -> Record:
        place = row[0] if type(row) is tuple and row else None
        if type(place) is not int or not 0 <= place < len(RECORDS):
            raise UnexpectedValue(values.shown(row), f"one of {', '.join(each.__name__ for each in RECORDS)}")
        if (place == 0) == (self._run is not None):
            raise UnexpectedValue("a second header" if place == 0 else "a record before the header", EXPECTED)
        kind = RECORDS[place]
        if len(row) != len(kind._fields) + 1:
            raise UnexpectedValue(values.shown(row), f"{kind.__name__} with {', '.join(kind._fields)}")
        if self._run is None:
            begun = _begun(*row[1:])
            self._run = _checks(RunValues(begun.graph))
            return begun
        record: Record = kind(*[check(value) for check, value in zip(self._run[place], row[1:], strict=True)])
        return record


def journal_in(folder: Path) -> Path | None:
    """Return the path of a run folder's journal; None without a journal.

    Raises BadInputError if the path exists but is not a file.
    """
    path = folder / NAME
    if path.exists() and not path.is_file():
        require_file(path, EXPECTED)
    return path if path.is_file() else None


def read_journal(path: Path) -> Iterator[Record]:
    """Yield every whole record of the journal at `path`.

    Raises BadInputError for a file that is no journal, an empty file and a pipe.
    """
    require_file(path, EXPECTED)
    reader = JournalReader(path)
    is_empty = True
    for record in reader.new():
        is_empty = False
        yield record
    if is_empty:
        raise BadInputError(path, "no record", EXPECTED)


def records_of(recording: Recording, jobs: Iterable[JobRecord]) -> Iterator[Record]:
    """Yield the records of a run in memory from which its bound is found: steps, accounts and jobs.

    `recording`: recording of the run.
    `jobs`: finished jobs of the run.
    """
    for stepped, others in _steps_of(recording, jobs):
        yield stepped
        yield from others


def _steps_of(recording: Recording, jobs: Iterable[JobRecord]) -> Iterator[tuple[Stepped, list[Record]]]:
    """Yield pairs (record of a step, records of the accounts that changed and the jobs that ended with the step)."""
    accounts = deque(recording.accounts)
    left: dict[str, deque[JobRecord]] = {unit: deque() for unit in recording.graph.units}
    for job in sorted(jobs, key=lambda job: job.begin_ns):
        left[job.unit].append(job)
    for step in recording.steps:
        others: list[Record] = []
        while accounts and accounts[0][0] <= step[0]:
            others.append(Accounted(*accounts.popleft()))
        for event in step[1]:
            while type(event) is JobDone and left[event.unit] and left[event.unit][0].end_ns <= event.t_end_ns:
                others.append(Worked(left[event.unit].popleft(), {}))
        yield Stepped(*step), others


def journal_of(
    recording: Recording, jobs: Iterable[JobRecord], facts: Mapping[str, Any], report: Mapping[str, Any]
) -> Iterator[Record]:
    """Yield the records of a run in memory, such as a run in virtual time (`Simulation` with `keep`).

    A second `Core` takes the same events, and counts the lost and dropped frames.

    `recording`, `jobs`: recording and finished jobs of the run.
    `facts`: facts of the first record, `Begun`.
    `report`: report of the last record, `Ended`.
    """
    core, counted, now_ns = Core(recording.graph, recording.settings), 0, 0
    yield Begun(SCHEMA, recording.graph, recording.settings, facts)
    for stepped, others in _steps_of(recording, jobs):
        yield stepped
        yield from others
        now_ns = stepped.now_ns
        core.step(now_ns, stepped.events)
        if (count := core.ledger.left_out) != counted:
            counted = count
            yield Counted(now_ns, core.ledger.lost_by_cause, core.ledger.dropped_by_cause)
    yield Ended(now_ns, report)


def config_of(begun: Begun) -> Mapping[str, Any]:
    """Return the configuration (`config` of report.json) in a journal's first record; empty if there is none.

    Raises BadInputError for a configuration of a form that no run writes.
    """
    config = begun.facts.get("config", {})
    if not _has_form_of_a_run(config):
        raise BadInputError("the journal: facts", "a configuration of another form", "one as a run writes it")
    return config


def _has_form_of_a_run(config: Any) -> TypeGuard[Mapping[str, Any]]:
    """Return whether the tables of a configuration, and some values that readers compute with, have the right types."""
    names = ("units", "scene", "pace_ns", "pipeline")
    if not isinstance(config, Mapping) or not all(isinstance(config.get(name, {}), Mapping) for name in names):
        return False
    units, scene = config.get("units", {}).values(), config.get("scene", {})
    return (
        all(isinstance(unit, Mapping) and isinstance(unit.get("cores", ()), list | tuple) for unit in units)
        and all(type(threads := unit.get("threads", 1)) is int and threads > 0 for unit in units)
        and isinstance(scene.get("output", {}), Mapping)
        and isinstance(scene.get("fps", 0), int | float)
        and isinstance(config.get("pipeline", {}).get("run", {}), Mapping)
    )


def target_period_ns(begun: Begun) -> int:
    """Return `target_period_ns` of a journal's first record, in ns. Raises BadInputError as `config_of` does.

    If the journal lacks it, return 0 for frames with a deadline, else the period of the scene's rate or of TARGET_FPS.
    """
    written, settings = begun.facts.get("target_period_ns"), begun.settings
    if type(written) is int and 0 <= written < NEVER:
        return written
    fps = config_of(begun).get("scene", {}).get("fps")
    is_known = isinstance(fps, int | float) and fps * NEVER > NS_PER_S
    return 0 if settings.deadline_ns else round(NS_PER_S / (fps if is_known else TARGET_FPS))


#: Functions that return the written fields of a record, for the types whose fields are not written as they are.
_FIELDS: dict[type[Any], Callable[[Any], list[Any]]] = {
    Begun: lambda record: [record.schema, record.graph.written(), asdict(record.settings), record.facts],
    Stepped: lambda record: [record.now_ns, [*map(row_of, record.events)], [*map(row_of, record.actions)]],
}


#: Pairs of an exception that the MessagePack reader raises, and the defect of the bytes that this exception means.
_UNREADABLE: tuple[tuple[type[Exception], str], ...] = (
    (msgpack.FormatError, "bytes that are no MessagePack"),
    (msgpack.StackError, "lists inside lists, too deep"),
    (msgpack.BufferFull, f"more than {MAX_RECORD_BYTES} bytes"),
    (UnicodeDecodeError, "a text that is not UTF-8"),
    (Exception, f"a list of more than {MAX_ENTRIES} entries, a text of more than {MAX_TEXT_BYTES} bytes, or raw bytes"),
)

_Checks = tuple[tuple[Callable[[Any], Any], ...], ...]


def _checks(run: RunValues) -> _Checks:
    """Return, for each type in RECORDS, a function for each field. It checks and returns the field's value."""
    of: dict[type[Any], tuple[Callable[[Any], Any], ...]] = {
        Begun: (),
        Stepped: (run.step_ns, run.events, run.actions),
        Accounted: (values.time_ns, run.unit, run.account),
        Worked: (run.job, values.numbers),
        Counted: (values.time_ns, values.counts, values.counts),
        Sampled: (values.time_ns, values.numbers),
        Said: (values.time_ns, values.text),
        Ended: (values.time_ns, values.facts),
        Stopped: (values.time_ns, run.unit),
    }
    return tuple(of[kind] for kind in RECORDS)


def _begun(schema: Any, graph: Any, settings: Any, facts: Any) -> Begun:
    if schema != SCHEMA:
        raise UnexpectedValue(f"schema {values.shown(schema)}", str(SCHEMA))
    found = values.graph(graph)
    return Begun(SCHEMA, found, values.settings(settings, found), values.facts(facts))
