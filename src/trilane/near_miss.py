"""What a person may have meant with a word that is not known.

Rule: at most one word is suggested, and none that is not near; the words that are known are the caller's.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """`did you mean 'x'?` for the word of `known` that is most like `word`, as a remedy; empty when none is near.

    `prefix`: stands before the word that is suggested; `word` and `known` are compared without.
    """
    near = get_close_matches(word, list(known), n=1)
    return f"did you mean {prefix + near[0]!r}?" if near else ""
