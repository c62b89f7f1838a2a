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
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from trilane.apps.sweep.definition import Trial
from trilane.errors import BadInputError, reason
from trilane.writing import WRITABLE, write_bytes

SWEEP, TRIALS, LOCK = "sweep.json", "trials.jsonl", ".lock"
#: Seconds for the trials of a killed sweep to end; they hold its lock until then.
LOCK_S = 15.0
Record = dict[str, Any]
TRIES = 3
#: Does trials and yields their records as they end. If its generator is closed, trials that still run are ended.
Engine = Callable[[Sequence[Trial]], Generator[Record]]


def whole_lines(text: bytes, where: str | Path) -> tuple[list[Record], int]:
    """Return (records, size) of a `trials.jsonl`: its records, and the number of bytes up to the last record.

    Text after the last line feed is left out. The last line is also left out if it is no record.

    `text`: content of the file. `where`: name of the file for the message of the error.

    Raises BadInputError, which names the line, for an earlier line that is no record.
    """
    records: list[Record] = []
    size, lines = 0, text.split(b"\n")[:-1]
    for number, line in enumerate(lines, start=1):
        record = _record(line)
        if record is None and number < len(lines):
            expected = "a JSON object with id and status"
            raise BadInputError(
                f"{where}, line {number}", "no trial", expected, "without this line its trial is done again"
            )
        if record is not None:
            records.append(record)
            size += len(line) + 1
    return records, size


def _record(line: bytes) -> Record | None:
    try:
        found = json.loads(line)
    except ValueError:
        return None
    return found if isinstance(found, dict) and {"id", "status"} <= found.keys() else None


def latest(records: Sequence[Record]) -> dict[str, Record]:
    """Return the last record of each trial, by the trial's name, in the order in which the trials first ended."""
    return {str(record["id"]): record for record in records}


def read_trials(folder: Path) -> dict[str, Record]:
    """Return the `latest` records of the sweep in `folder`.

    Raises BadInputError if the folder has no `trials.jsonl`, or if a line of this file is broken.
    """
    path = folder / TRIALS
    try:
        return latest(whole_lines(path.read_bytes(), path)[0])
    except OSError as error:
        raise BadInputError.of_os_error(path, error, "the trials of a sweep") from error


class Store:
    """The folder of a sweep, open for the one process that runs the sweep; a context manager.

    `folder`: absolute path of the folder. `done`: last records by the trial's name, from the folder and from `add`.

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
        self.done: dict[str, Record] = {}
        self._trials, self._about, self._resume = trials, about, resume
        self._lock = self._file = -1

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
    def lock(self) -> int:
        """The file descriptor of the lock. A child process that inherits it holds the lock too, until its end."""
        return self._lock

    def add(self, record: Mapping[str, Any]) -> None:
        """Write a trial's record, and wait until the record is on the disk.

        Raises BadInputError if it cannot be written.
        """
        line = json.dumps(record, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        try:
            while line:
                line = line[os.write(self._file, line) :]
            os.fsync(self._file)
        except OSError as error:
            raise BadInputError.of_os_error(self.folder / TRIALS, error, WRITABLE, "--resume goes on") from error
        self.done[str(record["id"])] = dict(record)

    def _take_lock(self) -> None:
        self._lock = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        give_up_at = time.monotonic() + LOCK_S
        while True:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
        records, size = whole_lines(os.pread(self._file, os.fstat(self._file).st_size, 0), self.folder / TRIALS)
        os.ftruncate(self._file, size)
        os.lseek(self._file, 0, os.SEEK_END)
        self.done = latest(records)
        ended = sum(is_ended(self.done.get(name)) for name in ids)
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
        for descriptor in (self._file, self._lock):
            if descriptor >= 0:
                os.close(descriptor)
        self._file = self._lock = -1


def input_digests(trials: Sequence[Trial]) -> dict[str, str]:
    """Return the SHA-256 of each file that an option of a trial names, in hexadecimal, by the path in the option."""
    values = (each for trial in trials for value in trial.options.values() for each in _flat(value))
    files = sorted({each for each in values if isinstance(each, str) and Path(each).is_file()})
    return {name: hashlib.sha256(Path(name).read_bytes()).hexdigest() for name in files}


def _flat(value: Any) -> Iterable[Any]:
    return value if isinstance(value, list | tuple) else [value]


def is_ended(record: Mapping[str, Any] | None) -> bool:
    """Return whether a trial is final: done, or failed by itself.

    A lost trial is not final, because it may be tried again.

    `record`: record of the trial; None for a trial that was not tried.
    """
    return record is not None and record["status"] in ("done", "failed")


def run_sweep(trials: Sequence[Trial], store: Store, engine: Engine, told: Callable[[Record], None]) -> None:
    """Do all `trials` that have not ended in `store`, the open folder of the sweep.

    `engine`: function that does trials. `told`: function that gets the record of each trial that is not tried again.
    """
    left = [trial for trial in trials if not is_ended(store.done.get(trial.id))]
    for attempt in range(1, TRIES + 1):
        lost_now: list[Trial] = []
        for record in _records(engine, left):
            if record["status"] == "lost" and attempt < TRIES:
                lost_now += [trial for trial in left if trial.id == record["id"]]
                continue
            store.add({**record, "tries": attempt})
            told(record)
        left = lost_now


def _records(engine: Engine, trials: list[Trial]) -> Iterator[Record]:
    if trials:
        with closing(engine(trials)) as records:
            yield from records


def summary(trials: Sequence[Trial], store: Store, before: set[str]) -> dict[str, Any]:
    """Return how the trials of a sweep ended.

    Keys: `folder`: folder of the sweep. `counts`: numbers of trials, in all and by status. `trials`: results of
    `row_of`.

    `store`: open folder of the sweep. `before`: names of the trials that ended before this call of the sweep; they
    count as `skipped` too.
    """
    rows = [row_of(trial, store.done.get(trial.id)) for trial in trials]
    counts = Counter(row["status"] for row in rows)
    return {
        "folder": str(store.folder),
        "counts": {
            "trials": len(rows),
            **{status: counts[status] for status in ("done", "failed", "lost", "planned")},
            "skipped": sum(trial.id in before for trial in trials),
        },
        "trials": rows,
    }


def row_of(trial: Trial, record: Record | None) -> dict[str, Any]:
    """Return `trial` as a row of a summary: its options, and how it ended.

    `record`: record of the trial; None for a trial that was not tried, whose status is `planned`.
    """
    ended = record or {"status": "planned", "exit_code": None, "error": None, "seconds": None}
    return {
        "id": trial.id,
        "command": ["trilane", *trial.arguments],
        "options": dict(trial.options),
        "repeat": trial.repeat,
        **{key: ended[key] for key in ("status", "exit_code", "error", "seconds")},
        "repeated": ended.get("repeated", 0),
        "unsure": ended.get("unsure", []),
    }
