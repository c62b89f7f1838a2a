"""The dashboard: runs in a browser.

It may use apps/ and every lower folder, but not apps/cli/.
"""
