"""Runs any pipeline on real processes: its description, the unit processes, the loop inside them, and the host clock.

This folder may use `scheduler/`, `transport/` and the layers below them. It does not know what stages do, and uses
neither OpenGL nor ONNX.
"""
