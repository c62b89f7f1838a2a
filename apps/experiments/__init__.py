"""Experiments with runs and networks: image error, flicker, hard cases, the accuracy of predictions.

This folder may import from every lower folder, but neither from apps/cli/ nor from apps/dashboard/.
"""
