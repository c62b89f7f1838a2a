"""A run while it goes on: found by its name, its figures of the moment, and these as metrics.

Rule: everything follows the run's journal, which tells the same after the run as during it.
"""
