"""Accuracy, sweeps and reports."""
