"""What is usual in a training where its settings do not say it: by its loss, by what it starts from, by its length.

Rule: these are values of `TrainingSettings`, nothing else, and all of them stand in the `training.toml` of an avatar.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from trilane.errors import BadInputError
from trilane.near_miss import did_you_mean
from trilane.training.loss_weights import LossWeights

#: Losses by name: the weights, and the settings that belong to them where a training does not say others.
LOSSES: dict[str, dict[str, Any]] = {
    "default": {"loss": {}},
    "thesis": {
        "loss": dict.fromkeys(LossWeights.model_fields, 0.0)
        | {"composite": 25.0, "overlap": 25.0, "perceptual": 20.0, "adversarial": 1.0, "features": 1.0},
        "network_rate": 1e-3,
        "texture_rate": 1e-3,
        "discriminator_rate": 1e-5,
        "weight_decay": 0.0,
        "optimiser": {"kind": "adam", "second_momentum": 0.999, "clip_norm": 0.0},
    },
}
#: With a network that is trained already, and with a new one.
TRAINED: dict[str, Any] = {"small_until": 0.0, "freeze_norms_at": 0.3}
NEW: dict[str, Any] = {"small_until": 0.12, "freeze_norms_at": 0.6}
#: Of a new network that has less than so many minutes: cheap steps at a high rate (docs/decisions/avatar-training.md).
SHORT_MINUTES = 5.0
SHORT: dict[str, Any] = {"batch": 2, "small_until": 0.8, "network_rate": 5e-3, "texture_rate": 1e-3}


def with_usual(values: dict[str, Any], where: str | Path) -> dict[str, Any]:
    """`values`, which stand at `where`, and what is usual with them; a loss that has a name by its weights.

    Raises BadInputError for a name that no loss has.
    """
    start, name = values.get("start", "default"), values.get("loss")
    usual = (NEW if start == "new" else TRAINED) | (_of_loss(name, where) if isinstance(name, str) else {})
    if start == "new" and _is_short(values):
        usual |= SHORT
    given = {key: value for key, value in values.items() if key != "loss" or not isinstance(name, str)}
    return usual | {key: _over(usual.get(key), value) for key, value in given.items()}


def _of_loss(name: str, where: str | Path) -> dict[str, Any]:
    if name not in LOSSES:
        raise BadInputError(f"{where}: loss", repr(name), f"one of {', '.join(LOSSES)}", did_you_mean(name, LOSSES))
    return LOSSES[name]


def _is_short(values: dict[str, Any]) -> bool:
    minutes = values.get("minutes")
    return "steps" not in values and isinstance(minutes, int | float) and minutes < SHORT_MINUTES


def _over(usual: Any, value: Any) -> Any:
    """`value`; of a table, what it does not say is as `usual`."""
    return usual | value if isinstance(usual, dict) and isinstance(value, dict) else value
