"""The keys of `--json` and of report.json stay what programs read: as json_keys.toml has them, none lost, none new.

Rule: every command that takes `--json` is in json_keys.toml, and is run with its cheapest arguments in a process of its
own; its stdout is one JSON document. These processes are forked from one that has imported what they need, which takes
longer than most of the commands. What the lines of the file mean stands at its head.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

from support.small_inputs import validated
from support.told_journal import told_journal
from trilane import machine
from trilane.apps.cli import main as cli
from trilane.avatars.bundle import load_bundle, write_manifest
from trilane.pipeline.journal import NAME as JOURNAL
from trilane.pipeline.journal import Counted, JournalWriter

FILE = Path(__file__).with_name("json_keys.toml")
DATA = tomllib.loads(FILE.read_text(encoding="utf-8"))
#: Calls the command of each line of stdin, in a process of its own, and prints its exit code.
COMMANDS = """
import importlib, json, os, sys
from trilane.apps.cli import main
from trilane.stages import PRELOAD

for module in ("onnx", "onnxruntime", "rich.table", *PRELOAD, *(module for module, _ in main.COMMANDS.values())):
    importlib.import_module(module)
for line in sys.stdin:
    folder, arguments = json.loads(line)
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        for number, name in enumerate(("/dev/null", "stdout", "stderr")):
            os.dup2(os.open(name, os.O_RDWR | (os.O_CREAT | os.O_TRUNC) * (number > 0)), number)
        sys.argv[1:] = arguments
        main.entry()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""

#: Names from the document's root to a key; those of lists end in `[]` where an entry of theirs is meant.
Names = tuple[str, ...]


@dataclass(frozen=True)
class Case:
    """A command of the file; the fields are described at the file's head."""

    name: str
    table: str
    arguments: list[str]
    keys: list[str]
    files: dict[str, list[str]] = field(default_factory=dict)
    needs: list[str] = field(default_factory=list)
    after: str = ""
    exits: list[int] = field(default_factory=lambda: [0])
    seconds: int = 0

    @property
    def line(self) -> str:
        return " ".join(["trilane", *self.arguments, "--json"])


CASES = {name: Case(name, table, **fields) for table in ("commands", "slow") for name, fields in DATA[table].items()}


@dataclass
class Place:
    """A folder with everything that the commands read, and the process that calls them. Each is run in it once."""

    folder: Path
    commands: subprocess.Popen[str]
    printed: dict[str, str] = field(default_factory=dict)

    def run(self, case: Case) -> str:
        """What the command prints on stdout."""
        if case.after:
            self.run(CASES[case.after])
        if case.name not in self.printed:
            assert self.commands.stdin is not None and self.commands.stdout is not None
            print(json.dumps([str(self.folder), [*case.arguments, "--json"]]), file=self.commands.stdin, flush=True)
            code = int(self.commands.stdout.readline())
            said = (self.folder / "stderr").read_text(encoding="utf-8")
            assert code in case.exits, f"{case.line}\nended with {code}: {said}"
            self.printed[case.name] = (self.folder / "stdout").read_text(encoding="utf-8")
        return self.printed[case.name]


@pytest.fixture(scope="module")
def place(
    drawable_bundle: Path,
    tiny_float: onnx.ModelProto,
    tiny_frames: list[NDArray[Any]],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Place]:
    folder = tmp_path_factory.mktemp("keys")
    shutil.copytree(drawable_bundle, folder / "bundle")
    shutil.copytree(drawable_bundle, folder / "unvalidated")
    write_manifest(folder / "bundle", validated(load_bundle(drawable_bundle), size="64x64"))
    onnx.save(tiny_float, folder / "float.onnx")
    np.save(folder / "frames.npy", np.stack(tiny_frames * 3)[:16])
    (folder / "told-run").mkdir()
    with JournalWriter(folder / "told-run" / JOURNAL) as journal:
        begun, records = told_journal()
        for record in (begun, *records, Counted(0, {"died:v": 1}, {"a->b:stale": 1})):
            journal.add(record)
    np.save(folder / "poses.npy", np.zeros((1, 165)))
    for name, text in DATA["inputs"].items():
        (folder / name).write_text(text.lstrip(), encoding="utf-8")
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", COMMANDS], **pipes) as commands:
        yield Place(folder, commands)


def one_document(text: str, where: str) -> Any:
    """The JSON document that `text` is; fails when it is none, or more than one, or holds what JSON has not."""

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is no JSON")

    try:
        return json.loads(text, parse_constant=refuse)
    except ValueError as error:
        wrong = str(error)
    pytest.fail(f"{where}: expected one JSON document and nothing else: {wrong}; found:\n{text[:500]}", pytrace=False)


def names_in(value: Any, above: Names = ()) -> Iterator[Names]:
    """Every key in a document."""
    if isinstance(value, dict):
        for key, below in value.items():
            yield (*above, key)
            yield from names_in(below, (*above, key))
    elif isinstance(value, list) and above:
        for entry in value:
            yield from names_in(entry, (*above[:-1], f"{above[-1]}[]"))


def listed(lines: list[str]) -> Iterator[Names]:
    """The keys that lines of the file stand for, parts put in, each after those above it."""
    for line in lines:
        pieces = re.split(r"\{(.*?)\}", line)
        for chosen in product(*(piece.split(",") if place % 2 else [piece] for place, piece in enumerate(pieces))):
            *above, last = "".join(chosen).split(".")
            ends = listed(DATA["parts"][last[1:]]) if last.startswith("@") else [(last,)]
            for names in ((*above, *end) for end in ends):
                for count in range(1, len(names) + 1):
                    yield (*names[: count - 1], names[count - 1].removesuffix("[]"))


def same(found: Names, meant: Names) -> bool:
    """Is the key `found` the one that the file has as `meant`?"""
    pairs = zip(found, meant, strict=False)
    return len(found) == len(meant) and all(
        own in (name, f"{name}?") or own.removesuffix("?") == "*" for name, own in pairs
    )


def written(names: Names) -> str:
    return ".".join(names)


def differences(document: Any, lines: list[str]) -> list[str]:
    """A line for every key that is missing in the document, or new."""
    found = dict.fromkeys(names_in(document))
    meant = dict.fromkeys(listed(lines))
    missing = [
        written(names)
        for names in meant
        if not any(name.endswith("?") for name in names) and not any(same(each, names) for each in found)
    ]
    new = [written(names) for names in found if not any(same(names, each) for each in meant)]
    return [*(f"  missing: {key}" for key in missing), *(f"  new:     {key}" for key in new)]


def check(document: Any, lines: list[str], what: str, where: str) -> None:
    wrong = differences(document, lines)
    if wrong:
        pytest.fail(
            "\n".join(
                [
                    f"{what}: other keys than {FILE.name} has",
                    *wrong,
                    "Programs read these keys: give a missing one its name back.",
                    f"If a change is meant, write it in tests/process/{FILE.name} under {where}: a line for a new key",
                    "(`*` for a name that is data, `?` after one that may be absent), none for one that is gone,",
                    "and say so in CHANGELOG.md.",
                ]
            ),
            pytrace=False,
        )


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (case.table == "slow")) for name, case in CASES.items()]
)
def test_the_keys_are_those_of_the_file(name: str, place: Place) -> None:
    case = CASES[name]
    for package in case.needs:
        if not machine.here.has_package(package):
            pytest.skip(f"{case.line}: needs the package {package}, which is absent")
    document = one_document(place.run(case), case.line)
    heading = f'[{case.table}."{name}"]'
    check(document, case.keys, case.line, f"`keys` of {heading}")
    for file, keys in case.files.items():
        inside = one_document((place.folder / file).read_text(encoding="utf-8"), file)
        check(inside, keys, f"{case.line}\n{file}, which it writes", f"`files` of {heading}")


def commands_with_json(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str
) -> Iterator[Names]:
    """The words of every command below `words` whose help names `--json`."""
    monkeypatch.setattr(sys, "argv", ["trilane", *words, "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    text = capsys.readouterr().out
    if "--json " in text.partition("Examples:")[0]:
        yield words
    _, _, below = text.partition("\nCommands:\n")
    for name in re.findall(r"^  (\S+)", below.partition("\n\n")[0], re.MULTILINE):
        yield from commands_with_json(monkeypatch, capsys, *words, name)


def test_every_command_that_takes_json_is_in_the_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    there = set(commands_with_json(monkeypatch, capsys))
    held = {tuple(case.arguments[: len(words)]) for case in CASES.values() for words in there}
    absent = [" ".join(("trilane", *words)) for words in sorted(there - held)]
    assert len(there) > 30
    assert not absent, f"no entry in {FILE.name} for {', '.join(absent)}: add one under [commands], see the file's head"


def test_a_key_that_is_lost_or_new_or_renamed_is_named() -> None:
    lines = ["rows[].{way,ms}", "units.*.busy", "absent?.simpy"]
    good = {"rows": [{"way": "a", "ms": 1}], "units": {"cpu": {"busy": 1}, "a.b": {"busy": 1}}}
    assert differences(good, lines) == []
    assert differences(good | {"absent": {"simpy": "why"}}, lines) == []
    assert differences(good | {"rows": []}, lines) == ["  missing: rows[].way", "  missing: rows[].ms"]
    assert differences(good | {"rows": [{"way": "a", "us": 1}]}, lines) == [
        "  missing: rows[].ms",
        "  new:     rows[].us",
    ]
    assert differences(good | {"units": {"cpu": {}}}, lines) == ["  missing: units.*.busy"]
    assert differences(good | {"absent": {"other": 1}, "x": 1}, lines) == ["  new:     absent.other", "  new:     x"]
