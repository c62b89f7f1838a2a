"""Motions: SMPL-X poses over time, read from motion files or built in.

It may use `body/`, and from `scene/` the rotations and the schema.
"""
