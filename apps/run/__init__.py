"""Turns the options of a run into a run folder, with its report, its files and its check.

It may use every lower folder and apps/experiments/, but not apps/cli/.
"""
