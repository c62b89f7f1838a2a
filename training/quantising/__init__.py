"""Makes an integer network for the DSP from a float network: calibration, scales and zero points, equalisation.

This folder may import `avatars/`, `hw_profiles/` and the modules in `src/trilane`, but nothing else of `training/`.
"""
