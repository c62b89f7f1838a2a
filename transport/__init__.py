"""Carries packets and messages between the scheduler and its units: shared memory, job pipes and heartbeats.
Uses only the modules beside the package's folders (`trilane.errors`, `trilane.arrays` and their like).
"""
