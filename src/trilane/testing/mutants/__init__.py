"""Small faults put into the code one at a time, to see which the tests notice. Rule: a seed gives the same faults.

`make mutants` runs it; tests/README.md says how to read what it prints.
"""
