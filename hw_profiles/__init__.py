"""Describes chips (profiles in TOML) and this machine, and computes their times, power, temperatures and throttling.

It may use `pipeline/`, for the settings of a unit, and the layers below it, such as `scheduler/` for virtual time.
"""
