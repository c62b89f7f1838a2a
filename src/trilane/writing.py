"""Writes output files so that each is whole or absent: under a temporary name first, then renamed.

A temporary file lies in the folder of the output file. `write_folder` uses a temporary folder beside the output folder.
A device or a pipe is written directly.

Rule: if writing ends early for any reason, an old file stays as it was, unless `write_folder` has already replaced it.
Temporary files are removed. Only a process that is killed outright may leave its `.trilane-*`.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from trilane.errors import BadInputError, UnwrittenError

WRITABLE = "a place that can be written"
PREFIX = ".trilane-"
REMOVED = "it was removed while it was written"


@contextmanager
def write_atomically(path: Path, remedy: str = "") -> Iterator[Path]:
    """Yield a temporary path to write to. If the block ends without an error, that file is renamed to `path`.

    The temporary file does not exist yet; its path has the suffix of `path`. If `path` is a device or a pipe, such as
    /dev/stdout, `path` itself is yielded.

    Raises BadInputError with `remedy` if the file cannot be written. An OSError about another file is not changed.
    """
    draft = path.parent / f"{PREFIX}{secrets.token_hex(8)}{path.suffix}"
    try:
        with _os_errors_about(path, remedy, (path, draft)):
            if _is_device(path):
                yield path
            else:
                yield draft
                _flush(draft)
                draft.replace(path)
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)


def require_writable(path: Path) -> None:
    """Raise BadInputError if `write_atomically` cannot write to `path`; called before long work."""
    with _os_errors_about(path):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not _is_device(path):
            tempfile.TemporaryFile(prefix=PREFIX, dir=path.parent).close()


def _is_device(path: Path) -> bool:
    """Return whether `path` is a device, a pipe or a socket."""
    return path.exists() and not path.is_file() and not path.is_dir()


def require_name(path: Path, fd: int) -> None:
    """Raise UnwrittenError if somebody has removed the file `path`, which is still open with the descriptor `fd`."""
    if not os.fstat(fd).st_nlink:
        raise UnwrittenError(path, FileNotFoundError(errno.ENOENT, REMOVED))


def write_bytes(path: Path, content: bytes, remedy: str = "") -> None:
    """Write `content` to `path` with `write_atomically`, and raise BadInputError as it does."""
    with write_atomically(path, remedy) as draft:
        draft.write_bytes(content)


@contextmanager
def write_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder to write files to. If the block ends without an error, the files move into `folder`.

    The files replace files of the same names in `folder`, one after the other. At any moment each file there is whole.
    Files with other names stay.

    Raises BadInputError if a file cannot be written. An OSError about a file elsewhere is not changed.
    """
    with _os_errors_about(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=PREFIX, dir=folder.parent))
    try:
        with _os_errors_about(folder, own=(draft,)):
            yield draft
        with _os_errors_about(folder):
            _move_files(draft, folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


@contextmanager
def _os_errors_about(path: Path, remedy: str = "", own: Sequence[Path] = ()) -> Iterator[None]:
    """Turn an OSError of the block into a BadInputError about `path`.

    `own`: files and folders that the block writes. If given, an OSError that names a file elsewhere is not changed.
    """
    try:
        yield
    except OSError as error:
        named = Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes | os.PathLike) else None
        if own and named is not None and not any(named.is_relative_to(place) for place in own):
            raise
        raise BadInputError.of_os_error(path, error, WRITABLE, remedy) from error


def _move_files(source: Path, target: Path) -> None:
    files = sorted(source.iterdir())
    for file in files:
        _flush(file)
    target.mkdir(exist_ok=True)
    for file in files:
        file.replace(target / file.name)


def _flush(file: Path) -> None:
    """Force the content of `file` to the disk: after a power failure, a renamed file must not be incomplete."""
    fd = os.open(file, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
