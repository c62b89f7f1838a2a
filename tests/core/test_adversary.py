"""Discriminators: what each sees, their errors in bits, what they change and what they leave."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trilane.training.objective import (  # noqa: E402
    JUDGES,
    WEIGHTS,
    Adversary,
    Judged,
    Objective,
    bits,
)

#: What stands behind both.
BEHIND = torch.from_numpy(np.random.default_rng(9).random((2, 3, 32, 24), np.float32))


def pictures(seed: int = 0) -> tuple[Any, Any]:
    """An output and a target (2, 4, 32, 24) of random numbers."""
    rng = np.random.default_rng(seed)
    output, target = rng.uniform(0, 1, (2, 2, 4, 32, 24)).astype(np.float32)
    return torch.from_numpy(output), torch.from_numpy(target)


def adversary(**others: Any) -> Adversary:
    return Adversary(**({"width": 4, "rate": 1e-3, "seed": 1} | others))


def weights(of: Adversary) -> list[bytes]:
    return [value.detach().numpy().tobytes() for value in of.discriminators.parameters()]


def test_errors_are_binary_cross_entropy_in_bits() -> None:
    """A quarter, and 3/4, in place of each truth: 2 bits, and log2(4/3)."""
    score = torch.full((3,), math.log(0.25 / 0.75))
    assert float(bits(score, true=True)) == pytest.approx(2)
    assert float(bits(score, true=False)) == pytest.approx(math.log2(4 / 3))
    assert float(bits(torch.zeros(2), true=True)) == 1 == float(bits(torch.zeros(2), true=False))


def test_three_see_the_picture_before_a_background_and_its_mask_at_three_sizes() -> None:
    mine, (output, _) = adversary(), pictures()
    seen: list[Any] = []
    for judge in mine.discriminators:
        judge.register_forward_hook(lambda _, given, found: seen.append((given[0], found)))
    mine.terms(output, output, BEHIND)
    image, behind = output.numpy(), BEHIND.numpy()
    over = np.concatenate([image[:, :3] * image[:, 3:] + behind * (1 - image[:, 3:]), image[:, 3:]], axis=1)
    for (given, judged), shrunk in zip(seen[:3], (1, 2, 4), strict=True):
        means = over.reshape(2, 4, 32 // shrunk, shrunk, 24 // shrunk, shrunk).mean(axis=(3, 5))
        np.testing.assert_allclose(given.detach(), means, atol=1e-6)
        assert [each.shape[1] for each in judged.features] == [4, 8, 16, 32] and judged.score.shape == (2,)
        sides = [each.shape[2] for each in judged.features]
        assert sides == [max(1, 32 // shrunk // part) for part in (2, 4, 8, 16)]


def test_terms_are_means_over_the_three(monkeypatch: pytest.MonkeyPatch) -> None:
    """Odds of 1/4, 1/2 and 3/4 for what is painted; features differ by 1 and 3, 0 and 0, 2 and 6."""
    odds, gaps = (0.25, 0.5, 0.75), ((1.0, 3.0), (0.0, 0.0), (2.0, 6.0))
    painted = [
        Judged([torch.full((1, 2), gap) for gap in gap_pair], torch.tensor([math.log(p / (1 - p))]))
        for p, gap_pair in zip(odds, gaps, strict=True)
    ]
    true = [Judged([torch.zeros(1, 2), torch.zeros(1, 2)], torch.zeros(1)) for _ in odds]
    mine, answers = adversary(), iter([painted, true])
    monkeypatch.setattr(mine, "_judged", lambda *_: next(answers))
    terms = mine.terms(*pictures(), BEHIND)
    assert float(terms["adversarial"]) == pytest.approx((2 + 1 + math.log2(4 / 3)) / 3)
    assert float(terms["features"]) == pytest.approx(2)


def test_the_avatars_loss_leaves_the_discriminators_and_theirs_leaves_the_avatar() -> None:
    mine, (output, target) = adversary(), pictures()
    before = weights(mine)
    terms = mine.terms(output.requires_grad_(), target, BEHIND)
    (terms["adversarial"] + terms["features"]).backward()
    assert float(output.grad.abs().sum()) > 0 and weights(mine) == before
    assert all(value.grad is None for value in mine.discriminators.parameters())
    output.grad = None
    mine.learn(output, target, BEHIND)
    assert output.grad is None and all(now != then for now, then in zip(weights(mine), before, strict=True))


def test_they_learn_to_tell_painted_pictures_from_true_ones() -> None:
    """Bright ones from dark ones; for the avatar that makes it dearer. At first they nearly guess."""
    mine, dark = adversary(rate=3e-3), torch.full((2, 4, 16, 16), 0.2)
    bright, black = torch.full((2, 4, 16, 16), 0.9), torch.zeros(2, 3, 16, 16)
    cheap = float(mine.terms(dark, bright, black)["adversarial"].detach())
    errors = [mine.learn(dark, bright, black) for _ in range(60)]
    assert errors[0] == pytest.approx(1, abs=0.2) and errors[-1] < 0.5
    assert float(mine.terms(dark, bright, black)["adversarial"].detach()) > cheap + 0.5


def test_first_weights_are_the_seeds_and_no_other_random_numbers_change() -> None:
    torch.manual_seed(3)
    wanted = torch.rand(2)
    torch.manual_seed(3)
    first = weights(adversary())
    assert torch.equal(torch.rand(2), wanted)
    assert weights(adversary()) == first != weights(adversary(seed=2))


def test_they_are_among_the_terms_of_an_objective_that_has_them() -> None:
    output, target = pictures()
    with_one = Objective(WEIGHTS | {"adversarial": 2.0, "features": 3.0}, None, adversary())
    torch.manual_seed(4)
    terms = with_one.terms(output, target)
    torch.manual_seed(4)
    plain = Objective().terms(output, target)
    assert terms.keys() - plain.keys() == {"adversarial", "features"}
    extra = 2 * terms["adversarial"] + 3 * terms["features"]
    assert float(with_one.total(terms)) == pytest.approx(float(Objective().total(plain) + extra))
    assert with_one.learn(output, target).keys() == {JUDGES} and Objective().learn(output, target) == {}
