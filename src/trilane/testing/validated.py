"""A manifest as if its avatar had been validated. Rule: the figures are made up, the digests are real."""

from __future__ import annotations

from datetime import date

from trilane.avatars.bundle import Bundle
from trilane.avatars.manifest import Manifest, Validation, digests_of, with_figures_digest

#: Of the made-up figures, PSNR in dB: that of the avatar's runtime, and of `openvino`.
PSNR_DB, OTHER_PSNR_DB = 31.4159, 27.1828


def validated(bundle: Bundle, size: str = "256") -> Manifest:
    """The manifest of `bundle` with a validation of its files on `ort` and `openvino` at tensor size `size`."""
    figures = {
        "psnr_db_by_band": {"full_body": PSNR_DB},
        "psnr_db_by_background": {"black": PSNR_DB},
        "see_through": 0.0123,
        "iou": 0.9753,
        "ssim": 0.8642,
    }
    others = {
        "openvino": figures
        | {"psnr_db_by_band": {"full_body": OTHER_PSNR_DB}, "psnr_db_by_background": {"black": OTHER_PSNR_DB}}
    }
    digests = digests_of(bundle.folder, bundle.manifest)
    about = {"date": date(2026, 1, 2), "digests": digests, "runtime": "ort", "size": size, "other_runtimes": others}
    validation = with_figures_digest(Validation.model_validate(figures | about))
    return bundle.manifest.model_copy(update={"validation": validation})
