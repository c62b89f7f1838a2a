"""Avatars that are made of others, and what an avatar's files hold.

It may use every lower folder, but no other folder of apps/.
"""
