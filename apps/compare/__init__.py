"""Comparison of runs, predictions and sweeps: what differs, why, and the image error that each speed costs.

This folder may import from apps/ and every lower folder, but not from apps/cli/.
"""

from __future__ import annotations
