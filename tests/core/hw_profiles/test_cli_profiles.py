"""`trilane profiles`: each table, each document and each refusal; fits are doubles."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trilane.apps.cli import profiles as cli
from trilane.hw_profiles import fit as fit_module
from trilane.hw_profiles.fit import ProfileFit, Residual
from trilane.hw_profiles.fit_engines import check_published
from trilane.hw_profiles.profile_files import load_profile, profile_names
from trilane.hw_profiles.reference_networks import ConfigurationRow, NetworkSpec

Command = Callable[..., tuple[str, str]]


def cells(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in text.splitlines()]


def test_profiles_are_listed_shown_and_checked(command: Command) -> None:
    """But for templates, which are no chips: they are valid, and no latency was published of them."""

    def document(*words: str) -> Any:
        return json.loads(command("profiles", *words, "--json")[0])

    chips = [chip for chip in map(load_profile, profile_names()) if not chip.template]
    assert document("list")["profiles"] == [
        {"name": chip.name, "title": chip.title, "units": {name: unit.title for name, unit in chip.units.items()}}
        for chip in chips
    ]
    row = ["qcs6490", "Dragonwing QCS6490", "Adreno 643, 812 MHz", "Hexagon (V68)"]
    assert row in cells(command("profiles", "list")[0])
    template = load_profile("phone-template")
    assert document("show", "phone-template") == template.model_dump(mode="json")
    shown = cells(command("profiles", "show", "phone-template")[0])
    assert ["memory.bandwidth_gb_s", "unknown", "", "unknown", "set by the chip"] in shown
    assert ["memory.application_use_fraction", "0.15", "60", "assumed"] in [each[:4] for each in shown]
    latencies = check_published("snapdragon-8-gen-1", load_profile("snapdragon-8-gen-1"))
    assert document("check", "phone-template", "snapdragon-8-gen-1") == {
        "valid": ["phone-template", "snapdragon-8-gen-1"],
        "published": [{**latency._asdict(), "error": latency.error} for latency in latencies],
    }
    assert command("profiles", "check", "phone-template") == ("1 valid: phone-template\n", "")
    first = latencies[0]
    assert [
        *("snapdragon-8-gen-1", "unet", "tflite", "54.07", f"{first.predicted_ms:.2f}", f"{100 * first.error:+.0f} %"),
        "among the rows of the fit",
    ] in cells(command("profiles", "check", "snapdragon-8-gen-1")[0])


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
