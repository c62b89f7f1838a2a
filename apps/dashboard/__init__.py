"""Shows runs in a browser: a server for one live or finished run, and the page that the server sends.

This folder may import apps/ and every lower folder, but not apps/cli/.
"""
