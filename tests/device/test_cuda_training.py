"""Training on a GPU: a step changes the avatar as the same step on the CPU does, to float32's rounding."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trilane.training.network import UNet  # noqa: E402
from trilane.training.objective import Adversary, Objective  # noqa: E402
from trilane.training.step_loop import add_gradients, clip_gradients  # noqa: E402
from trilane.training.trainable_avatar import NeuralTexture, TrainableAvatar  # noqa: E402
from trilane.training.training_settings import parsed_settings  # noqa: E402

#: Gradients are sums of up to N*H*W = 8192 products; the rounding of such a sum differs by about sqrt(8192) * 2**-24 of
#: it, and one step of plain descent at this rate moves a weight by its gradient times 0.01.
TOLERANCE = 1e-4


@pytest.mark.parametrize("loss", ["default", "thesis"])
def test_one_step_is_the_cpus(cuda: Any, loss: str) -> None:
    settings = parsed_settings({"loss": loss}, "a test")
    weights = settings.loss
    torch.manual_seed(0)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    random = np.random.default_rng(0)
    start = random.uniform(-0.5, 0.5, (64, 64, 4)).astype(np.float32)
    avatar = TrainableAvatar(UNet(width=4, channels=4), NeuralTexture(start, sides=(64, 32)))
    batch = (
        torch.from_numpy(random.uniform(0, 1, (2, 64, 64, 2)).astype(np.float32)),
        torch.from_numpy(random.uniform(0, 1, (2, 64, 64)) > 0.5),
        torch.from_numpy(random.uniform(0, 1, (2, 4, 64, 64)).astype(np.float32)),
    )
    on_gpu = copy.deepcopy(avatar).to(cuda)
    losses = []
    for each, device in ((avatar, torch.device("cpu")), (on_gpu, cuda)):
        adversary = Adversary(4, 1e-3, 1, device) if weights.judged else None
        placed = (batch[0].to(device), batch[1].to(device), batch[2].to(device))
        losses.append(add_gradients(each, placed, Objective(weights.by_name(), None, adversary)))
        clip_gradients(each, settings.optimiser)
        torch.optim.SGD(each.parameters(), 0.01).step()
    assert losses[1] == pytest.approx(losses[0], rel=TOLERANCE)
    for name, value in avatar.state_dict().items():
        np.testing.assert_allclose(on_gpu.state_dict()[name].cpu(), value, atol=TOLERANCE, err_msg=name)
