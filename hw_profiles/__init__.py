"""Describes chips (profiles in TOML) and computes their times, power, temperatures and throttling; also this machine's.

It may use `pipeline/` and the folders below it: `scheduler/` for virtual time, `pipeline/` for the settings of a unit.
"""
