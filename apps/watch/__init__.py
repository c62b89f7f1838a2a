"""Follows a live run: finds the run by name, and gives its present figures, also as OpenMetrics text.

Rule: everything comes from the run's journal, which says the same after the run as during it.
"""
