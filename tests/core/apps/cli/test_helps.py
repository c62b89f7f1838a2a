"""The help of every command stays what it was, word by word: printed/helps.txt.

Rule: a change is meant when the file is rewritten (`TRILANE_WRITE_PRINTED=1`) and its difference is read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

Command = Callable[..., tuple[str, str]]


def commands(command: Command, *words: str) -> Iterator[tuple[str, ...]]:
    """Every command below `words`, those of benches aside: their defaults are of this machine."""
    yield words
    _, _, below = command(*words, "--help")[0].partition("\nCommands:\n")
    for name in re.findall(r"^  (\S+)", below.partition("\n\n")[0], re.MULTILINE):
        if words != ("bench",):
            yield from commands(command, *words, name)


def test_helps(command: Command, check_printed: Callable[[str, str], None]) -> None:
    texts = [f"$ trilane {' '.join(words)}\n{command(*words, '--help')[0]}" for words in commands(command)]
    assert len(texts) > 20
    check_printed("helps", "\n".join(texts))
