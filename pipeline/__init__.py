"""Runs any pipeline on real processes: its description, the unit processes, the loop inside them, and the host clock.

It may use `scheduler/`, `transport/` and what lies below them; it knows no stage's work, neither OpenGL nor ONNX.
"""
