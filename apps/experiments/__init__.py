"""Experiments over runs and networks: accuracy, hard cases.

It may use every lower folder, but neither apps/cli/ nor apps/dashboard/.
"""
