"""Describes chips (profiles in TOML) and computes their times, power, temperatures and throttling; also this machine's.
Uses `scheduler` for runs in virtual time, `pipeline` for a unit's settings, and the modules beside the folders.
"""
