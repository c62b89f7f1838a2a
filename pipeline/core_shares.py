"""What of a piece of time a unit worked, waited for a core and slept. Rule: pure; busy is never more than the CPU time.

Of each piece three numbers are known: how long it took (`wall_ns`), the CPU time of all threads of the unit's process
in it (`cpu_ns`), and how long these threads were ready but had no core (`delay_ns`: the kernel's run delay, summed over
the threads). docs/decisions/preempted-time.md derives what follows from them, and proves that units which share cores
are never busy for more than those cores.
"""

from __future__ import annotations

from typing import NamedTuple


class Lost(NamedTuple):
    """Parts of a piece of time in which a unit did not work, in ns: it waited for a core; it slept."""

    preempted_ns: int
    asleep_ns: int


def most_preempted_ns(wall_ns: int, cpu_ns: int, cores: int) -> int:
    """The most of `wall_ns` that a unit with `cores` cores can have waited for them: what its CPU time leaves of it."""
    return max(wall_ns - -(-cpu_ns // cores), 0)


def preempted_ns(wall_ns: int, cpu_ns: int, delay_ns: int, cores: int) -> int:
    """How much of `wall_ns` a unit with `cores` cores waited for them.

    Its threads were ready for cpu + delay, m = (cpu + delay) / wall of them at a time, but at least one; their waiting
    took delay / m. It is never more than what the CPU time leaves of the cores. With one core this is
    min(delay, wall - cpu).
    """
    if not delay_ns:
        return 0
    waited_ns = delay_ns * wall_ns // max(cpu_ns + delay_ns, wall_ns)
    return min(waited_ns, most_preempted_ns(wall_ns, cpu_ns, cores))


def lost_in_job(wall_ns: int, cpu_ns: int, delay_ns: int, cores: int, has_device: bool) -> Lost:
    """What a job of `wall_ns` lost. The rest, in which the unit was busy, is at most `cpu_ns` without a device.

    `has_device`: the work is done by something else than the cores (a graphics card, a modelled chip), so that the unit
    works while its threads sleep.
    """
    preempted = preempted_ns(wall_ns, cpu_ns, delay_ns, cores)
    asleep = 0 if has_device else wall_ns - preempted - cpu_ns
    return Lost(preempted, asleep if asleep > 0 else 0)
