"""The objective that training minimises: the loss terms, including the terms that need networks of their own.

Rule: a term is computed only where it has a weight, and the same step on the same pictures gives the same numbers.
"""

from __future__ import annotations

import math
import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from trilane.errors import BadInputError, MissingPartError, package_line, reason
from trilane.training.image_error import backgrounds

PERCEPTUAL = "perceptual"
#: Key of the discriminators' own error, in bits; it is reported with the terms but is not one of them.
JUDGES = "discriminators"


@dataclass(frozen=True)
class Objective:
    """What a training minimises.

    `weights`: weights of the terms, by name. `vgg`: network of the perceptual loss; None for MS-SSIM. `adversary`:
    discriminators, or None.
    """

    weights: Mapping[str, float] = field(default_factory=lambda: WEIGHTS)
    vgg: Vgg16 | None = None
    adversary: Adversary | None = None

    def terms(self, output: Tensor, target: Tensor) -> dict[str, Tensor]:
        """Return the terms by name, before weighting; the backgrounds behind both pictures are drawn here.

        `output`, `target` (N, 4, H, W): straight colour and mask, 0..1.
        """
        behind = drawn_behind(target)
        terms = loss_terms(output, target, behind, self.weights)
        if self.weights.get(PERCEPTUAL):
            shown, wanted = composite(output, behind), composite(target, behind)
            distance = 1 - ms_ssim(shown, wanted) if self.vgg is None else self.vgg.distance(shown, wanted)
            terms[PERCEPTUAL] = distance.mean()
        return terms if self.adversary is None else terms | self.adversary.terms(output, target, behind)

    def total(self, terms: Mapping[str, Tensor]) -> Tensor:
        """Return the weighted sum of `terms`, which is minimised."""
        return total_loss(terms, self.weights)

    def learn(self, output: Tensor, target: Tensor) -> dict[str, float]:
        """Train the discriminators, if any, by one step on these pictures, and return their error by name."""
        return {} if self.adversary is None else {JUDGES: self.adversary.learn(output, target, drawn_behind(target))}


# MS-SSIM of pictures, in a form that can be minimised: structure at five scales, without any network's weights.
#
# Rule: windows lie wholly inside the picture. A picture that is too small for some scales is compared at those that it
# has, with their weights scaled to a sum of 1.

#: Weights of the scales, finest first: Wang, Simoncelli, Bovik, Multiscale structural similarity, 2003, section 3.2.
SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
WINDOW, SIGMA = 11, 1.5
#: Constants of luminance and of contrast, for values in 0..1.
C1, C2 = 0.01**2, 0.03**2
#: Replaces a negative structure, because a negative number has no real power.
LEAST = 1e-6


def ms_ssim(one: Tensor, other: Tensor) -> Tensor:
    """Return (N,): the product of the mean contrast and structure of each scale, with luminance at the last one.

    `one`, `other` (N, C, H, W) in 0..1, H and W at least 11. Formula 7 of the paper above, with equal exponents.
    """
    sizes = [min(one.shape[-2:]) >> scale for scale in range(len(SCALES))]
    weights = [weight for weight, size in zip(SCALES, sizes, strict=True) if size >= WINDOW]
    product = one.new_ones(len(one))
    for scale, weight in enumerate(weights):
        whole, structure = _similarity(one, other)
        last = scale == len(weights) - 1
        product = product * (whole if last else structure).clamp(min=LEAST) ** (weight / sum(weights))
        one, other = functional.avg_pool2d(one, 2), functional.avg_pool2d(other, 2)
    return product


def _similarity(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """Return two tensors (N,): the mean SSIM, and the mean of its factor of contrast and structure."""
    mean_one, mean_other = _blurred(one), _blurred(other)
    variances = _blurred(one**2) - mean_one**2 + _blurred(other**2) - mean_other**2
    covariance = _blurred(one * other) - mean_one * mean_other
    structure = (2 * covariance + C2) / (variances + C2)
    luminance = (2 * mean_one * mean_other + C1) / (mean_one**2 + mean_other**2 + C1)
    return (luminance * structure).mean(dim=(1, 2, 3)), structure.mean(dim=(1, 2, 3))


def _blurred(picture: Tensor) -> Tensor:
    """Return `picture` (N, C, H, W) blurred by a Gaussian window, where the window lies inside it."""
    places = torch.arange(WINDOW, dtype=picture.dtype, device=picture.device) - WINDOW // 2
    bell = torch.exp(-(places**2) / (2 * SIGMA**2))
    bell = (bell / bell.sum()).expand(picture.shape[1], 1, WINDOW)
    down = functional.conv2d(picture, bell[..., None], groups=picture.shape[1])
    return functional.conv2d(down, bell[:, :, None], groups=picture.shape[1])


# The loss terms of training: errors of the picture, of its PSNR, colours, edges, structure and mask.
#
# Rule: every term is a mean over the pixels it is about, so that a weight means the same for every view. Each picture
# of a batch stands before a background of its own: before one colour for all, a person who lets that colour through has
# no error.
#
# The colour where there is no person is not visible and is trained to be black: otherwise it would be noise that
# differs from runtime to runtime.

#: Pixels round the person that count as its outline.
MARGIN_PX = 5
WEIGHTS: Mapping[str, float] = {
    "composite": 0.4,
    "decibels": 0.03,
    "colour": 0.1,
    "edges": 0.2,
    "coarse": 0.2,
    "mask": 0.1,
    "background": 0.05,
    "overlap": 0.1,
}
#: One minus MS-SSIM. It is computed only where it has a weight, because it takes several blurs.
STRUCTURE = "structure"
LEAST_SQUARE = 1e-5


def loss_terms(
    output: Tensor, target: Tensor, behind: Tensor, weights: Mapping[str, float] = WEIGHTS
) -> dict[str, Tensor]:
    """Return the terms by name, before weighting.

    `output`, `target` (N, 4, H, W): straight colour and mask, 0..1.
    `behind` (N, 3, H, W): background of both, as `drawn_behind` draws it.
    `weights`: weights by name; the one of `STRUCTURE` decides whether that term is computed.
    The term `overlap` is the Dice loss, with one pixel more in numerator and denominator, so it is 0 without a person.
    """
    mask, true_mask = output[:, 3:], target[:, 3:]
    near = _grown(true_mask)
    pixels = near.sum() * 3 + 1
    shown, wanted = composite(output, behind), composite(target, behind)
    difference = shown - wanted
    size = difference.abs()
    terms = {
        "composite": (size * (near + 0.05)).sum() / pixels,
        "decibels": missing_db(difference, near).mean(),
        "colour": ((output[:, :3] - target[:, :3]).abs() * true_mask).sum() / pixels,
        "edges": (
            (difference[..., 1:] - difference[..., :-1]).abs().sum()
            + (difference[..., 1:, :] - difference[..., :-1, :]).abs().sum()
        )
        / pixels,
        "coarse": functional.avg_pool2d(difference, 4).abs().sum() * 16 / pixels,
        "mask": functional.binary_cross_entropy(mask.clamp(1e-4, 1 - 1e-4), true_mask),
        "background": -(torch.log1p(-output[:, :3].clamp(max=1 - 1e-4)) * (true_mask == 0)).mean(),
        "overlap": 1 - (2 * (mask * true_mask).sum() + 1) / (mask.sum() + true_mask.sum() + 1),
    }
    if weights.get(STRUCTURE):
        terms[STRUCTURE] = 1 - ms_ssim(shown, wanted).mean()
    return terms


def missing_db(difference: Tensor, near: Tensor) -> Tensor:
    """Return the loss of PSNR (N,) in dB that each picture's `difference` causes where `near` is 1.

    `difference` (N, 3, H, W), `near` (N, 1, H, W). The loss counts from a mean square of `LEAST_SQUARE`, a PSNR of 50
    dB, which is as good as no difference.
    """
    pixels = 3 * near.sum(dim=(1, 2, 3)) + 1
    square = (difference.square() * near).sum(dim=(1, 2, 3)) / pixels
    return 10 * torch.log10(1 + square / LEAST_SQUARE)


def _grown(mask: Tensor) -> Tensor:
    """Return (N, 1, H, W): 1 on the person of `mask` and up to `MARGIN_PX` around it, else 0."""
    grown = mask.detach().contiguous()
    for along in ((1, 0), (0, 1)):
        kernel, padding = tuple(2 * MARGIN_PX * side + 1 for side in along), tuple(MARGIN_PX * side for side in along)
        grown = functional.max_pool2d(grown, kernel, stride=1, padding=padding)
    return grown.gt(0).float()


def total_loss(terms: Mapping[str, Tensor], weights: Mapping[str, float] = WEIGHTS) -> Tensor:
    """Return the sum of the terms, weighted by `weights`; a term without a weight counts nothing."""
    return torch.stack([weights.get(name, 0.0) * term for name, term in terms.items()]).sum()


def composite(image: Tensor, behind: Tensor) -> Tensor:
    """Composite `image` (N, 4, H, W) over `behind` (N, 3, H, W) and return (N, 3, H, W)."""
    mask = image[:, 3:]
    return image[:, :3] * mask + behind * (1 - mask)


def drawn_behind(target: Tensor) -> Tensor:
    """Return a background (N, 3, H, W) for each picture of `target` (N, 4, H, W), drawn by PyTorch's random numbers."""
    rng = np.random.default_rng(int(torch.randint(2**62, ())))
    drawn = backgrounds(len(target), (target.shape[2], target.shape[3]), rng)
    return torch.from_numpy(drawn).permute(0, 3, 1, 2).to(target.device)


# The perceptual loss by features of VGG-16, whose weights the user supplies as a file.
#
# Rule: the file is data: only tensors are read from it, and each must have the size that VGG-16 requires.

#: Number of convolutions and channels of the five blocks, between which the picture is halved: Simonyan and Zisserman,
#: Very deep convolutional networks for large-scale image recognition, 2014, table 1, column D.
BLOCKS = ((2, 64), (2, 128), (3, 256), (3, 512), (3, 512))
#: Mean and deviation of ImageNet's colours, for which the weights were trained.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
EXPECTED = "weights of VGG-16 by torchvision's names (features.0.weight ...)"
SAFETENSORS = ".safetensors"
LEAST_LENGTH = 1e-10


class Vgg16(nn.Module):
    """The convolutions of VGG-16, without weights of its own; its parameters are never trained."""

    def __init__(self) -> None:
        super().__init__()
        layers, before = list[nn.Module](), 3
        for count, channels in BLOCKS:
            for _ in range(count):
                layers += [nn.Conv2d(before, channels, 3, 1, 1), nn.ReLU()]
                before = channels
            layers.append(nn.MaxPool2d(2))
        self.features = nn.Sequential(*layers[:-1])
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(DEVIATION)[:, None, None], persistent=False)
        self.requires_grad_(False)

    def forward(self, picture: Tensor) -> list[Tensor]:
        """Return the last features of each block for `picture` (N, 3, H, W) in 0..1, sides at least 16."""
        x, found = (picture - self.mean) / self.deviation, list[Tensor]()
        for layer, after in pairwise([*self.features, nn.MaxPool2d(2)]):
            x = layer(x)
            if isinstance(after, nn.MaxPool2d):
                found.append(x)
        return found

    def distance(self, one: Tensor, other: Tensor) -> Tensor:
        """Return the perceptual distance (N,) of pictures (N, 3, H, W) in 0..1.

        It is the squared difference of features that are scaled to length 1, summed over blocks. Zhang et al., The
        unreasonable effectiveness of deep features as a perceptual metric, 2018, formula 1, with all learned channel
        weights set to 1.
        """
        parts = [
            (functional.normalize(mine, eps=LEAST_LENGTH) - functional.normalize(theirs, eps=LEAST_LENGTH))
            .square()
            .sum(dim=1)
            .mean(dim=(1, 2))
            for mine, theirs in zip(self(one), self(other), strict=True)
        ]
        return torch.stack(parts).sum(dim=0)


def read_vgg16(path: Path) -> Vgg16:
    """Read the network from a state dict in the file `path` (.pth, .pt or .safetensors).

    Raises BadInputError; MissingPartError for a .safetensors file where that package is not installed.
    """
    found, network = _tensors(path), Vgg16()
    for name, wanted in network.state_dict().items():
        tensor = found.get(name)
        if not isinstance(tensor, Tensor):
            raise BadInputError(path, f"no tensor {name}", EXPECTED)
        if tensor.shape != wanted.shape:
            raise BadInputError(f"{path}: {name}", str(tuple(tensor.shape)), f"{tuple(wanted.shape)} of VGG-16")
        if not bool(tensor.isfinite().all()):
            raise BadInputError(f"{path}: {name}", "numbers that are not finite", EXPECTED)
        wanted.copy_(tensor)
    return network


def _tensors(path: Path) -> dict[str, object]:
    try:
        return _safe_tensors(path) if path.suffix == SAFETENSORS else _saved_tensors(path)
    except (OSError, EOFError, RuntimeError, ValueError, pickle.UnpicklingError, zipfile.BadZipFile) as error:
        raise BadInputError(path, reason(error).splitlines()[0], EXPECTED) from error


def _saved_tensors(path: Path) -> dict[str, object]:
    """Read what `torch.save` wrote; with `weights_only` the file can hold tensors and plain values, and no code."""
    found = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(found, dict):
        raise ValueError(f"a {type(found).__name__}, not a state dict")
    return found


def _safe_tensors(path: Path) -> dict[str, object]:
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError:
        raise MissingPartError("reading .safetensors needs safetensors", package_line("safetensors")) from None
    try:
        return dict(load_file(path))
    except SafetensorError as error:
        raise ValueError(str(error)) from error


# Three discriminators, which tell pictures of the person from painted ones, and the terms that they add to the avatar's
# loss.
#
# Rule: the avatar's loss does not change the discriminators, and their loss does not change the avatar. They have no
# normalisation, so that a picture's score does not depend on the others of its batch.
#
# The thesis has three networks of falling resolution and rising channels, each with one probability for a picture, and
# does not say what each of the three sees. Here each sees the mask and the colours before a background, at the whole,
# half and quarter size (Wang et al., High-resolution image synthesis with conditional GANs, 2018, section 3.2).

#: Factor by which the picture is shrunk for each discriminator.
SHRUNK = (1, 2, 4)
SEEN_CHANNELS = 4
#: Channels of a discriminator's levels, as multiples of its width; each level halves the picture.
LEVELS = (1, 2, 4, 8)
SLOPE = 0.2
BETAS = (0.9, 0.999)


class Judgement(NamedTuple):
    """The findings of a discriminator.

    `features`: features of each level, (N, C, H, W). `score` (N,): log odds that the picture is a true one.
    """

    features: list[Tensor]
    score: Tensor


class Discriminator(nn.Module):
    """Strided 3x3 convolutions, then a last 1x1 convolution whose output is averaged over the picture."""

    def __init__(self, width: int) -> None:
        super().__init__()
        channels = (SEEN_CHANNELS, *(width * level for level in LEVELS))
        self.levels = nn.ModuleList(
            nn.Sequential(nn.Conv2d(before, after, 3, 2, 1), nn.LeakyReLU(SLOPE))
            for before, after in pairwise(channels)
        )
        self.score = nn.Conv2d(channels[-1], 1, 1)

    def forward(self, x: Tensor) -> Judgement:
        features = []
        for level in self.levels:
            x = level(x)
            features.append(x)
        return Judgement(features, self.score(x).mean(dim=(1, 2, 3)))


class Adversary:
    """The discriminators and Adam, which trains them."""

    def __init__(self, width: int, rate: float, seed: int, device: torch.device | str = "cpu") -> None:
        """Build the discriminators.

        `width`: channels of the first level. `rate`: learning rate. `seed`: seed of the first weights.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.discriminators = nn.ModuleList(Discriminator(width) for _ in SHRUNK).to(device)
        self.optimiser = torch.optim.Adam(self.discriminators.parameters(), lr=rate, betas=BETAS)

    def terms(self, output: Tensor, target: Tensor, behind: Tensor) -> dict[str, Tensor]:
        """Return the terms that the avatar minimises against the discriminators.

        `output`, `target` (N, 4, H, W): straight colour and mask in 0..1; both are judged over `behind` (N, 3, H, W).
        `adversarial` falls as the discriminators take painted pictures for true ones. `features` is the mean difference
        of their features (feature matching).
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
        """Train the discriminators by one step on these pictures and return their mean error before it, in bits.

        The error is 1 bit where they guess.
        """
        wrong = [
            (bits(mine.score, true=False) + bits(theirs.score, true=True)) / 2
            for mine, theirs in zip(self._judged(output.detach(), behind), self._judged(target, behind), strict=True)
        ]
        loss = torch.stack(wrong).mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()
        return float(loss.detach())

    def _judged(self, picture: Tensor, behind: Tensor) -> list[Judgement]:
        seen = torch.cat((composite(picture, behind), picture[:, 3:]), dim=1)
        return [
            judge(functional.avg_pool2d(seen, shrunk, ceil_mode=True))
            for judge, shrunk in zip(self.discriminators, SHRUNK, strict=True)
        ]


def bits(score: Tensor, true: bool) -> Tensor:
    """Return the mean binary cross entropy of log odds `score` (N,), in bits (thesis, formula 3.1).

    `true`: whether all the pictures are true ones; else all are painted.
    """
    return functional.softplus(-score if true else score).mean() / math.log(2)
