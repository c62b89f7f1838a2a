"""What a reader detected in the file of a motion or of a camera, field by field: what notes say in sentences.

Rule: a field says what was decided and why; it is empty where the format has no such thing. Nothing follows from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Detected:
    """What a file is.

    `format`: its name for people. `reason`: by what the format was told apart. `axes`: which is up, and why. `unit`: of
    its lengths, and why. `rate`: where the rate comes from. `lens`: the same of a camera's. `joints`: SMPL-X joint ->
    the file's name of it. `unmapped`: names of the file's joints that have no partner, in its order.
    """

    format: str = ""
    reason: str = ""
    axes: str = ""
    unit: str = ""
    rate: str = ""
    lens: str = ""
    joints: Mapping[str, str] = field(default_factory=dict)
    unmapped: tuple[str, ...] = ()


#: Of what comes from no file.
NOTHING = Detected()
