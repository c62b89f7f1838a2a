"""Describes chips (profiles in TOML) and this machine, and computes their times, power, temperatures and throttling.

It may use `pipeline/` and the folders below it: `scheduler/` for virtual time, `pipeline/` for the settings of a unit.
"""
