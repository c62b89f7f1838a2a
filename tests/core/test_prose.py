"""Pages, helps and messages keep the rules of plain English in prose.toml."""

from __future__ import annotations

from collections import Counter
from functools import cache

import pytest

from support.prose import (
    DATA,
    MEAN_WORDS,
    RULES,
    Finding,
    findings,
    kind_of,
    message_sentences,
    page_sentences,
    sentences,
    texts,
    words,
)

#: Read by the first test that asks: every worker imports this file, and one runs it.
read_texts = cache(texts)


def test_no_rule_but_that_of_length_finds_anything() -> None:
    found = [each for where, told in read_texts().items() for each in findings(where, told) if each.rule != "long"]
    assert found == [], "\n".join(f"{each.where}: {each.rule}: {each.sentence}" for each in found)


def test_long_sentences_only_become_fewer() -> None:
    long = Counter(
        kind_of(where) for where, told in read_texts().items() for each in findings(where, told) if each.rule == "long"
    )
    assert {kind: count for kind, count in long.items() if count > DATA["most_long"][kind]} == {}


def test_a_sentence_of_a_page_has_few_words_in_the_mean() -> None:
    whole = [
        each for where, told in read_texts().items() if where.endswith(".md") for each in told if each[-1] in ".?!:"
    ]
    lengths = [words(each) for each in whole]
    assert len(lengths) > 3000
    assert sum(lengths) / len(lengths) <= MEAN_WORDS


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_rule_finds_its_examples_and_not_their_remedies(rule: object) -> None:
    assert isinstance(rule, type(RULES[0]))
    for example in rule.examples:
        assert rule.pattern.search(example), example
    sound = [
        "The interval stands beside it.",
        "If you change a file, begin again.",
        "What is a unit?",
        "What it costs.",
    ]
    assert [each for each in sound if rule.pattern.search(each)] == []


def test_sentences_of_a_page_are_its_prose() -> None:
    page = "# Title. Not this.\n\nOne sentence, e.g. `this one. `two`. It ends in 4. Next [link. x](a.md) ends.\n"
    page += "\n- An item.\n\n```\nNo code. Here.\n```\n\n| a cell | it is. And this |\n|---|---|\n| b | c |\n"
    assert list(page_sentences(page.replace("`this one. `two`", "`code`"))) == [
        "One sentence, e.g. `code`.",
        "It ends in 4.",
        "Next link. x ends.",
        "An item.",
        "a cell",
        "it is.",
        "And this",
        "b",
        "c",
    ]
    assert sentences("A 1. B") == ["A 1.", "B"]


def test_sentences_of_code_are_its_messages() -> None:
    source = '"""A doc of the module."""\nx = "short"\ny = f"the file {x} is not there. Name it"\n'
    assert list(message_sentences(source)) == ["the file … is not there.", "Name it"]
    assert words("two `a b c` words of 3.5") == 5
    assert list(findings("p", ["word " * 26])) == [Finding("p", "long", "word " * 26)]
