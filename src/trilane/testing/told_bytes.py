"""What a stage says that it moved. Rule: tests of other figures leave it out here, and by no list of their own."""

from __future__ import annotations

from collections.abc import Mapping

from trilane.pipeline.moved_bytes import BYTES


def without_bytes(figures: Mapping[str, float]) -> dict[str, float]:
    """`figures` of a job but the bytes that it moved."""
    return {name: value for name, value in figures.items() if name not in BYTES}
