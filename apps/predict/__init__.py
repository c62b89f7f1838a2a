"""Predictions for networks, applications and pipelines, on a chip or on this machine: from options to answers.

Rule: this folder checks the options and measures this machine. `trilane.hw_profiles` computes the answers.
"""
