"""Carries packets and messages between the scheduler and its units: shared memory, job pipes and heartbeats.

It may use the modules in `src/trilane`.
"""
