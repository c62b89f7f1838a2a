"""Cameras: recorded paths and built-in ones, as a view and a projection over time."""
