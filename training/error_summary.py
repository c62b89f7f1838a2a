"""What the errors of many samples come to, as the manifest has it.

Rule: beside every mean stands the worst sample, by seed and number, so that it can be drawn and looked at again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trilane.avatars.manifest import BANDS
from trilane.training.image_error import ImageError

DB_DIGITS, SHARE_DIGITS = 2, 4
#: Fields of `ImageError` whose mean says how good an avatar is.
MEANS = (
    *("psnr_db", "body_psnr_db", "see_through", "alpha_inside", "alpha_edge", "alpha_outside"),
    *("background", "iou", "ssim"),
)


@dataclass(frozen=True)
class SampleError:
    """The error of one sample, and how it is found again.

    `seed`: of all samples of its kind. `number`: among them. `band`: its name.
    """

    seed: int
    number: int
    band: str
    error: ImageError


def summary(errors: Sequence[SampleError]) -> dict[str, Any]:
    """What `errors`, at least one, come to; decibels are means over pictures.

    Keys: `psnr_db_by_band`, `body_psnr_db_by_band`, `see_through_by_band`, `iou_by_band`; `psnr_db_by_background`;
    those of `MEANS`: means of the fields of `ImageError`; `least_psnr_db`, `least_body_psnr_db`; `worst`, the sample of
    the least PSNR: `seed`, `number`, `band`, `psnr_db`, `body_psnr_db`; `by_seed`: `psnr_db`, `body_psnr_db`,
    `least_psnr_db` of each seed's samples; `samples`, how many.
    """
    bands = [band for band in BANDS if any(sample.band == band for sample in errors)]
    worst = min(errors, key=lambda sample: sample.error.psnr_db)
    seeds = sorted({sample.seed for sample in errors})
    return {
        **{
            f"{key}_by_band": {band: _mean([s for s in errors if s.band == band], key) for band in bands}
            for key in ("psnr_db", "body_psnr_db", "see_through", "iou")
        },
        "psnr_db_by_background": {
            kind: _rounded("psnr_db", float(np.mean([sample.error.by_background[kind] for sample in errors])))
            for kind in errors[0].error.by_background
        },
        **{key: _mean(errors, key) for key in MEANS},
        "least_psnr_db": _least(errors, "psnr_db"),
        "least_body_psnr_db": _least(errors, "body_psnr_db"),
        "worst": {
            "seed": worst.seed,
            "number": worst.number,
            "band": worst.band,
            **{key: _rounded(key, getattr(worst.error, key)) for key in ("psnr_db", "body_psnr_db")},
        },
        "by_seed": {str(seed): _of_seed([s for s in errors if s.seed == seed]) for seed in seeds},
        "samples": len(errors),
    }


def _of_seed(errors: Sequence[SampleError]) -> dict[str, float]:
    return {
        "psnr_db": _mean(errors, "psnr_db"),
        "body_psnr_db": _mean(errors, "body_psnr_db"),
        "least_psnr_db": _least(errors, "psnr_db"),
    }


def _mean(errors: Sequence[SampleError], key: str) -> float:
    return _rounded(key, float(np.mean([getattr(sample.error, key) for sample in errors])))


def _least(errors: Sequence[SampleError], key: str) -> float:
    return _rounded(key, min(getattr(sample.error, key) for sample in errors))


def _rounded(key: str, value: float) -> float:
    return round(value, DB_DIGITS if key.endswith("_db") else SHARE_DIGITS)
