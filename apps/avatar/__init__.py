"""Assembles avatars from parts of others, and describes an avatar's files.

It may use every lower folder, but no other folder of apps/.
"""
