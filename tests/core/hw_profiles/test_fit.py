"""The fit: its parts by hand, numbers that made the rows are found again, and bad tables are named."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from statistics import median
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles import fit
from trilane.hw_profiles.fit import (
    STEPS,
    UNIT_OF_COLUMN,
    ProfileFit,
    Residual,
    Step,
    TableCell,
    as_toml,
    fit_profile,
    measurements,
    predicted_ms,
    with_factors,
)
from trilane.hw_profiles.profile_files import load_profile, load_tables, parse_profile
from trilane.hw_profiles.reference_networks import ConfigurationRow, read_table, spec_of


def row(**cells: str) -> ConfigurationRow:
    spec: Any = "spec"
    return ConfigurationRow("table.csv: line 2", cells, spec)


def test_an_application_is_measured_in_the_middle_of_its_range() -> None:
    rows = [
        row(bench_dsp_ms="5", app_dsp_ms_min="20", app_dsp_ms_max="26", app_gpu_ms_min="3"),
        row(bench_dsp_ms="", app_dsp_ms_min="", app_dsp_ms_max="26"),
    ]
    step = Step("all", ("bench_dsp_ms", "app_dsp_ms", "app_gpu_ms"), (), 0.1)
    assert measurements(rows, step) == [
        TableCell(rows[0], "bench_dsp_ms", 5.0),
        TableCell(rows[0], "app_dsp_ms", 23.0),
    ]


def residual(column: str, measured: float, fitted: float, left_out: float) -> Residual:
    return Residual("a step", row(), column, measured, fitted, left_out)


RESIDUALS = (
    residual("bench_dsp_ms", 10.0, 11.0, 12.0),
    residual("bench_dsp_ms", 10.0, 9.8, 9.0),
    residual("bench_dsp_ms", 10.0, 10.5, 15.0),
    residual("bench_gpu_ms", 100.0, 101.0, 108.0),
    residual("app_dsp_ms", 50.0, 40.0, 30.0),
)


def test_errors_are_relative_and_their_median_is_kept() -> None:
    found = ProfileFit({}, {}, RESIDUALS, 3)
    assert found.columns == ("bench_dsp_ms", "bench_gpu_ms", "app_dsp_ms")
    assert (RESIDUALS[4].error, RESIDUALS[4].left_out_error) == pytest.approx((-0.2, -0.4))
    assert found.median_error("bench_dsp_ms") == pytest.approx(0.05)
    assert found.median_error("bench_dsp_ms", left_out=True) == pytest.approx(0.2)
    assert found.median_error("app_gpu_ms") == 0.0


def test_what_the_residuals_say_of_the_model() -> None:
    """Median errors left out are 0.2 and 0.08; ranges are 1 of 9, 3 of 11 and 2 of 10, by half their middle."""
    rows = [
        row(app_dsp_ms_min="4", app_dsp_ms_max="5", app_gpu_ms_min="4", app_gpu_ms_max="7"),
        row(app_dsp_ms_min="4", app_dsp_ms_max="6", app_gpu_ms_min="4"),
    ]
    found = fit._from_residuals(RESIDUALS, rows)
    assert found.keys() == {
        "units.dsp.model_error_fraction",
        "units.gpu.model_error_fraction",
        "application.ema20_half_range_fraction",
    }
    assert found["units.dsp.model_error_fraction"] == pytest.approx((1.4826 * 0.2, 0.5))
    assert found["units.gpu.model_error_fraction"] == pytest.approx((1.4826 * 0.08, 0.5))
    assert found["application.ema20_half_range_fraction"] == pytest.approx((0.2, 1.0))


def test_factors_multiply_the_values_of_their_keys_in_a_copy() -> None:
    data = {"a": {"b": {"value": 2.0, "kind": "assumed"}, "c": {"value": 3.0}}, "d": {"value": 5.0}}
    assert with_factors(data, (("a.b", "d"), ("a.c",)), (10.0, 0.5)) == {
        "a": {"b": {"value": 20.0, "kind": "assumed"}, "c": {"value": 1.5}},
        "d": {"value": 50.0},
    }
    assert data["d"] == {"value": 5.0}


def test_the_file_of_a_fit() -> None:
    """Values of four digits, spreads of two; whoever reads it finds the command."""
    numbers = {
        "units.dsp.job_fixed_ms": (0.123456, 0.0361),
        "memory.use": (0.5, 1.0),
        "units.dsp.efficiency.resize": (1234.56, 0.25),
    }
    head = {"extends": "base", "name": "mine", "title": 'The "best"'}
    text = as_toml(numbers, head, "trilane profiles fit --from x.csv", "7 numbers from 5 measurements")
    assert text.splitlines()[0] == "# Written by `trilane profiles fit --from x.csv`: 7 numbers from 5 measurements."

    def number(value: float, spread: float) -> dict[str, Any]:
        return {"value": value, "kind": "fitted", "spread": spread, "source": "profiles fit --from x.csv"}

    assert tomllib.loads(text) == {
        **{"extends": "base", "name": "mine", "title": 'The "best"', "memory": {"use": number(0.5, 1)}},
        "units": {"dsp": {"job_fixed_ms": number(0.1235, 0.036), "efficiency": {"resize": number(1235, 0.25)}}},
    }


def test_a_fit_of_one_number_is_the_weighted_mean_of_its_logarithms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Predicted is 2 ms times the factor f. With noise 0.1 and a prior of spread 0.5, log f minimises
    sum (log(2 f / ms) / 0.1)^2 + (log f / 0.5)^2, so it is 100 sum log(ms / 2) / (100 n + 4); its spread the root of
    1 / (100 n + 4)."""
    pytest.importorskip("scipy")
    step = Step("toy", ("bench_dsp_ms",), (("a", "b"),), 0.1)
    monkeypatch.setattr(fit, "STEPS", (step,))
    monkeypatch.setattr(fit, "parse_profile", lambda data, path: SimpleNamespace(data=data, path=path))
    monkeypatch.setattr(fit, "predicted_ms", lambda profile, _: profile.data["a"]["value"])
    monkeypatch.setattr(fit, "_from_residuals", lambda residuals, rows: {"more": (len(residuals), len(rows))})
    data = {"a": {"value": 2.0}, "b": {"value": 7.0, "spread": 9.0}}
    times = [3.0, 4.0, 5.0]
    rows = [row(bench_dsp_ms=str(ms)) for ms in times]

    def best(measured: list[float]) -> float:
        return math.exp(100 * sum(math.log(ms / 2) for ms in measured) / (100 * len(measured) + 4))

    found = fit.fit(data, Path("p.toml"), rows)
    factor = best(times)
    assert found.data["a"]["value"] == pytest.approx(2 * factor) and found.data["b"]["value"] == pytest.approx(
        7 * factor
    )
    assert found.numbers["a"] == pytest.approx((2 * factor, math.sqrt(1 / 304)), rel=1e-5)
    assert found.numbers["b"] == pytest.approx((7 * factor, math.sqrt(1 / 304)), rel=1e-5)
    assert found.numbers["more"] == (3, 3) and found.free_count == 1
    for each, ms in zip(found.residuals, times, strict=True):
        others = [other for other in times if other != ms]
        assert (each.step, each.column, each.measured_ms) == ("toy", "bench_dsp_ms", ms)
        assert (each.fitted_ms, each.left_out_ms) == pytest.approx((2 * factor, 2 * best(others)), rel=1e-5)
    with pytest.raises(BadInputError) as caught:
        fit.fit(data, Path("p.toml"), rows[:1])
    assert str(caught.value) == "p.toml: found 1 measurements, expected more than the 1 free numbers of the toy"


HEADER = (
    "encoder,norm,size,channels,layout,bench_dsp_ms,bench_gpu_ms,"
    "app_dsp_ms_min,app_dsp_ms_max,app_gpu_ms_min,app_gpu_ms_max"
)


@pytest.fixture
def measured(shared_data: Path) -> Path:
    return shared_data / "snapdragon888_measured.csv"


def test_there_are_fewer_free_numbers_than_measurements(measured: Path) -> None:
    rows = read_table(measured)
    for step in STEPS:
        assert len(step.free) < len(measurements(rows, step))


@pytest.mark.parametrize(
    ("columns", "most"),
    [(("bench_dsp_ms",), 0.06), (("bench_gpu_ms",), 0.12), (("app_dsp_ms",), 0.10), (("app_gpu_ms",), 0.10)],
)
def test_the_committed_profile_is_as_near_as_promised(measured: Path, columns: tuple[str, ...], most: float) -> None:
    profile, rows = load_profile("snapdragon-888"), read_table(measured)
    all_measured = [measurement for step in STEPS for measurement in measurements(rows, step)]
    compared = [measurement for measurement in all_measured if measurement.column in columns]
    assert median(abs(predicted_ms(profile, measurement) / measurement.ms - 1) for measurement in compared) <= most


@pytest.mark.slow
def test_fitting_again_gives_the_committed_numbers(fitted: ProfileFit) -> None:
    committed, _ = load_tables("snapdragon-888")
    for key, (value, _) in fitted.numbers.items():
        table = committed
        for part in key.split("."):
            table = table[part]
        assert table["value"] == pytest.approx(value, rel=0.02), key
    for column in UNIT_OF_COLUMN:
        assert fitted.median_error(column) <= fitted.median_error(column, left_out=True) + 1e-9


def test_numbers_that_made_the_rows_are_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows are computed from a profile with known factors; noise-free, the fit predicts rows that it has not seen.

    Each step is solved once: fits that leave a row out are those of the fixture.
    """
    pytest.importorskip("scipy")
    solve, solved = fit._solve, dict[str, Any]()

    def once(data: Any, path: Path, step: Any, measured: Any) -> Any:
        if step.name not in solved:
            solved[step.name] = solve(data, path, step, measured)
        return solved[step.name]

    monkeypatch.setattr(fit, "_solve", once)
    data, path = load_tables("snapdragon-888-facts")
    truth = data
    for step, factor in zip(STEPS, (1.3, 0.8, 1.2), strict=True):
        truth = with_factors(truth, step.free, [factor] * len(step.free))
    profile = parse_profile(truth, path)
    table = tmp_path / "rows.csv"
    seen = [
        *(f"resnet18,batch,{size},{channels},{layout}" for size in (256, 512) for channels in (8, 16)
          for layout in ("packed", "split")),
        "resnet18,instance,512,16,packed",
        "resnet18,group,512,16,packed",
        "mobilenetv2,batch,512,16,packed",
    ]  # fmt: skip
    table.write_text("\n".join([HEADER, *(f"{row},1,1,1,1,1,1" for row in seen)]) + "\n")
    lines = [HEADER]
    for text, row in zip(seen, read_table(table), strict=True):
        predicted = {m.column: predicted_ms(profile, m) for step in STEPS for m in measurements([row], step)}
        times_ms = [
            predicted["bench_dsp_ms"],
            predicted["bench_gpu_ms"],
            *[predicted["app_dsp_ms"]] * 2,
            *[predicted["app_gpu_ms"]] * 2,
        ]
        lines.append(f"{text}," + ",".join(f"{value:.4f}" for value in times_ms))
    table.write_text("\n".join(lines) + "\n")
    result = fit_profile("snapdragon-888-facts", table)
    refitted = parse_profile(result.data, path)
    unseen = tmp_path / "unseen.csv"
    unseen.write_text("\n".join([HEADER, "efficientnet-lite0,instance,640,8,packed,1,1,1,1,1,1"]) + "\n")
    for step in STEPS:
        for measurement in measurements(read_table(unseen), step):
            assert predicted_ms(refitted, measurement) == pytest.approx(predicted_ms(profile, measurement), rel=0.05), (
                measurement.column
            )


@pytest.mark.slow
def test_the_written_profile_can_be_read(fitted: ProfileFit, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    head = {"extends": "snapdragon-888-facts", "name": "mine", "title": "Mine"}
    path.write_text(as_toml(fitted.numbers, head, "trilane profiles fit --from x.csv", "rows"))
    profile = load_profile(str(path))
    assert profile.name == "mine"
    assert not profile.template
    assert profile.units["gpu"].efficiency.convolution.kind == "fitted"


def test_too_few_rows_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("scipy")
    path = tmp_path / "few.csv"
    path.write_text(f"{HEADER}\nresnet18,batch,512,16,packed,16,170,24,25,175,184\n")
    with pytest.raises(BadInputError, match="1 measurements"):
        fit_profile("snapdragon-888-facts", path)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "no rows"),
        ("encoder,norm\nresnet18,batch\n", "size"),
        (f"{HEADER}\nresnet18,batch,512\n", "line 2"),
        (f"{HEADER}\nresnet18,batch,512,16,packed,x,1,1,1,1,1\n", "bench_dsp_ms"),
        (f"{HEADER}\nresnet18,batch,512,16,packed,-1,1,1,1,1,1\n", "above 0"),
        (f"{HEADER}\nresnet18,batch,512,16,packed,nan,1,1,1,1,1\n", "above 0"),
        (f"{HEADER}\nvgg,batch,512,16,packed,1,1,1,1,1,1\n", "vgg"),
        (f"{HEADER}\nresnet18,batch,500,16,packed,1,1,1,1,1,1\n", "multiple of 32"),
        (f"{HEADER}\nresnet18,batch,big,16,packed,1,1,1,1,1,1\n", "big"),
        (f"{HEADER}\nresnet18,batch,512,99,packed,1,1,1,1,1,1\n", "99"),
    ],
)
def test_a_bad_table_is_named_with_its_line(text: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(BadInputError, match=word):
        for row in read_table(path):
            row.number("bench_dsp_ms")


def test_a_range_that_ends_before_it_begins_is_named(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(
        "encoder,norm,size,channels,layout,app_dsp_ms_min,app_dsp_ms_max\nresnet18,batch,256,8,packed,57,55\n"
    )
    (row,) = read_table(path)
    with pytest.raises(BadInputError, match=r"line 2: app_dsp_ms_min: found 57, expected at most app_dsp_ms_max"):
        row.range("app_dsp_ms")


@pytest.mark.parametrize(
    ("text", "fine"), [("16", True), ("0016", True), ("00016", False), ("1.6e1", False), ("", False)]
)
def test_a_number_of_channels_has_four_digits_at_most(text: str, fine: bool) -> None:
    cells = {"encoder": "resnet18", "norm": "batch", "size": "64", "channels": text, "layout": "packed"}
    if fine:
        assert spec_of(cells, "a.csv: line 2").channels == 16
        return
    with pytest.raises(BadInputError, match=f"^a[.]csv: line 2: channels: found '{text}', expected 1 to 16$"):
        spec_of(cells, "a.csv: line 2")
