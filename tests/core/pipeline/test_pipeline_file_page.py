"""docs/pipeline-file.md has its tables of keys from the fields of the model.

Rule: TRILANE_WRITE_PRINTED=1 writes the tables again; read their difference before committing it.
"""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path

from support.pipeline_files import write_file
from trilane.pipeline.file_keys import (
    BLOCKS,
    BlockStage,
    BypassKeys,
    InputKeys,
    Keys,
    OnnxStage,
    PythonStage,
    RunKeys,
    StageKeys,
    StageTime,
    UnitKeys,
)
from trilane.pipeline.pipeline_file import read_pipeline

PAGE = Path(__file__).resolve().parents[3] / "docs" / "pipeline-file.md"
MODELS: dict[str, type[Keys]] = {
    "run": RunKeys,
    "units": UnitKeys,
    "stage": StageKeys,
    "input": InputKeys,
    "bypass": BypassKeys,
    "time": StageTime,
    "onnx": OnnxStage,
    "python": PythonStage,
}
MARK = re.compile(r"<!-- keys: (\w+) -->\n(?:\|.*\n)*")


def rows(model: type[Keys], base: type[Keys] | None = None, block: str = "") -> list[str]:
    """A row for each key of `model` that `base` does not have."""
    known = base.model_fields if base else {}
    found = {name: field for name, field in model.model_fields.items() if name not in known}
    texts = {(field.alias or name): field.description or "" for name, field in found.items()}
    first = f"| `{block}` " if block else ""
    return [f"{first}| `{key}` | {text.rstrip('.')} |" for key, text in texts.items()]


def table(name: str) -> str:
    if name == "blocks":
        lines = ["| block | key | meaning |", "|---|---|---|"]
        for block, model in BLOCKS.items():
            what = (model.__doc__ or "").partition("\n")[0].rstrip(".")
            lines += [f"| `{block}` | | {what} |", *rows(model, BlockStage, block)]
    else:
        base = StageKeys if issubclass(MODELS[name], StageKeys) and name != "stage" else None
        lines = ["| key | meaning |", "|---|---|", *rows(MODELS[name], base)]
    return "\n".join([f"<!-- keys: {name} -->", *lines, ""])


def test_the_tables_are_those_of_the_fields() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert set(MARK.findall(text)) == {*MODELS, "blocks"}
    written = MARK.sub(lambda mark: table(mark[1]), text)
    if os.environ.get("TRILANE_WRITE_PRINTED"):
        PAGE.write_text(written, encoding="utf-8")
    else:
        assert text == written


def test_every_key_says_what_it_means() -> None:
    for name in (*MODELS, "blocks"):
        assert not re.search(r"\|  \|$", table(name), re.MULTILINE), name


def test_every_default_that_is_a_word_or_a_number_is_said() -> None:
    models = [*MODELS.values(), *BLOCKS.values()]
    fields = {(model, name): field for model in models for name, field in model.model_fields.items()}
    chosen = {key: field for key, field in fields.items() if isinstance(field.default, str | float) and field.default}
    assert {name for _, name in chosen} == {"policy", "sync", "runtime", "fit", "alpha"}
    for (model, name), field in chosen.items():
        assert f"if absent, {field.default}." in (field.description or "").lower(), (model, name)


def test_the_files_of_the_page_can_be_read(tmp_path: Path) -> None:
    examples = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(examples) == 3
    for example in examples:
        file = read_pipeline(write_file(tmp_path, example))
        assert set(file.stages) == set(tomllib.loads(example)["stages"])
