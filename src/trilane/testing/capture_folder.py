"""A small capture on disk, for tests to read and to break: noise for frames, a rectangle for masks, one fit a side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

HEIGHT, WIDTH = 64, 96
CAMERA = f"[camera]\nwidth = {WIDTH}\nheight = {HEIGHT}\nfx = 90.0\nfy = 80.0\ncx = 50.0\ncy = 30.0\n"


def fit(number: int, of: int = 8) -> dict[str, Any]:
    """Of frame `number` of `of`: the body turns about its own axis before an OpenGL camera, by the names of SMPL-X."""
    rng = np.random.default_rng(number)
    return {
        "global_orient": np.array([0.0, -2 * np.pi * number / of, 0.0]),
        "body_pose": rng.normal(0, 0.2, 63),
        "transl": np.array([0.1, 0.2, -3.0]),
        "betas": np.full(10, 0.1 * number),
    }


def write_capture_folder(folder: Path, frames: int = 8, head: str = "") -> Path:
    """The folder of a capture without faults, whose frames show all sides."""
    for part in ("frames", "masks", "fits"):
        (folder / part).mkdir(parents=True)
    text = f"schema = 1\n{head}\n{CAMERA}axes = 'opengl'\n"
    (folder / "capture.toml").write_text(text, encoding="utf-8")
    for number in range(frames):
        rng = np.random.default_rng((7, number))
        frame = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[10:50, 30 + number : 60] = 255
        Image.fromarray(frame).save(folder / "frames" / f"{number:03}.png")
        Image.fromarray(mask).save(folder / "masks" / f"{number:03}.png")
        np.savez(folder / "fits" / f"{number:03}.npz", **fit(number, frames))
    return folder
