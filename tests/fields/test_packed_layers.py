"""Sources of truth: PyTorch's layers in float64, and properties: neither batches nor threads change a bit."""

import pytest
import torch

from hyperplanes.fields import TARGETS, TargetConfig
from hyperplanes.fields import layers as packed_layers
from hyperplanes.fields.layers import PackedLayers
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.rays import Sphere
from hyperplanes.parameters import Parameters
from tests.reference_rendering import ring


@pytest.fixture(autouse=True)
def kernel_anywhere(monkeypatch):
    """It is right on every processor, and only used where it is fast."""
    monkeypatch.setattr(packed_layers, "has_kernel", lambda: True)


def weights(depth, width, inputs, skip, seed=0):
    generator = torch.Generator().manual_seed(seed)
    sizes = [inputs if not index else width + inputs * (index == skip) for index in range(depth)]
    drawn = {}
    for index, size in enumerate(sizes):
        drawn[f"layers.{index}.weight"] = torch.randn(width, size, generator=generator) * (2 / size) ** 0.5
        drawn[f"layers.{index}.bias"] = torch.randn(width, generator=generator)
    return drawn


def by_pytorch(drawn, given, depth, skip):
    value = given
    for index in range(depth):
        value = torch.cat([given, value], 1) if index == skip > 0 else value
        value = (value @ drawn[f"layers.{index}.weight"].T + drawn[f"layers.{index}.bias"]).clamp_min(0)
    return value


@pytest.mark.parametrize(("depth", "width", "inputs"), [(1, 64, 7), (2, 128, 1), (4, 128, 130), (5, 192, 33)])
@pytest.mark.parametrize("count", [0, 1, 59, 61, 500])
def test_values_are_those_of_pytorch(depth, width, inputs, count):
    skip = depth // 2
    drawn = weights(depth, width, inputs, skip)
    given = torch.randn(count, inputs, generator=torch.Generator().manual_seed(1))
    expected = by_pytorch({name: value.double() for name, value in drawn.items()}, given.double(), depth, skip)
    found = PackedLayers.of(drawn, depth, skip)(given)
    torch.testing.assert_close(found, expected.float(), rtol=1e-5, atol=1e-5)
    assert not count or (found > 0).any()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_neither_the_batch_nor_threads_change_a_bit(threads):
    layers = PackedLayers.of(weights(4, 128, 130, 2), 4, 2)
    given = torch.randn(1500, 130, generator=torch.Generator().manual_seed(2))
    alone = torch.cat([layers(part) for part in given.split(7)])
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        assert torch.equal(layers(given), alone)
        assert torch.equal(layers(given.T.contiguous().T), alone)  # another layout in memory
    finally:
        torch.set_num_threads(before)


def test_what_is_no_number_stays_none():
    given = torch.zeros(9, 5)
    given[3, 2] = torch.nan
    found = PackedLayers.of(weights(2, 64, 5, 1), 2, 1)(given).isnan()
    assert found[3].all()
    assert not found[[0, 1, 2, 4, 5, 6, 7, 8]].any()


@pytest.mark.parametrize(("width", "dtype"), [(63, torch.float32), (96, torch.float32), (64, torch.float64)])
def test_other_widths_and_precisions_are_left_to_pytorch(width, dtype):
    drawn = {name: value.to(dtype) for name, value in weights(2, width, 5, 1).items()}
    assert PackedLayers.of(drawn, 2, 1) is None


def field_of(config):
    torch.manual_seed(0)
    network = TARGETS["point_multiplane"](config)
    images = torch.rand(3, 3, 9, 11, generator=torch.Generator().manual_seed(0))
    return network.bind(Parameters.of(network), ImagePlanes(images, ring(3, (9, 11))), Sphere())


def test_a_field_has_the_same_values_with_gradients_and_without(monkeypatch):
    """With gradients PyTorch multiplies; the same numbers in another order."""
    used, call = [], PackedLayers.__call__
    monkeypatch.setattr(PackedLayers, "__call__", lambda self, given: used.append(len(given)) or call(self, given))
    field = field_of(TargetConfig(depth=4, width=64, planes=3, point_frequencies=2, direction_frequencies=1))
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    learned = field(points, torch.nn.functional.normalize(points, dim=1))
    assert not used
    learned[0].sum().backward()
    assert all(value.grad is not None for name, value in field.parameters.items() if name.startswith("layers"))
    with torch.no_grad():
        found = field(points, torch.nn.functional.normalize(points, dim=1))
    assert used == [20]
    for one, other in zip(found, learned, strict=True):
        torch.testing.assert_close(one, other)
    moved = points.clone().requires_grad_(True)
    frozen = type(field)(field.target, Parameters(field.parameters).detach(), field.planes, field.bounds)
    frozen.density(moved).sum().backward()
    assert used == [20]
    assert moved.grad.abs().sum() > 0


def test_transforms_go_through_pytorch():
    field = field_of(TargetConfig(depth=2, width=64, planes=3, point_frequencies=1, direction_frequencies=1))
    points = torch.rand(6, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    with torch.no_grad():
        given = field.target.inputs(points, field.planes, field.bounds)
        assert not torch.func.vmap(lambda row: torch.tensor(field._packed.takes(row)))(given).any()
        one_by_one = torch.func.vmap(lambda row: field.trunk(row[None])[0])(given)
        torch.testing.assert_close(one_by_one, field.trunk(given))
