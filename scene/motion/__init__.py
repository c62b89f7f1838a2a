"""Motions: files and built-in ones, read into SMPL-X poses over time."""
