"""Faults of shaders and tables. Rule: a table of patterns, each with what it becomes; comments stay as they are."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

from trilane.testing.mutants.fault import Edit

Made = str | Callable[[re.Match[str]], str]


class Rule(NamedTuple):
    """`kind`, the pattern, and what its match becomes."""

    kind: str
    pattern: re.Pattern[str]
    made: tuple[Made, ...]


def _number(match: re.Match[str]) -> str:
    """A number that differs by one in its last place."""
    digits = match[0]
    places = len(digits.partition(".")[2])
    return f"{float(digits) + 10.0**-places:.{places}f}" if "." in digits else str(int(digits) + 1)


def _larger(match: re.Match[str]) -> str:
    """A number a quarter larger, and by one where that would be the same."""
    value = float(match[0].replace("_", ""))
    return repr(int(value * 1.25) if value > 3 else int(value) + 1) if match[0].isdigit() else repr(value * 1.25 or 1.0)


def _reversed(match: re.Match[str]) -> str:
    return f".{match[1][::-1]}"


def _exchanged(match: re.Match[str]) -> str:
    return f"{match[1]}({match[3].strip()}, {match[2].strip()}"


def _rule(kind: str, pattern: str, *made: Made) -> Rule:
    return Rule(kind, re.compile(pattern, re.MULTILINE), made)


GLSL = (
    _rule("Number", r"(?<![\w.])\d+\.\d+|(?<![\w.])\d+(?![\w.])", _number),
    _rule("Operator", r"(?<=[\w)\]] )\+(?= )", "-"),
    _rule("Operator", r"(?<=[\w)\]] )-(?= )", "+"),
    _rule("Operator", r"(?<=[\w)\]] )\*(?= )", "/"),
    _rule("Operator", r"(?<=[\w)\]] )/(?= )", "*"),
    _rule("Comparison", r"(?<= )<=(?= )", "<", ">"),
    _rule("Comparison", r"(?<= )>=(?= )", ">", "<"),
    _rule("Comparison", r"(?<= )<(?= )", "<=", ">"),
    _rule("Comparison", r"(?<= )>(?= )", ">=", "<"),
    _rule("Comparison", r"(?<= )==(?= )", "!="),
    _rule("Logic", r"&&", "||"),
    _rule("Logic", r"\|\|", "&&"),
    _rule("Swizzle", r"\.([xyzw]{2,4}|[rgba]{2,4})\b", _reversed),
    _rule("Component", r"\.x\b", ".y"),
    _rule("Component", r"\.y\b", ".x"),
    _rule("Component", r"\.([zw])\b", ".x"),
    _rule("Function", r"\bround(?=\()", "floor"),
    _rule("Function", r"\bfloor(?=\()", "round", "ceil"),
    _rule("Function", r"\bmin(?=\()", "max"),
    _rule("Function", r"\bmax(?=\()", "min"),
    _rule("Function", r"\b(?:abs|normalize)(?=\()", ""),
    _rule("Function", r"\bsin(?=\()", "cos"),
    _rule("Function", r"\bcos(?=\()", "sin"),
    _rule("Arguments", r"\b(\w+)\(([^(),]+),\s*([^(),]+)(?=[,)])", _exchanged),
    _rule("Sign", r"(?<=[=(,] )-(?=[\w(])|(?<=\()-(?=[\w(])", ""),
    _rule("StatementForgotten", r"^( +)[\w.\[\]]+ (?:[-+*/]?=) [^;]+;$", lambda match: f"{match[1]};"),
)

TOML = (
    _rule("Number", r"(?<![\w.\"'-])\d[\d_]*(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.\"'-])", _larger),
    _rule("Boolean", r"\btrue\b", "false"),
    _rule("Boolean", r"\bfalse\b", "true"),
    _rule("RowForgotten", r"^[\w\"'.-]+ *= *[^\n\[{]+\n", ""),
)
COMMENT = {".vert": "//", ".frag": "//", ".toml": "#"}


def text_faults(text: str, suffix: str) -> list[Edit]:
    """Every fault that can be put into a shader (`.vert`, `.frag`) or table (`.toml`)."""
    rules = TOML if suffix == ".toml" else GLSL
    return [edit for rule in rules for edit in _by_rule(text, rule, COMMENT[suffix])]


def _by_rule(text: str, rule: Rule, comment: str) -> Iterator[Edit]:
    for match in rule.pattern.finditer(text):
        begin = text.rfind("\n", 0, match.start()) + 1
        head = text[begin : match.start()]
        if comment in head or (rule.kind != "RowForgotten" and head.count('"') % 2):
            continue
        if head.lstrip().startswith(("#version", "layout", "source", "note")):
            continue
        for made in rule.made:
            new = made if isinstance(made, str) else made(match)
            if new != match[0]:
                yield Edit(text.count("\n", 0, match.start()) + 1, rule.kind, partial(_replaced, text, match, new))


def _replaced(text: str, match: re.Match[str], new: str) -> str:
    return text[: match.start()] + new + text[match.end() :]
