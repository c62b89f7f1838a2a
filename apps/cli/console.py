"""The output of all commands: data on stdout, messages on stderr, JSON as one document.

Rule: nothing but a command's result goes to stdout, so that `trilane ... --json | jq` always works.
"""

from __future__ import annotations

import errno
import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from textwrap import wrap
from typing import IO, TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

#: Largest number of a run's messages that are shown at its end.
MOST_SHOWN = 5
INDENT = 6  # width of the label before the text in a verdict's line
#: Label of a verdict's first line -> Rich's style.
STYLES = {"PASS": "bold green", "FAIL": "bold red"}
#: Control character (C0, DEL, C1) -> its escape sequence in Python.
_WRITTEN_OUT = {code: repr(chr(code))[1:-1] for code in (*range(0x20), *range(0x7F, 0xA0))}


class _Kept:
    """A wrapper around `stream`. After the terminal was closed, a write raises no error, and its text is lost.

    `lost`: further error numbers that a write ignores. It always ignores EIO, the error for a closed terminal.
    """

    def __init__(self, stream: IO[str], *lost: int) -> None:
        self._stream, self._lost = stream, (errno.EIO, *lost)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with self._hung_up():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with self._hung_up():
            self._stream.flush()

    @contextmanager
    def _hung_up(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno not in self._lost:
                raise


def stderr_console() -> Console:
    """Return Rich's console on stderr, for messages and progress. Writes to a pipe without a reader do not fail."""
    return _console(sys.stderr, errno.EPIPE, stderr=True)


def stdout_console() -> Console:
    """Return Rich's console on stdout, for results in text. If stdout is no terminal, the console has 120 columns."""
    return _console(sys.stdout, width=None if sys.stdout.isatty() else 120)


def _console(stream: IO[str], *lost: int, **settings: Any) -> Console:
    """Return a console that prints texts as they are, in tables too: `[red]` and `:key:` in a name mean nothing."""
    from rich.console import Console

    file = cast("IO[str]", _Kept(stream, *lost))
    return Console(file=file, highlight=False, markup=False, emoji=False, **settings)


def say(text: str) -> None:
    """Print a message on stderr, without wrapping."""
    stderr_console().print(text, soft_wrap=True)


def print_line(text: str) -> None:
    """Print a line of a result on stdout, without wrapping."""
    stdout_console().print(text, soft_wrap=True)


def note(text: str) -> None:
    """Print a note on stderr: a fact that a person should know, although nothing is wrong."""
    say(without_controls(f"note: {text}"))


@contextmanager
def stdout_kept() -> Iterator[None]:
    """Redirect file descriptor 1 to stderr in the `with` block, to keep the output of libraries out of the result."""
    sys.stdout.flush()
    stdout_copy = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(stdout_copy, 1)
        os.close(stdout_copy)


@contextmanager
def spinner(text: str) -> Iterator[None]:
    """Show `text` with a spinner on stderr while the `with` block runs. Without a terminal, nothing is shown."""
    console = stderr_console()
    if not console.is_terminal:
        yield
        return
    from rich.text import Text

    with console.status(Text(text)):
        yield


def without_controls(value: Any) -> Any:
    """Return `value` with escaped control characters in its texts, because a terminal would execute them.

    `value`: text, mapping, list or tuple; nested to any depth. A tuple becomes a list. The keys of mappings are escaped
    too. A value of any other type stays as it is.
    """
    if isinstance(value, str):
        return value.translate(_WRITTEN_OUT)
    if isinstance(value, Mapping):
        return {without_controls(key): without_controls(each) for key, each in value.items()}
    return [without_controls(each) for each in value] if isinstance(value, list | tuple) else value


def shown_messages(messages: Sequence[str], failure: str | None) -> list[str]:
    """Return the first MOST_SHOWN of a run's `messages`, without the message that equals `failure`.

    If more messages are left, a last line states how many. `failure`: cause of the run's failure; None if the run did
    not fail.
    """
    others = [message for message in messages if message != failure]
    more = len(others) - MOST_SHOWN
    return others if more <= 0 else [*others[:MOST_SHOWN], f"{more} more messages: report.json has them"]


def print_kept(parts: Iterable[Any]) -> None:
    """Print `parts`, texts and Rich's tables, on stdout, without wrapping texts.

    A pipe that its reader has closed is no error.
    """
    console = stdout_console()
    with console.capture() as written:
        for part in parts:
            is_text = isinstance(part, str)
            console.print(without_controls(part) if is_text else part, soft_wrap=is_text)
    with suppress(BrokenPipeError):
        sys.stdout.write(written.get())
        sys.stdout.flush()


def print_json(document: Mapping[str, Any]) -> None:
    """Print `document` as JSON on stdout. Raises ValueError for NaN and infinities, which JSON lacks."""
    sys.stdout.write(json.dumps(document, indent=1, allow_nan=False) + "\n")
    sys.stdout.flush()


def verdict_text(lines: Iterable[Sequence[str]], width: int) -> Text:
    """Return the lines of a verdict as one text for a terminal of `width` columns.

    `lines`: pairs of a label, such as `PASS`, and a text. The labels form a column on the left. The texts are wrapped
    to the right of this column.
    """
    from rich.text import Text

    found = Text()
    for label, said in lines:
        room = max(width - INDENT, 1)
        parts = wrap(without_controls(said), room, break_long_words=False, break_on_hyphens=False)
        found.append(f"{label:<{INDENT}}", STYLES.get(label, "bold"))
        found.append(f"\n{'':{INDENT}}".join(parts) + "\n")
    found.rstrip()
    return found


def print_verdict(lines: Iterable[Sequence[str]]) -> None:
    """Print the lines of a verdict, pairs of a label and a text, on stdout."""
    console = stdout_console()
    console.print(verdict_text(lines, console.width), soft_wrap=True)


def print_facts(facts: Mapping[str, Any], as_json: bool) -> None:
    """Print `facts` on stdout: as JSON, or as a table with a row for each key."""
    if as_json:
        print_json(facts)
        return
    from rich.table import Table

    table = Table(show_header=False, box=None)
    for key, value in _flat(facts):
        table.add_row(key, _written(value))
    stdout_console().print(table)


def _written(value: Any) -> str:
    """Return `value` as a text for a table. A float has four significant digits, also in a list or a mapping."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list) and all(isinstance(each, int | float) for each in value):
        return f"[{', '.join(map(_written, value))}]"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_written(each)}" for key, each in value.items())
    return str(value)


def _flat(facts: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the rows of a table of `facts`, each as a key and a value.

    An inner mapping gives a row for each of its keys: outer key, dot, inner key. A list of mappings gives a row for
    each mapping. The key of this row is the mapping's `name`; without a `name`, the key of the list, a dot and a number
    from 1. `prefix`: text before the keys.
    """
    for key, value in facts.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for number, entry in enumerate(value, 1):
                yield entry.get("name", f"{prefix}{key}.{number}"), {k: v for k, v in entry.items() if k != "name"}
        else:
            yield prefix + key, value
