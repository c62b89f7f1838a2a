"""The objective that training minimises: the loss terms, also terms that need networks (VGG-16, discriminators).

Rule: a term that needs a network, or blurred pictures, is computed only if it has a weight. The same step on the same
pictures gives the same numbers.
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
from trilane.training.training_settings import LossWeights

PERCEPTUAL = "perceptual"
#: Key of the discriminators' error, in bits. It is reported beside the loss terms but is not minimised by the avatar.
JUDGES = "discriminators"


@dataclass(frozen=True)
class Objective:
    """The objective of a training.

    `weights`: weight of each term, by name.
    `vgg`: network of the perceptual loss; None: the perceptual loss is one minus MS-SSIM.
    `adversary`: discriminators; None: there are none.
    """

    weights: Mapping[str, float] = field(default_factory=lambda: WEIGHTS)
    vgg: Vgg16 | None = None
    adversary: Adversary | None = None

    def terms(self, output: Tensor, target: Tensor) -> dict[str, Tensor]:
        """Return the loss terms by name, not weighted, with the same random backgrounds behind both pictures.

        `output`, `target`: (N, 4, H, W) in 0..1, colour and mask, straight alpha.
        """
        behind = drawn_behind(target)
        terms = loss_terms(output, target, behind, self.weights)
        if self.weights.get(PERCEPTUAL):
            shown, wanted = composite(output, behind), composite(target, behind)
            distance = 1 - ms_ssim(shown, wanted) if self.vgg is None else self.vgg.distance(shown, wanted)
            terms[PERCEPTUAL] = distance.mean()
        return terms if self.adversary is None else terms | self.adversary.terms(output, target, behind)

    def total(self, terms: Mapping[str, Tensor]) -> Tensor:
        """Return the sum of `terms` (from the method `terms`), weighted by the objective's weights."""
        return total_loss(terms, self.weights)

    def learn(self, output: Tensor, target: Tensor) -> dict[str, float]:
        """Train the discriminators by one step, and return their error in bits under the key `JUDGES`.

        Without discriminators, return an empty dict.

        `output`, `target`: as in `terms`.
        """
        return {} if self.adversary is None else {JUDGES: self.adversary.learn(output, target, drawn_behind(target))}


# MS-SSIM of pictures in PyTorch, with gradients: similarity at five scales.
#
# Rule: windows lie wholly inside the picture. Scales at which the picture is smaller than a window are left out. The
# weights of the other scales are scaled to a sum of 1.

#: Weights of the scales, finest first: Wang, Simoncelli, Bovik, Multiscale structural similarity, 2003, section 3.2.
SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
WINDOW, SIGMA = 11, 1.5
#: Constants of luminance and of contrast, for values in 0..1.
C1, C2 = 0.01**2, 0.03**2
#: Lower bound of a similarity before it is raised to a power: a negative number has no real power.
LEAST = 1e-6


def ms_ssim(one: Tensor, other: Tensor) -> Tensor:
    """Return the MS-SSIM (N,) of the pictures `one` and `other`: formula 7 of the paper named at `SCALES`.

    It is a product over the scales. The factor of a scale is the mean similarity of contrast and structure, to the
    power of the scale's weight. At the last scale, the similarity includes luminance.

    `one`, `other`: (N, C, H, W) in 0..1, H and W at least 11.
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
    """Return (mean SSIM (N,), mean (N,) of its factor for contrast and structure). Parameters: as in `ms_ssim`."""
    mean_one, mean_other = _blurred(one), _blurred(other)
    variances = _blurred(one**2) - mean_one**2 + _blurred(other**2) - mean_other**2
    covariance = _blurred(one * other) - mean_one * mean_other
    structure = (2 * covariance + C2) / (variances + C2)
    luminance = (2 * mean_one * mean_other + C1) / (mean_one**2 + mean_other**2 + C1)
    return (luminance * structure).mean(dim=(1, 2, 3)), structure.mean(dim=(1, 2, 3))


def _blurred(picture: Tensor) -> Tensor:
    """Return `picture` (N, C, H, W) blurred by a Gaussian window, (N, C, H - 10, W - 10), without padding."""
    places = torch.arange(WINDOW, dtype=picture.dtype, device=picture.device) - WINDOW // 2
    bell = torch.exp(-(places**2) / (2 * SIGMA**2))
    bell = (bell / bell.sum()).expand(picture.shape[1], 1, WINDOW)
    down = functional.conv2d(picture, bell[..., None], groups=picture.shape[1])
    return functional.conv2d(down, bell[:, :, None], groups=picture.shape[1])


# The loss terms of training: errors of the picture, of its PSNR, colours, edges, structure and mask.
#
# Rule: every term is a mean over the pixels that it concerns, so that a weight means the same for every view. Each
# picture of a batch has a random background: in front of a fixed colour, a person who lets this colour through would
# have no error.
#
# The colour of pixels without a person is invisible. It is trained to be black; without this training it would be noise
# that differs from runtime to runtime.

#: Width in pixels of the border around the person that the terms also count.
MARGIN_PX = 5
#: Weights of the default avatar's loss.
WEIGHTS: Mapping[str, float] = {name: weight for name, weight in LossWeights().by_name().items() if weight}
#: Name of the term that is one minus MS-SSIM. It is computed only if it has a weight, because it takes several blurs.
STRUCTURE = "structure"
LEAST_SQUARE = 1e-5


def loss_terms(
    output: Tensor, target: Tensor, behind: Tensor, weights: Mapping[str, float] = WEIGHTS
) -> dict[str, Tensor]:
    """Return the loss terms by name, not weighted.

    The term `overlap` is the Dice loss, with 1 added to numerator and denominator so that it is 0 without a person.

    `output`, `target`: (N, 4, H, W) in 0..1, colour and mask, straight alpha.
    `behind`: background (N, 3, H, W) of both, as `drawn_behind` returns it.
    `weights`: weights by name. Only the weight of `STRUCTURE` matters here: without it, this term is not computed.
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
    """Return, for each picture (N,), the difference in dB from its PSNR to 50 dB, over the pixels where `near` is 1.

    50 dB is the PSNR of the mean square error `LEAST_SQUARE`. `LEAST_SQUARE` is added to each picture's mean square
    error, so that the difference is never negative.

    `difference`: (N, 3, H, W), picture minus target. `near`: (N, 1, H, W), 1 for pixels that count, else 0.
    """
    pixels = 3 * near.sum(dim=(1, 2, 3)) + 1
    square = (difference.square() * near).sum(dim=(1, 2, 3)) / pixels
    return 10 * torch.log10(1 + square / LEAST_SQUARE)


def _grown(mask: Tensor) -> Tensor:
    """Return (N, 1, H, W): 1 on the person and up to `MARGIN_PX` pixels around, else 0. `mask`: (N, 1, H, W)."""
    grown = mask.detach().contiguous()
    for along in ((1, 0), (0, 1)):
        kernel, padding = tuple(2 * MARGIN_PX * side + 1 for side in along), tuple(MARGIN_PX * side for side in along)
        grown = functional.max_pool2d(grown, kernel, stride=1, padding=padding)
    return grown.gt(0).float()


def total_loss(terms: Mapping[str, Tensor], weights: Mapping[str, float] = WEIGHTS) -> Tensor:
    """Return the sum of `terms`, weighted by `weights`; a term without a weight counts as 0."""
    return torch.stack([weights.get(name, 0.0) * term for name, term in terms.items()]).sum()


def composite(image: Tensor, behind: Tensor) -> Tensor:
    """Return the colours (N, 3, H, W) of `image` (N, 4, H, W), straight alpha, in front of `behind` (N, 3, H, W)."""
    mask = image[:, 3:]
    return image[:, :3] * mask + behind * (1 - mask)


def drawn_behind(target: Tensor) -> Tensor:
    """Return random backgrounds (N, 3, H, W) in 0..1, one for each picture of `target` (N, 4, H, W).

    They depend on the state of PyTorch's random generator.
    """
    rng = np.random.default_rng(int(torch.randint(2**62, ())))
    drawn = backgrounds(len(target), (target.shape[2], target.shape[3]), rng)
    return torch.from_numpy(drawn).permute(0, 3, 1, 2).to(target.device)


# The perceptual loss by features of VGG-16, whose weights the user supplies as a file.
#
# Rule: only tensors are read from the file, no code. Each tensor must have the shape that VGG-16 requires.

#: (Number of convolutions, number of channels) of each of the five blocks; the picture is halved between blocks.
#: Source: Simonyan and Zisserman, Very deep convolutional networks for large-scale image recognition, 2014, table 1,
#: column D.
BLOCKS = ((2, 64), (2, 128), (3, 256), (3, 512), (3, 512))
#: Mean and standard deviation of ImageNet's colours, by which VGG-16's input is normalised.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
EXPECTED = "weights of VGG-16 by torchvision's names (features.0.weight ...)"
SAFETENSORS = ".safetensors"
LEAST_LENGTH = 1e-10


class Vgg16(nn.Module):
    """The convolutions of VGG-16. Their weights come from a file (`read_vgg16`) and are never trained."""

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
        """Return the last features (N, C, h, w) of each block.

        `picture`: (N, 3, H, W) in 0..1, with H and W at least 16.
        """
        x, found = (picture - self.mean) / self.deviation, list[Tensor]()
        for layer, after in pairwise([*self.features, nn.MaxPool2d(2)]):
            x = layer(x)
            if isinstance(after, nn.MaxPool2d):
                found.append(x)
        return found

    def distance(self, one: Tensor, other: Tensor) -> Tensor:
        """Return the perceptual distance (N,) of the pictures `one` and `other` (N, 3, H, W) in 0..1.

        It is the squared difference of features that are normalised to length 1, averaged over pixels and summed over
        channels and blocks. Source: Zhang et al., The unreasonable effectiveness of deep features as a perceptual
        metric, 2018, formula 1, with all learned channel weights set to 1.
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
    """Return the network with the weights of a state dict in the file `path` (.pth, .pt or .safetensors).

    Raises BadInputError for another file. Raises MissingPartError for a .safetensors file if the package safetensors is
    not installed.
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
    """Return the state dict in a file of `torch.save`. `weights_only` refuses pickled code."""
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


# Three discriminators learn to distinguish the avatar's pictures from ground truth, and add terms to the avatar's loss.
#
# Rule: the avatar's loss does not change the discriminators, and the discriminators' loss does not change the avatar.
# Discriminators have no normalisation, so that a picture's score does not depend on other pictures of its batch.
#
# The thesis has three networks whose levels have falling resolution and rising numbers of channels; each gives one
# probability for a picture. It does not state their inputs. Here, each network reads the composited colours and the
# mask, at full, half or quarter size (Wang et al., High-resolution image synthesis with conditional GANs, 2018, section
# 3.2).

#: Factor by which the picture is shrunk, for each discriminator.
SHRUNK = (1, 2, 4)
SEEN_CHANNELS = 4
#: Numbers of channels of a discriminator's levels, as multiples of its width; each level halves the picture.
LEVELS = (1, 2, 4, 8)
SLOPE = 0.2
BETAS = (0.9, 0.999)


class Judgement(NamedTuple):
    """The output of a discriminator for N pictures.

    `features`: features (N, C, H, W) of each level. `score`: log odds (N,) that a picture is ground truth.
    """

    features: list[Tensor]
    score: Tensor


class Discriminator(nn.Module):
    """Strided 3x3 convolutions, followed by a 1x1 convolution whose output is averaged over the picture.

    `width`: number of channels of the first level.
    """

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
    """The three discriminators and their optimiser."""

    def __init__(self, width: int, rate: float, seed: int, device: torch.device | str = "cpu") -> None:
        """Build the discriminators.

        `width`: number of channels of the first level. `rate`: learning rate. `seed`: seed of the initial weights.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.discriminators = nn.ModuleList(Discriminator(width) for _ in SHRUNK).to(device)
        self.optimiser = torch.optim.Adam(self.discriminators.parameters(), lr=rate, betas=BETAS)

    def terms(self, output: Tensor, target: Tensor, behind: Tensor) -> dict[str, Tensor]:
        """Return the loss terms `adversarial` and `features`, which the avatar minimises.

        `adversarial` is small if the discriminators take `output` for ground truth. `features` is the mean absolute
        difference between the discriminators' features of `output` and of `target` (feature matching).

        `output`, `target`: (N, 4, H, W) in 0..1, colour and mask, straight alpha.
        `behind`: background (N, 3, H, W) of both.
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
        """Train the discriminators by one step, and return their mean error before the step, in bits.

        A discriminator that guesses has an error of 1 bit. `terms` describes the parameters.
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
    """Return the mean binary cross entropy of the log odds `score` (N,), in bits (thesis, formula 3.1).

    `true`: whether all N pictures are ground truth; if not, all are the avatar's.
    """
    return functional.softplus(-score if true else score).mean() / math.log(2)
