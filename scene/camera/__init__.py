"""Reads camera files and makes the built-in cameras: a view and a projection over time.

It may use, of `scene/`, the rotations, the schema, and from `scene/motion/` the sampling in time.
"""
