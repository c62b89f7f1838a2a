"""The fit: it finds numbers that made the rows, keeps to its priors, and the committed profile is its result."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import Any

import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles import fit as fit_module
from trilane.hw_profiles.fit import (
    STEPS,
    UNIT_OF_COLUMN,
    ProfileFit,
    as_toml,
    fit_profile,
    measurements,
    predicted_ms,
    with_factors,
)
from trilane.hw_profiles.profile_files import load_profile, load_tables, parse_profile
from trilane.hw_profiles.reference_networks import read_table, spec_of

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
    solve, solved = fit_module._solve, dict[str, Any]()

    def once(data: Any, path: Path, step: Any, measured: Any) -> Any:
        if step.name not in solved:
            solved[step.name] = solve(data, path, step, measured)
        return solved[step.name]

    monkeypatch.setattr(fit_module, "_solve", once)
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


def test_the_written_profile_can_be_read(fitted: ProfileFit, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(as_toml(fitted, "mine", "Mine", "snapdragon-888-facts", "trilane profiles fit --from x.csv"))
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
