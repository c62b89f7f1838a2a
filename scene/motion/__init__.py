"""Reads motion files and makes the built-in motions: SMPL-X poses over time.

It may use `body/`, and from `scene/` the rotations and the schema.
"""
