"""Masked Adam beside PyTorch's own for sparse gradients, and beside plain AdamW where everything has a gradient."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trilane.training.step_loop import MaskedAdamW  # noqa: E402

RATE, BETAS = 0.05, (0.9, 0.99)


def gradients(share: float) -> Any:
    """Twelve gradients (7, 5) of which a row is 0 with the probability 1 - `share`."""
    rng = np.random.default_rng(3)
    shown = rng.random((12, 7, 1)) < share
    return torch.from_numpy(rng.normal(0, 1, (12, 7, 5)) * shown)


def start() -> Any:
    return torch.nn.Parameter(torch.from_numpy(np.random.default_rng(4).normal(0, 1, (7, 5))))


def stepped(optimiser: Any, parameter: Any, each: Any) -> None:
    parameter.grad = each
    optimiser.step()


def test_it_is_adam_for_sparse_gradients() -> None:
    """But for epsilon, which the two add before and after the bias is corrected; here it is next to nothing."""
    mine, theirs = start(), start()
    own = MaskedAdamW([{"params": [mine], "masked": True}], lr=RATE, betas=BETAS, weight_decay=0.0, eps=1e-20)
    other = torch.optim.SparseAdam([theirs], lr=RATE, betas=BETAS, eps=1e-20)
    for each in gradients(0.5):
        rows = each.abs().sum(dim=1).nonzero()[:, 0]
        stepped(own, mine, each.clone())
        stepped(other, theirs, torch.sparse_coo_tensor(rows[None], each[rows], each.shape, check_invariants=True))
        np.testing.assert_allclose(mine.detach(), theirs.detach(), atol=1e-12)
    for name in ("exp_avg", "exp_avg_sq"):
        np.testing.assert_allclose(own.state[mine][name], other.state[theirs][name], atol=1e-12)


def test_it_is_adamw_where_all_have_a_gradient_and_in_other_groups() -> None:
    for share, masked in ((1.0, True), (0.5, False)):
        mine, theirs = start(), start()
        own = MaskedAdamW([{"params": [mine], "masked": masked}], lr=RATE, betas=BETAS, weight_decay=0.1)
        other = torch.optim.AdamW([theirs], lr=RATE, betas=BETAS, weight_decay=0.1)
        for each in gradients(share):
            stepped(own, mine, each.clone())
            stepped(other, theirs, each.clone())
        assert torch.equal(mine, theirs)


def test_what_has_no_gradient_neither_moves_nor_decays_nor_forgets() -> None:
    parameter = start()
    optimiser = MaskedAdamW([{"params": [parameter], "masked": True}], lr=RATE, betas=BETAS, weight_decay=0.1)
    first = torch.ones(7, 5, dtype=torch.float64)
    first[2] = 0
    begun = parameter.detach().clone()
    stepped(optimiser, parameter, first)
    assert torch.equal(parameter[2], begun[2]) and not (parameter[3] == begun[3]).any()
    before, moment = parameter.detach().clone(), optimiser.state[parameter]["exp_avg"].clone()
    then = torch.zeros(7, 5, dtype=torch.float64)
    then[2] = 1
    stepped(optimiser, parameter, then)
    changed = (parameter != before).any(dim=1)
    assert changed.tolist() == [False, False, True, False, False, False, False]
    assert torch.equal(optimiser.state[parameter]["exp_avg"][3], moment[3])
    parameter.grad = None
    optimiser.step()
