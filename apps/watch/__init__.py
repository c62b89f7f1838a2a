"""Follows a live run: finds the run by name, and computes its present figures, also as OpenMetrics text.

Rule: everything comes from the run's journal, which has the same content during the run and afterwards.
"""
