"""What `trilane accuracy --by-cause` shows. Rule: every figure comes from `trilane.apps.experiments.error_by_cause`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trilane.apps.cli.console import print_json, stderr_console, stdout_console, stdout_kept

HEADS = {
    "mae": "MAE",
    "psnr_db": "PSNR dB",
    "ssim": "SSIM",
    "ms_ssim": "MS-SSIM",
    "flip": "FLIP",
    "iou": "mask IoU",
    "lpips": "LPIPS",
}


@dataclass(frozen=True)
class Files:
    """`out`: folder for heat maps. `lpips_weights`: file of LPIPS' weights. None: without them."""

    out: Path | None = None
    lpips_weights: Path | None = None


def show_by_cause(scene: str, request: dict[str, Any], frames: int, files: Files, as_json: bool) -> None:
    """Measure and print. `request`: options of the run. Raises BadInputError, MissingPartError."""
    from trilane.apps.experiments.error_by_cause import error_by_cause
    from trilane.apps.experiments.picture_errors import Lpips
    from trilane.stages.configure import configure, required_machine
    from trilane.stages.run_options import RunOptions
    from trilane.writing import write_folder

    out, lpips = files.out, None if files.lpips_weights is None else Lpips(files.lpips_weights)
    checked = configure(RunOptions(scene=scene, **request), Path.cwd())
    machine = required_machine()
    if out is not None:
        with write_folder(out):
            pass  # that it can be written is found out before the work
    with stdout_kept():
        result = error_by_cause(checked, frames, out, _tracked, lpips)
    if as_json:
        print_json({"schema": 1, **result, "machine": machine})
    else:
        _print(result)
    if out is not None:
        stderr_console().print(f"heat maps: {out}", soft_wrap=True, markup=False)


def _tracked(numbers: Sequence[int]) -> Iterable[int]:
    from rich.progress import track

    console = stderr_console()
    return track(numbers, "frames", console=console, disable=not console.is_terminal)


def _print(result: dict[str, Any]) -> None:
    from rich.table import Table

    console = stdout_console()
    config, sums, whole = result["config"], result["sums"], result["whole"]
    console.print(
        f"{config['scene']}, plan {config['plan']}, size {config['size']}, {config['runtime']}: "
        f"frames {', '.join(map(str, result['frames']))}; measured in this run",
        soft_wrap=True,
    )
    shown = [name for name in HEADS if name != "lpips" or whole["lpips"] is not None]
    heads = (HEADS[name] for name in shown)
    alone = Table("each cause alone", *heads, "moved mm (px)", title="against the reference")
    for row in result["causes"]:
        moved = row["moved"]
        said = "" if moved is None else f"{moved['largest_mm']:.3g} ({moved['largest_px']:.3g})"
        alone.add_row(row["cause"], *_cells(row["alone"], shown), said)
    alone.add_row("the run", *_cells(whole, shown), "", style="bold")
    for name, figures in (result["truth"] or {}).items():
        alone.add_row(f"{name} against truth", *_cells(figures, shown), "")
    console.print(alone)
    if result["empty_frames"]:
        console.print(f"nobody is in view in frames {', '.join(map(str, result['empty_frames']))}", soft_wrap=True)
    order = Table("in order", "MAE adds", "mean square adds", "share", "so far: MAE", "PSNR dB", "SSIM", "FLIP")
    for row in result["causes"]:
        adds, far = row["adds"], row["so_far"]
        share = adds["product"] / whole["square"] if whole["square"] else 0.0
        so_far = [_number(far[name]) for name in ("mae", "psnr_db", "ssim", "flip")]
        order.add_row(row["cause"], _number(adds["mae"]), _number(adds["square"]), f"{share:.1%}", *so_far)
    console.print(order)
    for line in _sums(sums, whole, result):
        console.print(line, soft_wrap=True, markup=False)


def _sums(sums: dict[str, Any], whole: dict[str, Any], result: dict[str, Any]) -> list[str]:
    left, alone = sums["left_in_order"], sums["left_alone"]
    return [
        f"in order, exact by construction: MAE {sums['in_order']['mae']:.4g} of {whole['mae']:.4g} (left "
        f"{left['mae']:.1e}), mean square {sums['in_order']['square']:.4g} of {whole['square']:.4g} "
        f"(left {left['square']:.1e})",
        f"alone, not exact: MAE {sums['alone']['mae']:.4g} (left {alone['mae']:.2g}), mean square "
        f"{sums['alone']['square']:.4g} (left {alone['square']:.2g})",
        f"the run's own frames differ from the sequence's end by {result['remainder']['mae']:.2g} (MAE); "
        "MAE in steps of 1/255, mean square in their squares",
        f"reference network: {result['network']}",
    ]


def _cells(figures: dict[str, float | None], shown: Sequence[str]) -> list[str]:
    return [_number(figures.get(name)) for name in shown]


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
