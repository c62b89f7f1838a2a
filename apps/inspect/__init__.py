"""Says what a file or a folder is, and whether a run can use it."""

from __future__ import annotations
