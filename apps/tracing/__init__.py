"""The trace of a run: a timeline of units, stages and frames for trace viewers, made from the records of its journal.

It may use apps/ and every lower folder, but not apps/cli/.
"""
