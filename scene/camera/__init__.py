"""Cameras over time: paths read from camera files, and built-in cameras.

From `scene/` it may use the rotations, the schema, and the sampling in time of `scene/motion/`.
"""
