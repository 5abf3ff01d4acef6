"""Source of truth: AlexNet as in torchvision, and the formula of Zhang et al. on its features.

The `lpips` package gave exactly the same numbers with the same random weights when this was written.
"""

import pytest
import torch
from torch import nn

from hyperplanes.evaluation.perceptual import LPIPS
from hyperplanes.utilities.files.checkpoints import CheckpointError, save_tensors


def alexnet():
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, padding=2), nn.ReLU()),
        *(nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(), nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    )


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    network, state = alexnet(), {"scaling_layer.shift": torch.zeros(1, 3, 1, 1)}
    for number, index in enumerate((0, 3, 6, 8, 10), 1):
        state[f"net.slice{number}.{index}.weight"] = network[index].weight
        state[f"net.slice{number}.{index}.bias"] = network[index].bias
        state[f"lin{number - 1}.model.1.weight"] = torch.rand(1, network[index].out_channels, 1, 1)
    path = tmp_path_factory.mktemp("lpips") / "alex.safetensors"
    save_tensors(path, state)
    return path, network, state


@torch.no_grad()
def reference(network, state, first, second):
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    total = 0.0
    pair = [(2 * each - 1 - shift[:, None, None]) / scale[:, None, None] for each in (first, second)]
    for index, layer in enumerate(network):
        pair = [layer(each) for each in pair]
        if index in (1, 4, 7, 9, 11):
            number = (1, 4, 7, 9, 11).index(index)
            units = [each / each.norm(dim=0, keepdim=True).clamp(min=1e-10) for each in pair]
            weight = state[f"lin{number}.model.1.weight"].flatten()[:, None, None]
            total += float((weight * (units[0] - units[1]) ** 2).sum(0).mean())
    return total


def test_lpips_agrees_with_its_formula(weights):
    path, network, state = weights
    first, second = torch.rand(2, 2, 3, 40, 33, generator=torch.Generator().manual_seed(1))
    found = LPIPS(path)(first, second)
    assert found.tolist() == pytest.approx(
        [reference(network, state, a, b) for a, b in zip(first, second, strict=True)]
    )
    assert LPIPS(path)(first, first).tolist() == [0.0, 0.0]


def test_small_images_and_incomplete_weights_are_refused(weights, tmp_path):
    path, _, state = weights
    with pytest.raises(ValueError, match="expected at least 32 x 32 pixels for LPIPS, got 16 x 40"):
        LPIPS(path)(torch.rand(1, 3, 16, 40), torch.rand(1, 3, 16, 40))
    save_tensors(tmp_path / "part.safetensors", {n: v for n, v in state.items() if n != "lin4.model.1.weight"})
    with pytest.raises(CheckpointError, match=r"part.safetensors: expected a tensor 'lin4.model.1.weight', found none"):
        LPIPS(tmp_path / "part.safetensors")
