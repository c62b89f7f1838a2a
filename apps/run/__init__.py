"""Turns the options of a run into a run folder with a report, further files and, if requested, a check of the pictures.

This folder may import from every lower folder and from apps/experiments/, but not from apps/cli/.
"""
