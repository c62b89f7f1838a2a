"""Makes the integer network that the DSP runs from a float one: calibration, scales and zero points, equalisation.

It may use `avatars/` and the modules in `src/trilane`, but nothing else of `training/`.
"""
