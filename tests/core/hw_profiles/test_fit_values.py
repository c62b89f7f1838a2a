"""The fit's parts by hand: what is measured, what the residuals say, and the file that is written, to the letter."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles import fit
from trilane.hw_profiles.fit import (
    STEPS,
    UNIT_OF_COLUMN,
    Measurement,
    ProfileFit,
    Residual,
    Step,
    as_toml,
    measurements,
    with_factors,
)
from trilane.hw_profiles.reference_networks import ConfigurationRow


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
        Measurement(rows[0], "bench_dsp_ms", 5.0),
        Measurement(rows[0], "app_dsp_ms", 23.0),
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
    numbers = {
        "units.dsp.job_fixed_ms": (0.123456, 0.0361),
        "memory.use": (0.5, 1.0),
        "units.dsp.efficiency.resize": (1234.56, 0.25),
        "units.dsp.a": (2.0, 0.5),
    }
    found = as_toml(
        ProfileFit({}, numbers, RESIDUALS, 7), "mine", 'The "best"', "base", "trilane profiles fit --from x.csv"
    )
    number = 'kind = "fitted", spread = {}, source = "profiles fit --from x.csv" }}'
    assert found.splitlines() == [
        "# Written by `trilane profiles fit --from x.csv`: 7 numbers from 5 measurements.",
        "# `spread` is what the fit leaves open, as the standard deviation of the logarithm.",
        'extends = "base"',
        'name = "mine"',
        'title = "The \\"best\\""',
        "",
        "[memory]",
        "use = { value = 0.5, " + number.format("1"),
        "",
        "[units.dsp]",
        "a = { value = 2, " + number.format("0.5"),
        "job_fixed_ms = { value = 0.1235, " + number.format("0.036"),
        "",
        "[units.dsp.efficiency]",
        "resize = { value = 1235, " + number.format("0.25"),
    ]
    assert found.endswith("}\n")


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


def keys(unit: str, *names: str) -> tuple[str, ...]:
    return tuple(f"units.{unit}.efficiency.{name}" for name in names)


def test_the_steps_of_the_fit() -> None:
    engine = ("rates.arithmetic_tmac_s", "rates.spill_gb_s", "factors.normalisation")
    own = ("input_ns_per_element", "permute_fixed_ms", "fallback_ns_per_element")
    dsp: set[tuple[str, ...]] = {(f"units.dsp.engines.int8_tflite.{name}",) for name in engine}
    gpu = {keys("gpu", "convolution", "pointwise"), keys("gpu", "depthwise_traffic", "pointwise_traffic")}
    gpu |= {keys("gpu", "normalisation"), keys("gpu", "permute")}
    found = [(step.name, step.columns, {frozenset(free) for free in step.free}, step.noise) for step in STEPS]
    wanted: list[tuple[str, tuple[str, ...], set[tuple[str, ...]], float]] = [
        ("network on the DSP", ("bench_dsp_ms",), dsp | {(f"units.dsp.{name}",) for name in own}, 0.04),
        ("network on the GPU", ("bench_gpu_ms",), gpu | {(f"units.gpu.{name}",) for name in own[:2]}, 0.12),
        (
            "application",
            ("app_dsp_ms", "app_gpu_ms"),
            {("application.readback_ns_per_byte",), ("application.handover_ms",), ("memory.application_use_fraction",)},
            0.1,
        ),
    ]
    assert found == [
        (name, columns, {frozenset(each) for each in free}, noise) for name, columns, free, noise in wanted
    ]
    assert {f"{what}_{unit}_ms": unit for what in ("bench", "app") for unit in ("dsp", "gpu")} == UNIT_OF_COLUMN


def test_a_measurement_is_predicted_as_it_was_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit, "corners_of", lambda profile, name: (profile, name))
    monkeypatch.setattr(fit, "reference_network", lambda spec: f"network of {spec}")
    monkeypatch.setattr(fit, "Plan", lambda *words: words)
    monkeypatch.setattr(fit, "reference_frame_ms", lambda *words: ("frame", *words))
    monkeypatch.setattr(fit, "isolated_job_time", lambda *words: SimpleNamespace(total_ms=("job", *words)))
    profile: Any = "chip"
    corners = ("chip", "sustained_high_performance")
    found = fit.predicted_ms(profile, Measurement(row(), "bench_gpu_ms", 1.0))
    assert found == ("job", "chip", "network of spec", "gpu", corners)  # type: ignore[comparison-overlap]
    found = fit.predicted_ms(profile, Measurement(row(), "app_dsp_ms", 1.0))
    assert found == ("frame", "chip", ("network of spec", "dsp"), corners)  # type: ignore[comparison-overlap]
