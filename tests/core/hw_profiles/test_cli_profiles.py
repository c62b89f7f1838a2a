"""`trilane profiles` beside doubles of what reads and fits: each table, each document and each refusal."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.apps.cli import profiles as cli
from trilane.hw_profiles import fit as fit_module
from trilane.hw_profiles import fit_engines, profile_files
from trilane.hw_profiles.fit import ProfileFit, Residual
from trilane.hw_profiles.fit_engines import PublishedTime
from trilane.hw_profiles.reference_networks import ConfigurationRow, NetworkSpec

Command = Callable[..., tuple[str, str]]


def a_number(value: float | None, spread: float | None, kind: str = "fitted") -> dict[str, Any]:
    return {"value": value, "spread": spread, "kind": kind, "source": f"where {value} is from"}


class Profile(SimpleNamespace):
    def model_dump(self, **form: str) -> dict[str, Any]:
        data = {
            "title": self.title,
            "units": {"gpu": {"peak": a_number(1234567.0, 0.126), "names": ["a"]}},
            "base": a_number(0.5, None, "assumed"),
            "unknown": a_number(None, None, "unknown"),
        }
        return data | ({"form": form["mode"]} if form else {})


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    def units(name: str) -> Any:
        return {unit: SimpleNamespace(title=f"{unit} of {name}") for unit in ("dsp", "gpu")}

    def load_profile(name: str) -> Profile:
        return Profile(name=name, title=f"The {name}", template=name == "form", units=units(name))

    def check_published(name: str, profile: Profile) -> list[PublishedTime]:
        assert profile.title == f"The {name}"
        if name != "one":
            return []
        return [
            PublishedTime("one", "unet", "tflite", False, 54.1, 55.678),
            PublishedTime("one", "resnet18", "qnn_dlc", True, 0.5, 0.4),
        ]

    monkeypatch.setattr(profile_files, "load_profile", load_profile)
    monkeypatch.setattr(profile_files, "profile_names", lambda: ["one", "form", "two"])
    monkeypatch.setattr(fit_engines, "check_published", check_published)


@pytest.mark.usefixtures("known")
@pytest.mark.parametrize(
    ("words", "name"),
    [(("list",), "profiles-list"), (("show", "one"), "profiles-show-one"), (("check",), "profiles-check-one")],
)
def test_profiles_are_listed_shown_and_checked(
    words: tuple[str, ...], name: str, command: Command, check_printed: Callable[..., None]
) -> None:
    check_printed(name, command("profiles", *words)[0])
    keys = ("profile", "network", "runtime", "independent", "published_ms", "predicted_ms", "error")
    published = (
        ("one", "unet", "tflite", False, 54.1, 55.678, 55.678 / 54.1 - 1),
        ("one", "resnet18", "qnn_dlc", True, 0.5, 0.4, 0.4 / 0.5 - 1),
    )
    documents = {
        "list": {
            "profiles": [
                {"name": name, "title": f"The {name}", "units": {unit: f"{unit} of {name}" for unit in ("dsp", "gpu")}}
                for name in ("one", "two")
            ]
        },
        "show": Profile(title="The one").model_dump(mode="json"),
        "check": {
            "valid": ["one", "form", "two"],
            "published": [dict(zip(keys, row, strict=True)) for row in published],
        },
    }
    assert json.loads(command("profiles", *words, "--json")[0]) == documents[words[0]]


@pytest.mark.usefixtures("known")
def test_some_profiles_are_checked(command: Command) -> None:
    assert command("profiles", "check", "two", "form") == ("2 valid: two, form\n", "")


def a_fit() -> ProfileFit:
    spec = NetworkSpec("resnet18", "batch", 512, 256, 16, "packed")
    other = NetworkSpec("mobilenetv2", "group", 64, 32, 8, "split")
    rows = [ConfigurationRow("rows.csv: line 2", {}, spec), ConfigurationRow("rows.csv: line 7", {}, other)]
    residuals = (
        Residual("network", rows[0], "bench_gpu_ms", 10.0, 11.0, 12.5),
        Residual("network", rows[1], "bench_gpu_ms", 20.0, 19.0, 14.0),
        Residual("application", rows[1], "app_dsp_ms", 40.0, 40.4, 39.2),
    )
    numbers = {"units.gpu.peak": (12345.678, 0.126), "units.dsp.idle_w": (0.25, 0.5)}
    return ProfileFit({"title": "A Chip, before the fit"}, numbers, residuals, 2)


def test_what_a_fit_prints(
    monkeypatch: pytest.MonkeyPatch, command: Command, check_printed: Callable[..., None]
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(fit_module, "fit_profile", lambda *given: asked.append(given) or a_fit())
    check_printed("profiles-fit", command("profiles", "fit", "--from", "rows.csv")[0])
    document = json.loads(command("profiles", "fit", "--from", "r.csv", "--profile", "mine.toml", "--json")[0])
    assert asked == [("snapdragon-888-facts", Path("rows.csv")), ("mine.toml", Path("r.csv"))]
    assert document == {
        "free_numbers": 2,
        "measurements": 3,
        "medians": {
            "bench_gpu_ms": {"error": pytest.approx(0.075), "left_out_error": pytest.approx(0.275)},
            "app_dsp_ms": {"error": pytest.approx(0.01), "left_out_error": pytest.approx(0.02)},
        },
        "numbers": {
            "units.gpu.peak": {"value": 12345.678, "spread": 0.126},
            "units.dsp.idle_w": {"value": 0.25, "spread": 0.5},
        },
        "residuals": [
            {
                "row": f"rows.csv: line {line}",
                "column": column,
                "measured_ms": measured,
                "fitted_ms": fitted,
                "error": pytest.approx(error),
                "left_out_error": pytest.approx(left_out),
            }
            for line, column, measured, fitted, error, left_out in (
                (2, "bench_gpu_ms", 10.0, 11.0, 0.1, 0.25),
                (7, "bench_gpu_ms", 20.0, 19.0, -0.05, -0.3),
                (7, "app_dsp_ms", 40.0, 40.4, 0.01, -0.02),
            )
        ],
        "note": cli.NOT_KNOWN,
    }


@pytest.mark.parametrize(("words", "name"), [((), "snapdragon-888"), (("--name", "a.b-c_1"), "a.b-c_1")])
def test_a_fitted_profile_is_written(
    words: tuple[str, ...], name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Command
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(fit_module, "fit_profile", lambda *_: a_fit())
    monkeypatch.setattr(fit_module, "as_toml", lambda *given: asked.append(given) or "the text\n")
    monkeypatch.chdir(tmp_path)
    command("profiles", "fit", "--from", "r.csv", "--profile", "mine", "--write", "new.toml", *words)
    head = {"extends": "mine", "name": name, "title": "A Chip"}
    made = ("trilane profiles fit --from r.csv", "2 numbers from 3 measurements")
    assert asked == [(a_fit().numbers, head, *made)]
    assert Path("new.toml").read_text() == "the text\n"


LETTERS = "expected letters, digits, dots, hyphens and underscores"
REFUSED = {
    ("--name", "a b"): f"--name: found 'a b', {LETTERS}",
    ("--name", "a" * 65): f"--name: found '{'a' * 65}', {LETTERS}",
    ("--name", ""): f"--name: found '', {LETTERS}",
    ("--write", "none/new.toml"): "none/new.toml: found no such folder, expected a place that can be written",
}


@pytest.mark.parametrize("options", REFUSED, ids=" ".join)
def test_a_fit_is_refused_before_it_takes_time(
    options: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Command
) -> None:
    def never(*_: Any) -> None:
        raise AssertionError("fitted")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fit_module, "fit_profile", never)
    out, err = command("profiles", "fit", "--from", "r.csv", *options, code=2)
    assert (out, err) == ("", f"error: {REFUSED[options]}\n")
