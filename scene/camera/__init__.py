"""Reads camera files and makes the built-in cameras: a view and a projection over time.
Uses, of `scene`, the motion's sampling in time, the rotations and the schema.
"""
