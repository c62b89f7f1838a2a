"""The place of a dashboard that shows runs in a browser; it is not written yet.

It may use apps/ and every lower folder, but not apps/cli/.
"""
