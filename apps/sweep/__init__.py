"""Sweeps: many configurations of one command, tried on one machine or many."""

from __future__ import annotations
