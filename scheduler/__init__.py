"""Decides which job runs next: a pure core, the loop that drives it, and the driver of virtual time.

It may use `transport/` and the modules in `src/trilane`. It imports no clock and no NumPy, and its only files are
recordings.
"""
