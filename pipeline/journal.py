"""The journal of a run: what happened, in order, written while it happens, in one file that others may follow.

Rule: nothing of a run is kept in memory because somebody may want it later. Who wants it reads the journal: after the
run, or while it goes on, from the same bytes.

The bytes are msgpack: arrays of a record's place in RECORDS and its fields, the first a `Begun`. A step comes before
the accounts, jobs and counts that follow from it, and all of these before the next step. A journal that ends within a
record, or without `Ended`, is of a run that was killed, or that still goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, NamedTuple, Self

import msgpack

from trilane.errors import BadInputError, UnwrittenError
from trilane.files import require_file
from trilane.scheduler.accounts import in_order
from trilane.scheduler.core import Core
from trilane.scheduler.events import Action, Event, Graph, Settings
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import Recording, actions_of, events_of, graph_of, row_of, settings_of
from trilane.unexpected_value import UnexpectedValue

NAME = "journal.msgpack"
SCHEMA: Final = 1
MAX_RECORD_BYTES: Final = 64 << 20
CHUNK_BYTES: Final = 1 << 20
EXPECTED = "the journal of a run"


class Begun(NamedTuple):
    """The first record. `facts`: what else is known before the first frame, as JSON: `clock` ("host" or "virtual"),

    `began_at` (UTC, ISO 8601), `config`, `machine`, `made`, `accuracy`, `units`, as in report.json, where they are
    known.
    """

    schema: int
    graph: Graph
    settings: Settings
    facts: Mapping[str, Any]


class Stepped(NamedTuple):
    """A step of the scheduler at `now_ns`: what it was told and what it answered."""

    now_ns: int
    events: tuple[Event, ...]
    actions: tuple[Action, ...]


class Accounted(NamedTuple):
    """From `now_ns` on the time of `unit` goes to `account` (`trilane.scheduler.ledger`)."""

    now_ns: int
    unit: str
    account: int


class Worked(NamedTuple):
    """A job that has ended, and the numbers that its stage reported of it, by name."""

    job: JobRecord
    figures: Mapping[str, float]


class Counted(NamedTuple):
    """Frames `lost` and `dropped` until `now_ns`, by the cause's key in the report; written when they have changed."""

    now_ns: int
    lost: Mapping[str, int]
    dropped: Mapping[str, int]


class Sampled(NamedTuple):
    """What was looked at in passing, by dotted name, such as `temperature_c.device` or `duty.gpu`."""

    now_ns: int
    values: Mapping[str, float]


class Said(NamedTuple):
    """A message to a person."""

    now_ns: int
    text: str


class Ended(NamedTuple):
    """The last record: the figures of the whole run, as `RunMetrics.as_json()` has them."""

    now_ns: int
    report: Mapping[str, Any]


Record = Begun | Stepped | Accounted | Worked | Counted | Sampled | Said | Ended
RECORDS: tuple[type[Any], ...] = (Begun, Stepped, Accounted, Worked, Counted, Sampled, Said, Ended)
_PLACES = {kind: place for place, kind in enumerate(RECORDS)}


class JournalWriter:
    """Context manager: `add` writes a record. What is written reaches the file after `flush`, and at the end.

    `path`: a file that does not exist yet; OSError where it cannot be made. All else, the end included, raises
    UnwrittenError where the file cannot be written on, such as on a full disk.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] = path.open("xb", buffering=CHUNK_BYTES)
        self._packer = msgpack.Packer()

    def add(self, record: Record) -> None:
        kind = type(record)
        fields = _FIELDS[kind](record) if kind in _FIELDS else record
        try:
            self._file.write(self._packer.pack([_PLACES[kind], *fields]))
        except OSError as error:
            raise UnwrittenError(self._path, error) from None

    def flush(self) -> None:
        """Whoever follows the journal sees all that was added."""
        try:
            self._file.flush()
        except OSError as error:
            raise UnwrittenError(self._path, error) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._file.close()
        except OSError as failed:
            raise UnwrittenError(self._path, failed) from None


class JournalReader:
    """The records of the journal at `path`, again and again as it grows; where it was moved, set `path` anew.

    `new()`: those that came whole since the last call. Raises BadInputError for a file that is none, or whose bytes are
    no records.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._unpacker = msgpack.Unpacker(max_buffer_size=MAX_RECORD_BYTES, use_list=False)
        self._read_bytes = 0
        self._has_begun = False

    def new(self) -> Iterator[Record]:
        """Each record once, in order."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._read_bytes)
                while chunk := file.read(CHUNK_BYTES):
                    self._read_bytes += len(chunk)
                    self._unpacker.feed(chunk)
                    yield from map(self._parsed, self._unpacker)
        except OSError as error:
            raise BadInputError.of_os_error(self.path, error, EXPECTED) from None
        except (ValueError, msgpack.UnpackException, RecursionError) as error:
            self._refuse(str(error) or type(error).__name__)

    def _parsed(self, row: Any) -> Record:
        try:
            record = _parse(row)
        except UnexpectedValue as error:
            raise BadInputError.at(f"{self.path}, before byte {self._read_bytes}", error) from None
        except (ValueError, TypeError, KeyError, IndexError) as error:
            self._refuse(str(error) or type(error).__name__)
        if isinstance(record, Begun) == self._has_begun:
            self._refuse("a second header" if self._has_begun else "a record before the header")
        self._has_begun = True
        return record

    def _refuse(self, found: str) -> Any:
        raise BadInputError(f"{self.path}, before byte {self._read_bytes}", found, EXPECTED) from None


def read_journal(path: Path) -> Iterator[Record]:
    """Every whole record of the journal at `path`. Raises BadInputError; an empty file is none, nor is a pipe."""
    require_file(path, EXPECTED)
    reader = JournalReader(path)
    is_empty = True
    for record in reader.new():
        is_empty = False
        yield record
    if is_empty:
        raise BadInputError(path, "no record", EXPECTED)


def journal_of(
    recording: Recording, jobs: Iterable[JobRecord], facts: Mapping[str, Any], report: Mapping[str, Any]
) -> Iterator[Record]:
    """The records of a run that is in memory, such as one in virtual time (`Simulation` with `keep`).

    Frames lost and dropped are counted by a core that hears the same events. `facts`: of `Begun`. `report`: of `Ended`.
    """
    core, counted, now_ns = Core(recording.graph, recording.settings), 0, 0
    yield Begun(SCHEMA, recording.graph, recording.settings, facts)
    for now_ns, events, actions, accounts, ended in in_order(recording, jobs):
        yield Stepped(now_ns, events, actions)
        for unit, account in accounts:
            yield Accounted(now_ns, unit, account)
        for job in ended:
            yield Worked(job, {})
        core.step(now_ns, events)
        if (count := core.ledger.left_out) != counted:
            counted = count
            yield Counted(now_ns, core.ledger.lost_by_cause, core.ledger.dropped_by_cause)
    yield Ended(now_ns, report)


#: The fields of a record as they are written, where they are not its own.
_FIELDS: dict[type[Any], Callable[[Any], list[Any]]] = {
    Begun: lambda record: [record.schema, asdict(record.graph), asdict(record.settings), record.facts],
    Stepped: lambda record: [record.now_ns, [*map(row_of, record.events)], [*map(row_of, record.actions)]],
}


def _parse(row: Any) -> Record:
    place, *fields = row
    kind = RECORDS[place] if type(place) is int and 0 <= place < len(RECORDS) else None
    if kind is Begun:
        schema, graph, settings, facts = fields
        if schema != SCHEMA:
            raise UnexpectedValue(f"schema {schema!r}", str(SCHEMA))
        return Begun(schema, graph_of(graph), settings_of(settings), facts)
    if kind is Stepped:
        now_ns, events, actions = fields
        return Stepped(now_ns, events_of(events), actions_of(actions))
    if kind is Worked:
        job, figures = fields
        return Worked(JobRecord(*job), figures)
    if kind is None or len(fields) != len(kind._fields):
        raise UnexpectedValue(str(row)[:80], f"one of {', '.join(each.__name__ for each in RECORDS)}")
    record: Record = kind(*fields)
    return record
