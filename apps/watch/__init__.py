"""Follows a live run: finds it by name, and gives its present figures, also as metrics.

Rule: everything comes from the run's journal, which says the same after the run as during it.
"""
