"""GLSL programs (data)."""
