"""Measurements of this machine: a module for each question, whose `measure` answers it, and `lib/` for what they share.

It may use every folder but apps/. The parameters of `measure` are options of `trilane bench`, explained in its help.
"""
