"""Checks of pipeline files and scenes before a run: `trilane check` and `trilane init`."""
