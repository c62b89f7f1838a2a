"""Makes the integer network that the DSP runs from a float one: calibration, scales and zero points, equalisation.

This folder may import `avatars/` and the modules in `src/trilane`, but nothing else of `training/`.
"""
