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

    Keys: `psnr_db_by_band`, `body_psnr_db_by_band`, `iou_by_band`; `psnr_db`, `body_psnr_db`, `background`, `iou`,
    `ssim`: means of the fields of `ImageError`; `least_psnr_db`, `least_body_psnr_db`; `worst`, the sample of the least
    PSNR: `seed`, `number`, `band`, `psnr_db`, `body_psnr_db`; `by_seed`: `psnr_db`, `body_psnr_db`, `least_psnr_db` of
    each seed's samples; `samples`, how many.
    """
    bands = [band for band in BANDS if any(sample.band == band for sample in errors)]
    worst = min(errors, key=lambda sample: sample.error.psnr_db)
    seeds = sorted({sample.seed for sample in errors})
    means = ("psnr_db", "body_psnr_db", "background", "iou", "ssim")
    return {
        **{
            f"{key}_by_band": {band: _mean([s for s in errors if s.band == band], key) for band in bands}
            for key in ("psnr_db", "body_psnr_db", "iou")
        },
        **{key: _mean(errors, key) for key in means},
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
