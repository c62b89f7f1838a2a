"""Three discriminators, which tell pictures of the person from painted ones, and what they add to the avatar's loss.

Rule: the avatar's loss does not change them, and their own does not change the avatar. No normalisation is in them, so
that a picture's score does not depend on the others of its batch.

The thesis has three networks of falling resolution and rising channels, each with one probability for a picture, and
does not say what the three see. Here each sees colours before a background and the mask, at the whole, half and quarter
size (Wang et al., High-resolution image synthesis with conditional GANs, 2018, section 3.2).
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from trilane.training.losses import composite

#: How much smaller the picture is that each discriminator sees.
SHRUNK = (1, 2, 4)
SEEN_CHANNELS = 4
#: Channels of the levels of one, as multiples of its width; each level halves the picture.
LEVELS = (1, 2, 4, 8)
SLOPE = 0.2
BETAS = (0.9, 0.999)


class Judged(NamedTuple):
    """What a discriminator finds. `features`: of each level, (N, C, H, W). `score` (N,): log odds of a true picture."""

    features: list[Tensor]
    score: Tensor


class Discriminator(nn.Module):
    """Strided 3x3 convolutions, the mean over the picture's places of a last 1x1 convolution."""

    def __init__(self, width: int) -> None:
        super().__init__()
        channels = (SEEN_CHANNELS, *(width * level for level in LEVELS))
        self.levels = nn.ModuleList(
            nn.Sequential(nn.Conv2d(before, after, 3, 2, 1), nn.LeakyReLU(SLOPE))
            for before, after in pairwise(channels)
        )
        self.score = nn.Conv2d(channels[-1], 1, 1)

    def forward(self, x: Tensor) -> Judged:
        features = []
        for level in self.levels:
            x = level(x)
            features.append(x)
        return Judged(features, self.score(x).mean(dim=(1, 2, 3)))


class Adversary:
    """The discriminators and Adam, which trains them."""

    def __init__(self, width: int, rate: float, seed: int, device: torch.device | str = "cpu") -> None:
        """`width`: channels of the first level. `rate`: of learning. `seed`: of the first weights."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.discriminators = nn.ModuleList(Discriminator(width) for _ in SHRUNK).to(device)
        self.optimiser = torch.optim.Adam(self.discriminators.parameters(), lr=rate, betas=BETAS)

    def terms(self, output: Tensor, target: Tensor, behind: Tensor) -> dict[str, Tensor]:
        """What the avatar minimises: `adversarial`, that its pictures are told from true ones, and `features`.

        `output`, `target` (N, 4, H, W): straight colour and mask in 0..1; both are judged over `behind` (N, 3, H, W).
        `features`: the mean difference of the discriminators' features (feature matching).
        """
        self.discriminators.requires_grad_(False)
        painted, true = self._judged(output, behind), self._judged(target, behind)
        self.discriminators.requires_grad_(True)
        differences = [
            functional.l1_loss(one, other)
            for mine, theirs in zip(painted, true, strict=True)
            for one, other in zip(mine.features, theirs.features, strict=True)
        ]
        fooled = torch.stack([bits(judged.score, true=True) for judged in painted])
        return {"adversarial": fooled.mean(), "features": torch.stack(differences).mean()}

    def learn(self, output: Tensor, target: Tensor, behind: Tensor) -> float:
        """One step of the discriminators on these pictures; their mean error before it: 1 bit where they guess."""
        wrong = [
            (bits(mine.score, true=False) + bits(theirs.score, true=True)) / 2
            for mine, theirs in zip(self._judged(output.detach(), behind), self._judged(target, behind), strict=True)
        ]
        loss = torch.stack(wrong).mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()
        return float(loss.detach())

    def _judged(self, picture: Tensor, behind: Tensor) -> list[Judged]:
        seen = torch.cat((composite(picture, behind), picture[:, 3:]), dim=1)
        return [
            judge(functional.avg_pool2d(seen, shrunk, ceil_mode=True))
            for judge, shrunk in zip(self.discriminators, SHRUNK, strict=True)
        ]


def bits(score: Tensor, true: bool) -> Tensor:
    """Binary cross entropy, in bits (thesis, formula 3.1), of log odds `score` (N,) of pictures that are all `true`."""
    return functional.softplus(-score if true else score).mean() / math.log(2)
