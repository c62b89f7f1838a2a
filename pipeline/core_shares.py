"""Divides a piece of time of a unit into work, waiting for a core, and sleep. Rule: pure; busy is at most the CPU time.

Three numbers are known of each piece, in ns:
- `wall_ns`: its length;
- `cpu_ns`: CPU time of all threads of the unit's process in it;
- `delay_ns`: time in which these threads were ready but had no core, the kernel's run delay, summed over the threads.

docs/decisions/preempted-time.md derives what follows from them. It proves that units which share cores are never busy
for more than those cores.
"""

from __future__ import annotations

from typing import NamedTuple


class Lost(NamedTuple):
    """Parts of a piece of time in which a unit did not work, in ns.

    `preempted_ns`: time for which it waited for a core.
    `asleep_ns`: time for which it slept.
    """

    preempted_ns: int
    asleep_ns: int


def most_preempted_ns(wall_ns: int, cpu_ns: int, cores: int) -> int:
    """Return the most of `wall_ns` that a unit with `cores` cores can have waited for them.

    This is what its CPU time leaves of the time.
    """
    return max(wall_ns - -(-cpu_ns // cores), 0)


def preempted_ns(wall_ns: int, cpu_ns: int, delay_ns: int, cores: int) -> int:
    """Return how much of `wall_ns` a unit with `cores` cores waited for them.

    Its threads were ready for cpu + delay. So m = (cpu + delay) / wall of them were ready at a time, but at least one.
    Their waiting took delay / m, and never more than what the CPU time leaves of the cores. With one core this is
    min(delay, wall - cpu).
    """
    if not delay_ns:
        return 0
    waited_ns = delay_ns * wall_ns // max(cpu_ns + delay_ns, wall_ns)
    return min(waited_ns, most_preempted_ns(wall_ns, cpu_ns, cores))


def lost_in_job(wall_ns: int, cpu_ns: int, delay_ns: int, cores: int, has_device: bool) -> Lost:
    """Return what a job of `wall_ns` lost. The unit was busy in the rest, which is at most `cpu_ns` without a device.

    `has_device`: whether something else than the cores works (a graphics card, a modelled chip), so that the unit works
    while its threads sleep.
    """
    preempted = preempted_ns(wall_ns, cpu_ns, delay_ns, cores)
    asleep = 0 if has_device else wall_ns - preempted - cpu_ns
    return Lost(preempted, asleep if asleep > 0 else 0)
