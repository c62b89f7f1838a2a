"""Sweeps: many configurations of one command, tried one by one, on one machine or many."""

from __future__ import annotations
