"""Hypernetworks that read a grid. Sources of truth: PyTorch's convolutions, and properties."""

import pytest
import torch
from torch.nn.functional import conv3d

from hyperplanes.geometry.volume import VALUES_PER_CELL, VOLUME_SIDE
from hyperplanes.hypernetwork import Observed, VolumeHyperNetwork
from hyperplanes.hypernetwork.volume.volume_network import VolumeNetwork, _Convolution, _fold, _Pointwise, _unfold

GRIDS = {
    "coarse.grid.weight": torch.Size((2, VOLUME_SIDE, VOLUME_SIDE, VOLUME_SIDE)),
    "fine.grid.weight": torch.Size((5, VOLUME_SIDE, VOLUME_SIDE, VOLUME_SIDE)),
}
SHAPES = {**GRIDS, "fine.layers.0.weight": torch.Size((12, 7)), "fine.layers.0.bias": torch.Size((12,))}


def volumes(count=3):
    return torch.randn(
        count, VALUES_PER_CELL, VOLUME_SIDE, VOLUME_SIDE, VOLUME_SIDE, generator=torch.Generator().manual_seed(1)
    )


def test_folding_keeps_every_value_and_blocks_become_channels():
    value = torch.arange(2 * 3 * 8**3).reshape(2, 3, 8, 8, 8).float()
    folded = _fold(value)
    assert folded.shape == (2, 24, 4, 4, 4)
    assert torch.equal(_unfold(folded, 3), value)
    block = value[1, 2, 4:6, 2:4, 6:8].flatten()
    assert torch.equal(folded[1, 16:24, 2, 1, 3], block)


def test_an_untrained_hypernetwork_changes_nothing_and_names_the_grids_by_their_shapes():
    network = VolumeHyperNetwork(SHAPES, VALUES_PER_CELL, VOLUME_SIDE)
    for update in network(Observed(volume=volumes()), {}):
        assert {name: value.shape for name, value in update.items()} == GRIDS
        assert not any(value.any() for value in update.values())


def test_updates_of_objects_of_a_batch_are_independent():
    torch.manual_seed(2)
    network = VolumeHyperNetwork(SHAPES, VALUES_PER_CELL, VOLUME_SIDE).eval()
    torch.nn.init.normal_(network.encoder.last.weight, std=0.1)
    with torch.no_grad():
        together = network(Observed(volume=volumes()), {})
        for index, one in enumerate(together):
            for name, value in network(Observed(volume=volumes()[index : index + 1]), {})[0].items():
                torch.testing.assert_close(one[name], value, atol=1e-4, rtol=1e-4)
    for name in GRIDS:
        assert not torch.allclose(together[0][name], together[1][name])


def test_features_of_a_cell_depend_on_its_neighbourhood():
    network = VolumeNetwork(VALUES_PER_CELL, VOLUME_SIDE, 4).eval()
    torch.nn.init.normal_(network.last.weight, std=0.1)
    first = volumes(1)
    second = first.clone()
    second[:, :, 16:18, 16:18, 16:18] += 3.0
    with torch.no_grad():
        moved = (network(second) - network(first)).abs().amax((0, 1))
    assert moved[16, 16, 16] > 10 * moved[0, 0, 0]
    assert moved[12, 16, 16] > 0


def test_a_side_that_cannot_be_halved_three_times_is_refused():
    with pytest.raises(ValueError, match="side: expected a multiple of 8, got 12"):
        VolumeNetwork(VALUES_PER_CELL, 12, 4)


@pytest.mark.parametrize("count", [1, 2])  # a single volume has its own implementation
@pytest.mark.parametrize(("layer", "plain"), [(_Convolution(3, 5, 2), (2, 1)), (_Pointwise(3, 5), (1, 0))])
def test_convolutions_and_their_gradients_are_those_of_pytorch(layer, plain, count):
    stride, padding = plain
    given = torch.randn(count, 3, 6, 6, 6, generator=torch.Generator().manual_seed(3), requires_grad=True)
    found, expected = layer(given), conv3d(given, layer.weight, layer.bias, stride, padding)
    torch.testing.assert_close(found, expected)
    variables = [given, layer.weight, layer.bias]
    torch.testing.assert_close(*(torch.autograd.grad((2 * each).sin().sum(), variables) for each in (found, expected)))


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # in jvp
@pytest.mark.filterwarnings("ignore:TF32 acceleration on top of oneDNN:UserWarning")  # in flags
def test_a_single_volume_is_convolved_under_transforms_in_double_precision_and_without_onednn():
    layer = _Convolution(3, 5)
    given = torch.randn(1, 3, 6, 6, 6, generator=torch.Generator().manual_seed(3))
    expected = conv3d(given, layer.weight, layer.bias, 1, 1)
    value, tangent = torch.func.jvp(layer, (given,), (given,))
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(tangent, expected - layer.bias[:, None, None, None])
    torch.testing.assert_close(layer.double()(given.double()).float(), expected)
    layer.float()
    with torch.backends.mkldnn.flags(enabled=False):
        torch.testing.assert_close(layer(given), expected)


def test_a_pointwise_convolution_reads_several_inputs_as_if_they_were_concatenated():
    layer, parts = (
        _Pointwise(5, 4),
        torch.randn(2, 5, 2, 2, 2, generator=torch.Generator().manual_seed(4)).split([2, 3], 1),
    )
    torch.testing.assert_close(layer(*parts), layer(torch.cat(parts, 1)))
