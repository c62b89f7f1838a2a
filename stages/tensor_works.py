"""How many pixels a planned tensor may have: all that its network was trained for, or fewer where a scene may.

Rule: a policy that releases frames at a rate may step down, so that frames are in time; an error budget in dB limits
how far, by the avatars' measured figures, and without such a policy the smallest size within it is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

from trilane.avatars.validation import SizeLoss
from trilane.errors import BadInputError
from trilane.scene.planner import ALL_WORK, SIDES, work_of_side
from trilane.scene.schema import Scene
from trilane.scheduler.policy import policy_named

KEY = "error_budget_db"


def tensor_works(scene: Scene, policy: str, losses: Sequence[SizeLoss]) -> tuple[tuple[int, ...], str]:
    """`RunConfig.works` of a scene under `policy`, and what is to be said of it; empty when nothing is.

    `losses`: of the scene's avatars. Raises BadInputError for a budget that they have no figures for.
    """
    if not scene.plans_tensor:
        return (ALL_WORK,), ""
    works, budget = tuple(work_of_side(side) for side in SIDES), scene.error_budget_db
    paced = policy_named(policy).paced
    if budget is None:
        return (works, "") if paced else ((ALL_WORK,), "")
    for loss in losses:
        if not loss.by_work:
            raise BadInputError(KEY, loss.source, "avatars whose error in smaller tensors was measured")
    lost = {work: [loss.at(work) for loss in losses] for work in works}
    within = tuple(work for work in works if all(db is not None and db <= budget for db in lost[work]))
    least = within[-1]
    worst = max(db for db in lost[least] if db is not None)
    said = (
        f"image error: tensors may have {least / ALL_WORK:.0%} of the pixels that the network was trained for, where "
        f"they lose {worst:.1f} dB of the {budget:g} allowed ({losses[0].source})"
    )
    return (within if paced else within[-1:]), said
