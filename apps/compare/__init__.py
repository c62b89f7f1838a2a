"""Compares runs, predictions and sweeps: what differs, why, and which image error belongs to each speed.

This folder may import from apps/ and every lower folder, but not from apps/cli/.
"""

from __future__ import annotations
