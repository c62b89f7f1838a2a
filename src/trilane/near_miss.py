"""What a person may have meant with a word that is not known.

Rule: at most one word is suggested, and none that is not near; the words that are known are the caller's.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """`did you mean 'x'?` for the word of `known` that is most like `word`, as a remedy; empty when none is near.

    A word whose letters are few beside those of the one that alone begins with it is near, too.

    `prefix`: stands before the word that is suggested; `word` and `known` are compared without.
    """
    words = list(known)
    near = get_close_matches(word, words, n=1) or _only_one([each for each in words if word and each.startswith(word)])
    return f"did you mean {prefix + near[0]!r}?" if near else ""


def _only_one(words: list[str]) -> list[str]:
    return words if len(words) == 1 else []
