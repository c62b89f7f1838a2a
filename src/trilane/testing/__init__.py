"""Doubles of stages, for tests: they take time, fail, hang or lose their context where a test asks for it.

It may use every folder; nothing but tests uses it, and no run contains a double unless its pipeline names one.
"""
