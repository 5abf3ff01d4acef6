"""Hypernetworks that read a grid. Source of truth: what must not matter, and what must be zero."""

import pytest
import torch

from hyperplanes.geometry.volume import CHANNELS, SIDE
from hyperplanes.hypernetwork import Observed, VolumeHyperNetwork, VolumeHyperNetworkConfig
from hyperplanes.hypernetwork.volume_network import VolumeNetwork, _fold, _unfold

SHAPES = {
    "fine.grid.weight": torch.Size((5, SIDE, SIDE, SIDE)),
    "fine.layers.0.weight": torch.Size((12, 7)),
    "fine.layers.0.bias": torch.Size((12,)),
    "fine.density.weight": torch.Size((1, 12)),
}
CONFIG = VolumeHyperNetworkConfig(
    code=16, depth=1, width=16, layers=("all",), update="low_rank", rank=1, weights_seen="all"
)


def theta():
    generator = torch.Generator().manual_seed(0)
    return {name: torch.randn(shape, generator=generator) for name, shape in SHAPES.items()}


def volumes(count=3):
    return torch.randn(count, CHANNELS, SIDE, SIDE, SIDE, generator=torch.Generator().manual_seed(1))


def seen(volume):
    return Observed(volume=volume)


def awake(**changes):
    """A hypernetwork whose outputs are not zero."""
    torch.manual_seed(2)
    network = VolumeHyperNetwork(
        VolumeHyperNetworkConfig(**{**CONFIG.__dict__, **changes}), SHAPES, CHANNELS, SIDE
    ).eval()
    for layer in (*network.outputs, network.encoder.last):
        torch.nn.init.normal_(layer.weight, std=0.1)
    return network


def test_folding_keeps_every_value_and_blocks_become_channels():
    value = torch.arange(2 * 3 * 8**3).reshape(2, 3, 8, 8, 8).float()
    folded = _fold(value)
    assert folded.shape == (2, 24, 4, 4, 4)
    assert torch.equal(_unfold(folded, 3), value)
    block = value[1, 2, 4:6, 2:4, 6:8].flatten()
    assert torch.equal(folded[1, 16:24, 2, 1, 3], block)


def test_an_untrained_hypernetwork_changes_nothing_and_names_every_parameter_by_its_shape():
    network = VolumeHyperNetwork(CONFIG, SHAPES, CHANNELS, SIDE)
    for update in network(seen(volumes()), theta()):
        assert {name: value.shape for name, value in update.items()} == SHAPES
        assert not any(value.any() for value in update.values())


def test_the_update_of_an_object_does_not_depend_on_what_else_is_in_the_batch():
    network = awake()
    with torch.no_grad():
        together = network(seen(volumes()), theta())
        for index, one in enumerate(together):
            for name, value in network(seen(volumes()[index : index + 1]), theta())[0].items():
                torch.testing.assert_close(one[name], value, atol=1e-4, rtol=1e-4)
    for name in SHAPES:
        assert not torch.allclose(together[0][name], together[1][name])


def test_a_cell_has_features_of_what_lies_around_it():
    network = VolumeNetwork(CHANNELS, SIDE, 8, 4).eval()
    torch.nn.init.normal_(network.last.weight, std=0.1)
    first = volumes(1)
    second = first.clone()
    second[:, :, 16:18, 16:18, 16:18] += 3.0
    with torch.no_grad():
        moved = (network(second)[1] - network(first)[1]).abs().amax((0, 1))
    assert moved[16, 16, 16] > 10 * moved[0, 0, 0]
    assert moved[12, 16, 16] > 0


def test_layers_can_be_chosen():
    only = awake(layers=("grid",))(seen(volumes(1)), theta())[0]
    assert set(only) == {"fine.grid.weight"}
    torch.manual_seed(0)
    without = VolumeHyperNetwork(
        VolumeHyperNetworkConfig(**{**CONFIG.__dict__, "layers": ("density",)}), SHAPES, CHANNELS, SIDE
    )
    assert set(without(seen(volumes(1)), theta())[0]) == {"fine.density.weight"}
    with pytest.raises(ValueError, match="layers: expected"):
        awake(layers=("walls",))
