"""Whether a body has the height of a person, and the unit that would give it one.

Rule: a body whose rest pose is lower or higher than people are is refused, since everything else is in metres.
"""

from __future__ import annotations

import math

from trilane.unexpected_value import UnexpectedValue

#: From sole to crown, metres: from less than a newborn child to more than anybody was.
LEAST_M, MOST_M = 0.3, 3.0
USUAL_M = 1.7
UNITS_M = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048, "decimetres": 0.1}


def check_height(height: float) -> None:
    """Raises UnexpectedValue for a `height` that no body in metres has, with the unit that would make it one."""
    if LEAST_M <= height <= MOST_M:
        return
    found = f"a body {height:.4g} m high, along Y at rest"
    raise UnexpectedValue(found, f"{LEAST_M:g} to {MOST_M:g} m", _remedy(height))


def _remedy(height: float) -> str:
    fitting = {name: unit for name, unit in UNITS_M.items() if LEAST_M <= height * unit <= MOST_M}
    if not fitting:
        return "give its places in metres, Y up"
    name = min(fitting, key=lambda name: abs(math.log(height * fitting[name] / USUAL_M)))
    scaled = f"{height * fitting[name]:.2f} m if they are {name}"
    return f"give its places in metres: {scaled}, so multiply v_template and shapedirs by {fitting[name]:g}"
