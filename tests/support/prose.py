"""Plain English, held by rules: sentences of pages, helps and messages, and what breaks the rules of prose.toml.

Pages are parsed by markdown-it, so code blocks, links' targets and the marks of tables are no prose. Each cell, item
and paragraph begins a sentence.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from markdown_it import MarkdownIt
from markdown_it.token import Token

from trilane.apps.cli.main import COMMANDS, command_of

ROOT = Path(__file__).resolve().parents[2]
RULES_FILE = ROOT / "tests" / "core" / "prose.toml"
DATA = tomllib.loads(RULES_FILE.read_text(encoding="utf-8"))
MOST_WORDS, MEAN_WORDS = DATA["most_words"], DATA["mean_words"]
#: A sentence ends before a capital letter, a bracket, a quotation or code; not after a short word.
END = re.compile(r"(?<=[.!?])(?<!e\.g\.)(?<!i\.e\.)(?<!vs\.)[”\")]*\s+(?=[A-Z“\"(`*√0-9])")
WORD = re.compile(r"[^\W_][\w’'.,/:+%°²-]*")
#: What a string of code needs to be a message: four words, the first of which begins it.
MESSAGE = re.compile(r"[A-Za-z`'{][^\n]*? [^\n]*? [^\n]*? [^\n]*")


class Rule(NamedTuple):
    """`pattern` finds what `remedy` says how to write; `examples` are sentences that it finds.

    `but_in`: the page that may say it, because it lists such words.
    """

    name: str
    pattern: re.Pattern[str]
    remedy: str
    examples: tuple[str, ...]
    but_in: str = ""


class Finding(NamedTuple):
    """One place to write better: `where` is a page or a file of code."""

    where: str
    rule: str
    sentence: str


RULES = [
    Rule(**each | {"pattern": re.compile(each["pattern"]), "examples": tuple(each["examples"])})
    for each in DATA["rules"]
]


def plain(inline: Token) -> str:
    """The text of a paragraph, a heading or a cell, with code as `code`."""
    shown = {"text": "{}", "code_inline": "`{}`", "softbreak": " ", "hardbreak": " "}
    return "".join(shown.get(each.type, "").format(each.content) for each in inline.children or ())


def sentences(text: str) -> list[str]:
    return [each.strip() for each in END.split(text) if each.strip()]


def page_sentences(page: str) -> Iterator[str]:
    """Every sentence of a page in Markdown, in order, without headings."""
    tokens = MarkdownIt("commonmark").enable("table").parse(page)
    for before, token in pairwise(tokens):
        if token.type == "inline" and before.type != "heading_open":
            yield from sentences(plain(token))


def message_sentences(source: str) -> Iterator[str]:
    """Every sentence of strings of Python that are no docstrings; what is put into an f-string is `…`."""
    tree = ast.parse(source)
    held = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr | ast.Expr)
        for part in (node.values if isinstance(node, ast.JoinedStr) else [node.value])
    }
    for node in ast.walk(tree):
        text = ""
        if isinstance(node, ast.JoinedStr):
            text = "".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values)  # type: ignore[misc]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in held:
            text = node.value
        if MESSAGE.match(text) and "\n" not in text:
            yield from sentences(text)


def commands() -> Iterator[tuple[str, Any]]:
    """Every command and its name, as `avatar train`, with groups before what is in them."""
    for name in COMMANDS:
        yield from below(name, command_of(name))


def below(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    yield name, command
    for part, inner in getattr(command, "commands", {}).items():
        if inner.callback is not None:  # otherwise it stands in for a bench, and has one line
            yield from below(f"{name} {part}", inner)


def help_sentences() -> Iterator[str]:
    """Every sentence of the helps: of commands, arguments and options."""
    for _, command in commands():
        texts = [command.help, *(getattr(parameter, "help", None) for parameter in command.params)]
        for text in filter(None, texts):
            for paragraph in re.split(r"\n\s*\n", text.split("\b")[0].split("\f")[0]):
                yield from sentences(" ".join(paragraph.split()))


def words(sentence: str) -> int:
    return len(WORD.findall(re.sub(r"`[^`]*`", "code", sentence)))


def findings(where: str, found: list[str]) -> Iterator[Finding]:
    """What the rules find in sentences of one page or file."""
    for sentence in found:
        yield from (
            Finding(where, rule.name, sentence)
            for rule in RULES
            if where != rule.but_in and rule.pattern.search(sentence)
        )
        if words(sentence) > MOST_WORDS:
            yield Finding(where, "long", sentence)


def kind_of(where: str) -> str:
    """Records of decisions, pages, helps or messages: each kind has its own bound for long sentences."""
    if where.endswith(".md"):
        return "records" if where.startswith("docs/decisions/") else "pages"
    return "helps" if where == "--help" else "messages"


def texts() -> dict[str, list[str]]:
    """Path below the repository to the sentences of each page, of the helps, and of each file of code with messages."""
    pages = [ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    found = {str(page.relative_to(ROOT)): list(page_sentences(page.read_text(encoding="utf-8"))) for page in pages}
    found["--help"] = list(dict.fromkeys(help_sentences()))
    package = ROOT / "src" / "trilane"  # its folders are links
    for file in sorted([*package.glob("*.py"), *(file for each in package.iterdir() for file in each.rglob("*.py"))]):
        path = file.resolve().relative_to(ROOT)
        found[str(path)] = list(message_sentences(file.read_text(encoding="utf-8")))
    return found


def main() -> None:
    """Print what the rules find, or with words only in paths that hold one of them; last the counts by rule."""
    asked = sys.argv[1:]
    counts: Counter[str] = Counter()
    for where, found in texts().items():
        if not asked or any(word in where for word in asked):
            for finding in findings(where, found):
                counts[finding.rule] += 1
                print(f"{finding.where}: {finding.rule}: {finding.sentence}")
    print(dict(counts.most_common()))


if __name__ == "__main__":
    main()
