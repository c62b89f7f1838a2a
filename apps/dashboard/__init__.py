"""Runs in a browser: a server for one run that goes on or is over, and the page that it serves.

It may use apps/ and every lower folder, but not apps/cli/.
"""
