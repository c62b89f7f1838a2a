"""Predictions as somebody asked for them: of networks, applications and pipelines, on a chip or on this machine.

Rule: what was asked for is checked and this machine is measured here; `trilane.hw_profiles` computes the answers.
"""
