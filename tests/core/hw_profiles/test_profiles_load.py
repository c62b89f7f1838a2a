"""Hardware profiles as files: what comes with Trilane is valid, and what is wrong is named with file and key."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from trilane.errors import BadInputError
from trilane.hw_profiles import schema
from trilane.hw_profiles.profile_files import (
    load_profile,
    load_runnable,
    merged_tables,
    parse_profile,
    profile_folder,
    profile_names,
)
from trilane.unexpected_value import UnexpectedValue
from trilane.units import UNITS

CHIPS = [name for name in profile_names() if not load_profile(name).template]


def test_lower_corners_are_slower_and_take_less_power() -> None:
    for name in CHIPS:
        profile = load_profile(name)
        for unit in (profile.units[u] for u in UNITS):
            clocks = [unit.clock(corner) for corner in ("max", "turbo", "nominal_plus", "nominal", "svs_plus", "svs")]
            powers = [unit.power_w(corner, 1.0) for corner in ("max", "turbo", "nominal", "svs")]
            assert clocks == sorted(clocks, reverse=True)
            assert powers == sorted(powers, reverse=True)


BAD = {
    "wrong unit of measure": ("[memory]\nbandwidth_mb_s = {Q}", "memory.bandwidth_mb_s", "bandwidth_gb_s"),
    "negative power": ("[units.dsp]\npower_max_w = {N}", "units.dsp.power_max_w", "found -3, expected 0 to 1000"),
    "unknown unit": ('[units.npu]\ntitle = "x"', "units.npu", "'cpu', 'gpu' or 'dsp'"),
    "number without source": ("[units.dsp]\npower_max_w = 3", "units.dsp.power_max_w", "source"),
    "unknown corner": ("[units.dsp.corners]\nwarp = {Q}", "units.dsp.corners.warp", "turbo"),
    "unknown governor": ('[thermal]\ngovernor = "magic"', "thermal.governor", "step_wise"),
    "share above one": ("[memory]\napplication_use_fraction = {Q}", "application_use_fraction", "0.95"),
    "text for a number": ("[units.dsp]\npower_max_w = {T}", "units.dsp.power_max_w.value", "number"),
    "infinite": ("[units.dsp]\npower_max_w = {I}", "units.dsp.power_max_w.value", "finite"),
    "no value": ("[units.dsp]\npower_max_w = {V}", "units.dsp.power_max_w", "no value"),
    "unknown factor": ("[units.dsp.engines.int8_tflite.factors]\nwarp = {Q}", "int8_tflite", "unknown factor `warp`"),
    "limit below the room": ("[thermal]\nskin_limit_c = {Q}", "skin_limit_c", "above"),
}
QUANTITIES = {
    "{Q}": '{ value = 3, kind = "assumed", source = "x" }',
    "{N}": '{ value = -3, kind = "assumed", source = "x" }',
    "{T}": '{ value = "3", kind = "assumed", source = "x" }',
    "{I}": '{ value = inf, kind = "assumed", source = "x" }',
    "{V}": '{ kind = "assumed", source = "x" }',
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_named_with_its_key(case: str, tmp_path: Path) -> None:
    text, key, word = BAD[case]
    for mark, quantity in QUANTITIES.items():
        text = text.replace(mark, quantity)
    path = tmp_path / "mine.toml"
    path.write_text(f'extends = "snapdragon-888"\n{text}\n')
    with pytest.raises(BadInputError) as raised:
        load_profile(str(path))
    message = str(raised.value)
    assert str(path) in message
    assert key in message
    assert word in message


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [
        (schema.Rate, 1e-6, 1e5),
        (schema.Fraction, 1e-6, 1.0),
        (schema.Efficiency, 1e-6, 4.0),
        (schema.Cost, 0.0, 1e6),
        (schema.Power, 0.0, 1000.0),
        (schema.Celsius, -50.0, 200.0),
        (schema.Resistance, 1e-3, 1000.0),
        (schema.Seconds, 1e-3, 1e6),
        (schema.Count, 1.0, 1e6),
    ],
)
def test_a_number_is_within_the_range_of_its_kind(kind: Any, low: float, high: float) -> None:
    """Ends included; a value that is not known is of any kind."""
    reader = TypeAdapter(kind)
    for value in (low, high):
        assert reader.validate_python({"value": value, "kind": "assumed", "source": "s"}).value == value
    for value in (low - 1e-7, high + 1e-3):
        with pytest.raises((ValidationError, UnexpectedValue), match=re.escape(f"{low:g} to {high:g}")):
            reader.validate_python({"value": value, "kind": "assumed", "source": "s"})
    assert reader.validate_python({"kind": "unknown", "source": "s"}).value is None


def test_a_missing_corner_is_named() -> None:
    path = profile_folder() / "snapdragon-888.toml"
    data = merged_tables(path)
    del data["units"]["dsp"]["corners"]["svs"]
    with pytest.raises(BadInputError, match=r"units\.dsp: found no corner svs"):
        parse_profile(data, path)


def test_a_missing_performance_profile_is_named() -> None:
    path = profile_folder() / "snapdragon-888.toml"
    data = merged_tables(path)
    del data["performance_profiles"]["burst"]
    with pytest.raises(BadInputError, match="found no performance profile burst"):
        parse_profile(data, path)


def test_a_cycle_of_extends_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('extends = "b"\n')
    (tmp_path / "b.toml").write_text('extends = "a"\n')
    with pytest.raises(BadInputError, match=r"a\.toml -> b\.toml -> a\.toml"):
        load_profile(str(tmp_path / "a.toml"))


@pytest.mark.parametrize(
    ("text", "word"), [("a =", "TOML"), ("\xff\xfe", "UTF-8"), ('extends = "nope"', "nope"), ("extends = 3", "name")]
)
def test_an_unreadable_file_is_named(text: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(BadInputError, match=word):
        load_profile(str(path))


def test_what_is_no_toml_is_found_and_toml_is_expected(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_bytes(b"a = \xff")
    with pytest.raises(BadInputError) as raised:
        load_profile(str(tmp_path / "mine.toml"))
    assert raised.value.expected == "TOML in UTF-8" and "can't decode byte 0xff" in raised.value.found


def test_a_near_miss_is_suggested() -> None:
    said = f"found no profile 'snapdragon888', expected a .toml file or one of {', '.join(profile_names())}"
    with pytest.raises(BadInputError, match=f"^profile: {re.escape(said)}; did you mean snapdragon-888[?]$"):
        load_profile("snapdragon888")


def test_a_template_cannot_be_run() -> None:
    with pytest.raises(BadInputError) as caught:
        load_runnable("phone-template")
    said = f"profile: found the template phone-template, expected one of {', '.join(CHIPS)}"
    assert str(caught.value) == said and load_runnable("host").name == "host"
