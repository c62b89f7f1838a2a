"""The folder of a sweep, and the loop that does its missing trials: `sweep.json`, `trials.jsonl`, run folders.

Rule: one process at a time adds whole lines to `trials.jsonl`, one line for every trial that ended. An incomplete last
line is cut off, and its trial is done again. A lost trial is tried up to `TRIES` times, any other trial once.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from pydantic import Field, StrictFloat, StrictInt
from pydantic_core import from_json

from trilane.apps.sweep.definition import MOST_TRIALS, Trial
from trilane.errors import BadInputError, reason
from trilane.pipeline.run_metrics import Record
from trilane.units import HOST_CLOCK
from trilane.writing import WRITABLE, write_bytes

SWEEP, TRIALS, LOCK = "sweep.json", "trials.jsonl", ".lock"
#: Seconds to wait for the trials of a killed sweep to end: they hold its lock until then.
LOCK_S = 15.0
MAX_TRIALS_BYTES = MOST_TRIALS << 16  # far more than the lines of all trials of the largest sweep
TRIES = 3
PIECE_BYTES = 1 << 30
#: Keys of a trial in the answers of `trilane sweep` and `trilane tune`, in their order.
ROW = ("id", "command", "options", "repeat", "status", "exit_code", "error", "seconds", "repeated", "unsure")


class TrialRecord(Record, extra="ignore", allow_inf_nan=False):
    """A line of `trials.jsonl`; docs/sweeps.md describes its keys. Lines of other versions may have other keys.

    In answers, `status` may also be `planned`, for a trial that was not tried, or `pruned`, after a short run.
    """

    schema_: int = Field(default=1, alias="schema")
    id: str
    command: tuple[str, ...] = ()
    options: dict[str, Any] = Field(default={})
    repeat: StrictInt = 1
    clock: str = HOST_CLOCK
    status: Literal["planned", "done", "failed", "lost", "pruned"]
    exit_code: StrictInt | None = None
    error: str | None = None
    result: dict[str, Any] | None = None
    repeated: StrictInt = 0
    unsure: tuple[str, ...] = ()
    began_at: str | None = None
    seconds: StrictFloat | None = None
    host: dict[str, Any] | None = None
    folder: str | None = None
    tries: StrictInt = 1

    @property
    def is_ended(self) -> bool:
        """Whether the trial is final: done, or failed by itself. A lost trial may be tried again."""
        return self.status in ("done", "failed")

    def row(self) -> dict[str, Any]:
        """Return the trial as an entry of `trials` in the output of `trilane sweep --json`."""
        document = self.model_dump(mode="json", include={*ROW})
        return {key: document[key] for key in ROW}


#: Function that does trials and yields their records as they end. Closing the generator ends the trials still running.
Engine = Callable[[Sequence[Trial]], Generator[TrialRecord]]


def planned(trial: Trial) -> TrialRecord:
    """Return the record of a trial that was not tried."""
    return TrialRecord(
        id=trial.id,
        command=("trilane", *trial.arguments),
        options=dict(trial.options),
        repeat=trial.repeat,
        clock=trial.kind.clock,
        status="planned",
    )


def of_trial(trial: Trial, record: TrialRecord | None) -> TrialRecord:
    """Return `record` with the words and options of `trial`; without a record, the record of a trial not tried."""
    own = planned(trial)
    said = {"command": own.command, "options": own.options, "repeat": own.repeat}
    return own if record is None else record.model_copy(update=said)


def whole_lines(text: bytes, where: str | Path) -> tuple[list[TrialRecord], int]:
    """Return (records, size) of a `trials.jsonl`: its records, and the number of bytes up to the last record.

    Text after the last line feed is left out. The last line is also left out if it is no JSON object.

    `text`: content of the file. `where`: name of the file for the message of the error.

    Raises BadInputError, which names the line, for any other line that is no record.
    """
    records: list[TrialRecord] = []
    size, lines = 0, text.split(b"\n")[:-1]
    for number, line in enumerate(lines, start=1):
        record = _record(line)
        if record is None and (number < len(lines) or _is_object(line)):
            expected = "a JSON object with the keys of docs/sweeps.md"
            raise BadInputError(
                f"{where}, line {number}", "no trial", expected, "without this line its trial is done again"
            )
        if record is not None:
            records.append(record)
            size += len(line) + 1
    return records, size


def _whole(file: int, path: Path) -> bytes:
    """Return the content of the open file `file`. Raises BadInputError, which names `path`, if it is too large."""
    if (size := os.fstat(file).st_size) > MAX_TRIALS_BYTES:
        raise BadInputError(path, f"{size} bytes", f"at most {MAX_TRIALS_BYTES}")
    pieces = [os.pread(file, PIECE_BYTES, at) for at in range(0, size, PIECE_BYTES)]  # the kernel reads at most 2 GiB
    return b"".join(pieces)


def _record(line: bytes) -> TrialRecord | None:
    try:
        return TrialRecord.model_validate(from_json(line))
    except ValueError:
        return None


def _is_object(line: bytes) -> bool:
    return line.lstrip()[:1] == b"{" and line.rstrip()[-1:] == b"}"


def latest(records: Sequence[TrialRecord]) -> dict[str, TrialRecord]:
    """Return the last record of each trial, by the trial's name, in the order in which the trials first ended."""
    return {record.id: record for record in records}


def read_trials(folder: Path) -> dict[str, TrialRecord]:
    """Return the `latest` records of the sweep in `folder`, without an incomplete end of its `trials.jsonl`.

    Text after the last line feed is left out, and so is a last line that is no JSON object. Raises BadInputError if the
    file is absent, unreadable or too large, or if any other line is no record.
    """
    path = folder / TRIALS
    try:
        with path.open("rb") as file:
            return latest(whole_lines(_whole(file.fileno(), path), path)[0])
    except OSError as error:
        raise BadInputError.of_os_error(path, error, "the trials of a sweep") from error


@dataclass(frozen=True)
class SweepSummary:
    """How the trials of a sweep ended.

    `folder`: folder of the sweep. `trials`: last record of each trial. `skipped`: number of trials that had ended
    before this call of the sweep.
    """

    folder: Path
    trials: tuple[TrialRecord, ...]
    skipped: int

    @property
    def counts(self) -> dict[str, int]:
        """The numbers of trials: in all, by status, and skipped."""
        found = Counter(record.status for record in self.trials)
        by_status = {status: found[status] for status in ("done", "failed", "lost", "planned")}
        return {"trials": len(self.trials), **by_status, "skipped": self.skipped}

    def as_json(self) -> dict[str, Any]:
        """Return the keys `folder`, `counts` and `trials` of the output of `trilane sweep --json`."""
        return {
            "folder": str(self.folder),
            "counts": self.counts,
            "trials": [record.row() for record in self.trials],
        }


class Store:
    """The folder of a sweep, open for the one process that runs the sweep; a context manager.

    `folder`: absolute path of the folder. `done`: last record of each trial, by its name, including those just added.
    `lock`: file descriptor of the lock. A child process that inherits it holds the lock too, until its end.

    Entering makes the folder, or opens a folder with the same trials. Entering raises BadInputError if:
    - the folder cannot be written, its files are broken, or another process works in it;
    - the folder has other trials, or a file that the trials name has changed;
    - the folder has records, but not all trials have ended, and `resume` is false;
    - the folder has no sweep and `resume` is true.
    """

    def __init__(self, folder: Path, trials: Sequence[Trial], about: Mapping[str, Any], *, resume: bool) -> None:
        """Keep the parameters; entering opens the folder.

        `folder`: folder of the sweep. `trials`: all its trials. `about`: content of `sweep.json` besides the trials.
        `resume`: whether to go on with a sweep that has begun.
        """
        self.folder = folder.absolute()
        self.done: dict[str, TrialRecord] = {}
        self._trials, self._about, self._resume = trials, about, resume
        self.lock = self._file = -1

    def __enter__(self) -> Self:
        if self._resume and not (self.folder / SWEEP).is_file():
            raise BadInputError(self.folder, "no sweep", "one to go on with", "leave --resume out to begin it")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._take_lock()
            self._file = os.open(self.folder / TRIALS, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            self._close()
            raise BadInputError.of_os_error(self.folder, error, WRITABLE, "choose another --out") from error
        try:
            self._take_up()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    @property
    def ended(self) -> set[str]:
        """The names of the trials that are final."""
        return {name for name, record in self.done.items() if record.is_ended}

    def summary(self, before: set[str]) -> SweepSummary:
        """Return how the trials ended. `before`: names of the trials that ended before this call of the sweep."""
        found = tuple(of_trial(trial, self.done.get(trial.id)) for trial in self._trials)
        return SweepSummary(self.folder, found, sum(trial.id in before for trial in self._trials))

    def add(self, record: TrialRecord) -> None:
        """Write a trial's record, and wait until it is on the disk. Raises BadInputError if this fails."""
        document = record.model_dump(mode="json", by_alias=True)
        line = json.dumps(document, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        try:
            while line:
                line = line[os.write(self._file, line) :]
            os.fsync(self._file)
        except OSError as error:
            raise BadInputError.of_os_error(self.folder / TRIALS, error, WRITABLE, "--resume goes on") from error
        self.done[record.id] = record

    def _take_lock(self) -> None:
        self.lock = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        give_up_at = time.monotonic() + LOCK_S
        while True:
            try:
                fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                if time.monotonic() > give_up_at:
                    self._close()
                    remedy = "wait for it, or choose another --out"
                    raise BadInputError(self.folder, "a sweep that goes on", "one that nobody runs", remedy) from None
                time.sleep(0.05)

    def _take_up(self) -> None:
        path, ids, inputs = self.folder / SWEEP, [trial.id for trial in self._trials], input_digests(self._trials)
        if path.exists():
            self._check_same(path, ids, inputs)
        else:
            listed = [
                {"id": trial.id, "options": dict(trial.options), "repeat": trial.repeat} for trial in self._trials
            ]
            document = {"schema": 1, **self._about, "inputs": inputs, "trials": listed}
            write_bytes(path, json.dumps(document, indent=1).encode() + b"\n")
        records, size = whole_lines(_whole(self._file, self.folder / TRIALS), self.folder / TRIALS)
        os.ftruncate(self._file, size)
        os.lseek(self._file, 0, os.SEEK_END)
        self.done = latest(records)
        ended = len(self.ended.intersection(ids))
        if self.done and ended < len(ids) and not self._resume:
            found = f"a sweep with {ended} of {len(ids)} trials done"
            raise BadInputError(self.folder, found, "a new folder, or one that is complete", "--resume goes on with it")

    def _check_same(self, path: Path, ids: list[str], inputs: Mapping[str, str]) -> None:
        try:
            document = json.loads(path.read_bytes())
            there, read = {trial["id"] for trial in document["trials"]}, dict(document.get("inputs", inputs))
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise BadInputError(path, f"no description of a sweep ({reason(error)})", "one") from error
        if there != set(ids):
            found = f"a sweep of {len(there)} trials; {len(there & set(ids))} of them are among these {len(ids)}"
            raise BadInputError(self.folder, found, "the same trials", "choose another --out")
        changed = [name for name, digest in inputs.items() if read.get(name) != digest]
        if changed:
            found = f"a sweep that read {', '.join(changed)} with other contents"
            raise BadInputError(self.folder, found, "the same files", "choose another --out")

    def _close(self) -> None:
        for descriptor in (self._file, self.lock):
            if descriptor >= 0:
                os.close(descriptor)
        self._file = self.lock = -1


def input_digests(trials: Sequence[Trial]) -> dict[str, str]:
    """Return the SHA-256 of each file that an option of a trial names, in hexadecimal, by the path in the option."""
    values = (each for trial in trials for value in trial.options.values() for each in _flat(value))
    # `Path.is_file` raises for a text that is too long for a path.
    files = sorted({each for each in values if isinstance(each, str) and os.path.isfile(each)})  # noqa: PTH113
    return {name: hashlib.sha256(Path(name).read_bytes()).hexdigest() for name in files}


def _flat(value: Any) -> Iterable[Any]:
    return value if isinstance(value, list | tuple) else [value]


def run_sweep(trials: Sequence[Trial], store: Store, engine: Engine, told: Callable[[TrialRecord], None]) -> None:
    """Do all `trials` that have not ended in `store`, the open folder of the sweep.

    `engine`: function that does trials. `told`: function that gets the record of each trial that is not tried again.
    """
    ended = store.ended
    left = [trial for trial in trials if trial.id not in ended]
    for attempt in range(1, TRIES + 1):
        lost: set[str] = set()
        for record in _records(engine, left):
            if record.status == "lost" and attempt < TRIES:
                lost.add(record.id)
                continue
            store.add(record.model_copy(update={"tries": attempt}))
            told(record)
        left = [trial for trial in left if trial.id in lost]


def _records(engine: Engine, trials: list[Trial]) -> Iterator[TrialRecord]:
    if trials:
        with closing(engine(trials)) as records:
            yield from records
