"""Reads camera files and makes the built-in cameras: a view and a projection over time.

From `scene/` it may use the rotations, the schema, and the sampling in time of `scene/motion/`.
"""
