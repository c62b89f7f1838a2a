"""Runs, predictions and sweeps beside each other: what differs, why, and what each speed costs in image error.

It may use apps/ and every lower folder, but not apps/cli/.
"""

from __future__ import annotations
