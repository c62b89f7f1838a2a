"""What `engine_study.py` found, as text of profiles: the shared factors into one, each chip's numbers into its own.

Rule: the head of a chip's file is written by hand and stays; everything from MARK on is written here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from trilane.files import read_text
from trilane.hw_profiles.engine_layers import NAMES
from trilane.hw_profiles.engine_study import EngineStudy, Rate, Study, middle
from trilane.hw_profiles.fit_priors import ON_CHIP_MB, UNITS_OF_RATES
from trilane.hw_profiles.schema import EngineName

#: The profile with the shared factors, and those of chips.
SHARED = "hexagon"
PROFILE_OF = {
    "8gen1": "snapdragon-8-gen-1",
    "8gen2": "snapdragon-8-gen-2",
    "8gen3": "snapdragon-8-gen-3",
    "8elite": "snapdragon-8-elite",
    "8elite5": "snapdragon-8-elite-gen-5",
    "qcs6490": "qcs6490",
    "sa8295p": "sa8295p",
    "xelite": "snapdragon-x-elite",
}
HEXAGON_OF = {"8gen1": "v69", "8gen2": "v73", "8gen3": "v75", "8elite": "v79", "8elite5": "v81"} | {
    "qcs6490": "v68",
    "sa8295p": "v68",
    "xelite": "v73",
}
#: Chips of the 888's generation: their mean is where a chip without rows begins.
V68 = ("qcs6490", "sa8295p")
MARK = "# From here on written by `trilane profiles fit-chips`."
VTCM = "VTCM of its generation"
#: Shares of a network's time below it are not written.
LEAST_SHARE = 0.001


def profile_texts(study: Study, folder: Path, command: str) -> dict[Path, str]:
    """The new text of each profile of `folder` that has numbers of `study`.

    `command`: the source that each number states.
    Raises BadInputError for a chip's profile that is not there.
    """
    written = {folder / f"{SHARED}.toml": list(_shared(study, command))}
    for chip in study.chips:
        if chip in PROFILE_OF:
            written[folder / f"{PROFILE_OF[chip]}.toml"] = list(_chip(study, chip, command))
    return {path: head_of(path) + "\n".join([MARK, *lines]) + "\n" for path, lines in written.items()}


def head_of(path: Path) -> str:
    """The part of a profile that is written by hand. Raises BadInputError without one."""
    return read_text(path, "a chip's profile, its head written by hand").partition(MARK)[0].rstrip() + "\n\n"


def _shared(study: Study, command: str) -> Iterator[str]:
    source = f"{command}, factors shared by all chips"
    for name, engine in study.engines.items():
        yield f"\n[units.dsp.engines.{name}]"
        yield f"element_bytes = {2 if name.startswith('fp16') else 1}"
        yield _number("on_chip_mb", Rate(ON_CHIP_MB["v68"], 0.1, "published"), VTCM)
        yield _number("error_fraction", Rate(engine.error, 0.3, "fitted"), _errors(engine))
        yield from _rates(name, _middle_of(study, name), f"{command}, mean of the chips of Hexagon v68")
        yield f"\n[units.dsp.engines.{name}.seen]"
        for network, shares in engine.fitted.seen.items():
            stated = [
                f"{term} = {share:.3f}" for term, share in zip(NAMES, shares, strict=True) if share >= LEAST_SHARE
            ]
            yield f"{network} = {{ {', '.join(stated)} }}"
        yield f"\n[units.dsp.engines.{name}.factors]"
        numbers, spreads = engine.fitted.numbers.factors, engine.fitted.spreads.factors
        for term, value, spread in zip(NAMES, numbers, spreads, strict=True):
            if term not in UNITS_OF_RATES:
                yield _number(term, Rate(math.exp(value), float(spread), "fitted"), source)


def _middle_of(study: Study, name: EngineName) -> Mapping[str, Rate]:
    chips = [study.rates[chip, name] for chip in V68 if (chip, name) in study.rates]
    return {key: Rate(*prior, "fitted") for key, prior in middle(chips).items()}


def _errors(engine: EngineStudy) -> str:
    return f"cross-validation over networks, {len(engine.left_out)} rows: 87 % of them lie in their intervals"


def _chip(study: Study, chip: str, command: str) -> Iterator[str]:
    for name in study.engines:
        if (chip, name) in study.rates:
            yield f"\n[units.dsp.engines.{name}]"
            yield _number("on_chip_mb", Rate(ON_CHIP_MB[HEXAGON_OF[chip]], 0.1, "published"), VTCM)
            yield from _rates(name, study.rates[chip, name], command)


def _rates(name: EngineName, rates: Mapping[str, Rate], source: str) -> Iterator[str]:
    yield f"\n[units.dsp.engines.{name}.rates]"
    for key, rate in rates.items():
        yield _number(key, rate, source)


def _number(key: str, rate: Rate, source: str) -> str:
    stated = f'value = {rate.value:.4g}, kind = "{rate.kind}", spread = {rate.spread:.2g}'
    return f"{key} = {{ {stated}, source = {json.dumps(source)} }}"
