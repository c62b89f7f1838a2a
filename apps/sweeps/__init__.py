"""Sweeps: many configurations of one command, tried one by one, on one machine or many. Rule: one idea a file."""
