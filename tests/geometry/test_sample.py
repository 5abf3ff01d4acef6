"""Source of truth: SciPy, PyTorch's grid_sample, stated edge cases, and another backend."""

import inspect
import math

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from torch.autograd import gradcheck, gradgradcheck
from torch.nn.functional import avg_pool2d, grid_sample

from hyperplanes.geometry import cameras, sample
from hyperplanes.geometry.lookup import _INSTALLED, lookup
from hyperplanes.geometry.packed_images import pack
from tests import reference

BACKENDS = ["torch", "cpu"]
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-12}
SIZES = [(9, 13), (41, 50)]  # for 300 points, the plane is copied at the first size only


def scene(points=300, views=4, channels=3, size=(9, 13), dtype=torch.float32, reach=1.0):
    """Images, and coordinates uniform in [-reach, reach]."""
    generator = torch.Generator().manual_seed(5)
    images = torch.rand(views, channels, *size, generator=generator, dtype=dtype)
    coordinates = (2 * torch.rand(points, views, 2, generator=generator, dtype=dtype) - 1) * reach
    return images, coordinates


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("size", SIZES)
def test_colours_are_those_of_map_coordinates(backend, dtype, channels, size):
    """Another implementation, inside and outside; beyond the borders there is a constant, without blending."""
    images, coordinates = scene(channels=channels, size=size, dtype=dtype, reach=1.3)
    found = sample(images, coordinates, background=0.25, backend=backend).numpy()
    last = np.array([size[1] - 1, size[0] - 1])
    pixels = (coordinates.double().numpy() + 1) / 2 * last
    outside = (np.abs(coordinates.numpy()) > 1).any(-1)
    assert 0.1 < outside.mean() < 0.9
    for view in range(len(images)):
        rows_columns = pixels[:, view, ::-1].T
        for channel in range(channels):
            plane = images[view, channel].double().numpy()
            expected = map_coordinates(plane, rows_columns, order=1, mode="nearest")
            expected[outside[:, view]] = 0.25
            np.testing.assert_allclose(found[:, view, channel], expected, atol=TOLERANCE[dtype])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("size", SIZES)
def test_values_and_gradients_inside_are_those_of_grid_sample(backend, size):
    images, coordinates = scene(size=size, dtype=torch.float64)
    pull = torch.randn(300, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    leaves = images.requires_grad_(), coordinates.requires_grad_()
    expected = grid_sample(images, coordinates.transpose(0, 1)[:, :, None], align_corners=True)[..., 0].permute(2, 0, 1)
    found = sample(*leaves, backend=backend)
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)
    for mine, theirs in zip(
        torch.autograd.grad(found, leaves, pull), torch.autograd.grad(expected, leaves, pull), strict=True
    ):
        torch.testing.assert_close(mine, theirs, atol=1e-10, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("channels", [1, 3])
def test_edge_cases_have_the_stated_values(backend, channels):
    """Closed form: a ramp 0..3 over columns. The borders belong to the image; beyond them is the background."""
    ramp = torch.arange(4.0).expand(1, channels, 4, 4)
    beyond = 1 + 1e-5
    cases = [
        ((0.0, 0.0), 1.5),
        ((1.0, 1.0), 3.0),
        ((-1.0, -1.0), 0.0),
        ((-1 / 3, 1.0), 1.0),
        ((beyond, 0.0), 9.0),
        ((-beyond, 0.0), 9.0),
        ((0.0, beyond), 9.0),
        ((0.0, -beyond), 9.0),
        ((1e30, 0.0), 9.0),
        ((math.inf, 0.0), 9.0),
        ((0.0, -math.inf), 9.0),
        ((math.nan, 0.0), 9.0),
        ((0.0, math.nan), 9.0),
    ]
    coordinates = torch.tensor([[case[0]] for case in cases]).requires_grad_()
    found = sample(ramp, coordinates, background=9.0, backend=backend)
    assert found.flatten(1).mean(1).tolist() == pytest.approx([case[1] for case in cases], abs=1e-6)
    (gradient,) = torch.autograd.grad(found.sum(), coordinates)
    expected = [[1.5 * channels if colour == 1.5 else 0.0, 0.0] for _, colour in cases]
    inner = [0, *range(4, len(cases))]  # at pixel centres and borders the derivative is one-sided
    assert gradient[inner, 0].tolist() == [expected[index] for index in inner]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 5), (5, 1)])
def test_images_of_one_row_or_column(backend, height, width):
    """Closed form: along an axis of one pixel, all coordinates refer to that pixel."""
    images = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    _, coordinates = scene(points=200, views=2, dtype=torch.float64)
    leaf = images.clone().requires_grad_()
    found = sample(leaf, coordinates, backend=backend)
    wide = images.repeat_interleave(2, 2 if height == 1 else 3)
    wide = wide.repeat_interleave(2, 3) if height == width else wide
    torch.testing.assert_close(found, sample(wide, coordinates, backend="torch"))
    (gradient,) = torch.autograd.grad(found.sum(), leaf)
    assert gradient.sum().item() == pytest.approx(200 * 2 * 3)  # the weights of each point sum to 1


def test_coordinates_of_any_layout_give_the_same():
    images, coordinates = scene(points=1000, reach=1.1)
    expected = sample(images, coordinates)
    pairs = coordinates.transpose(0, 1).contiguous().transpose(0, 1)
    planar = coordinates.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    sparse = coordinates.repeat_interleave(3, 0)[::3]
    for layout in (pairs, planar, sparse):
        assert torch.equal(sample(images, layout), expected)
        leaf = layout.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(sample(images, leaf).square().sum(), leaf)
        leaf = coordinates.detach().requires_grad_()
        assert torch.equal(gradient, torch.autograd.grad(sample(images, leaf).square().sum(), leaf)[0])
    shared = coordinates[:, :1].expand(-1, 4, -1)
    assert torch.equal(sample(images, shared), sample(images, shared.contiguous()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [2, 3])
@pytest.mark.parametrize("size", SIZES)
def test_the_gradients_of_the_kernels_are_those_of_plain_torch(dtype, channels, size):
    """Another implementation: autograd through the torch backend, on smooth images; also of each input alone."""
    images, coordinates = scene(channels=channels, size=size, dtype=dtype, reach=1.2)
    images = avg_pool2d(images, 5, 1, 2)
    pull = torch.randn(300, 4, channels, generator=torch.Generator().manual_seed(2), dtype=dtype)

    def gradients(backend, wanted):
        leaves = [value.clone().requires_grad_(live) for value, live in zip((images, coordinates), wanted, strict=True)]
        found = sample(*leaves, backend=backend)
        return torch.autograd.grad(found, [leaf for leaf in leaves if leaf.requires_grad], pull)

    for wanted in ((True, True), (True, False), (False, True)):
        for plain, fused in zip(gradients("torch", wanted), gradients("cpu", wanted), strict=True):
            near = (fused - plain).abs() <= (1e-10 if dtype == torch.float64 else 2e-2) * (1 + plain.abs())
            assert near.float().mean() > 0.99  # in float32, a point on a pixel boundary may round to either side


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("size", [(6, 7), (20, 24)])
def test_gradients_are_those_of_finite_differences(backend, size):
    """In float64. Points outside have no gradient."""
    images, coordinates = scene(points=10, views=2, size=size, dtype=torch.float64, reach=1.2)
    leaves = images.requires_grad_(), coordinates.requires_grad_()
    assert gradcheck(lambda i, c: sample(i, c, backend=backend), leaves, fast_mode=size != (6, 7))


def test_second_derivatives_of_the_plain_backend():
    images, coordinates = scene(points=3, views=2, size=(4, 5), dtype=torch.float64)
    leaves = images.requires_grad_(), coordinates.requires_grad_()
    assert gradgradcheck(lambda i, c: sample(i, c, backend="torch"), leaves)


@pytest.mark.parametrize("eight_bits", [True, False])
def test_packed_images_are_sampled_as_the_images_they_hold(eight_bits):
    images, coordinates = scene(reach=1.2)
    images = (images * 255).round() / 255 if eight_bits else images
    packed = pack(images)
    assert packed.bits == (8 if eight_bits else 11)
    results = []
    for kept, source in ((packed, images), (None, reference.unpack(packed))):
        leaf = coordinates.clone().requires_grad_()
        found = sample(source, leaf, packed=kept)
        results.append((found, torch.autograd.grad(found.square().sum(), leaf)[0]))
    torch.testing.assert_close(results[0][0], results[1][0], atol=1e-6, rtol=0)
    torch.testing.assert_close(results[0][1], results[1][1], atol=1e-4, rtol=1e-4)
    # the images themselves are read where packed ones cannot be
    double = sample(images.double(), coordinates.double(), packed=packed)
    torch.testing.assert_close(double, sample(images.double(), coordinates.double()), atol=0, rtol=0)
    live = images.clone().requires_grad_()
    assert torch.autograd.grad(sample(live, coordinates, packed=packed).sum(), live)[0].abs().sum() > 0


def test_the_colours_of_a_lookup_are_samples_at_its_coordinates():
    """Property: a lookup is a projection and then a sampling."""
    images, _ = scene()
    matrix = torch.tensor([[14.0, 0.3, 5.1], [0.0, 11.0, 4.7], [0.0, 0.0, 1.0]])
    ours = cameras.pinhole(matrix, cameras.fibonacci_sphere(4, 2.5), 9, 13)
    points = 1.5 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    found = lookup(points, cameras.projection_matrices(ours), images)
    colours = sample(images, found.coordinates)
    assert 0.1 < found.valid.float().mean() < 0.9
    torch.testing.assert_close(colours[found.valid], found.colours[found.valid], atol=1e-5, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_there_may_be_no_points_no_views_or_no_channels(backend):
    images, coordinates = scene(points=10)
    for ours, where in ((images, coordinates[:0]), (images[:0], coordinates[:, :0]), (images[:, :0], coordinates)):
        leaves = ours.clone().requires_grad_(), where.clone().requires_grad_()
        found = sample(*leaves, backend=backend)
        assert found.shape == (len(where), len(ours), ours.shape[1])
    assert sample(images, coordinates[:1], backend=backend).shape == (1, 4, 3)
    from hyperplanes.geometry.kernels.lookup import operators

    for value in operators.sample_backward(images, coordinates[:0], None, 0, torch.zeros(0, 4, 3), True, True):
        assert not value.any()


def test_the_result_does_not_depend_on_the_number_of_threads():
    images, coordinates = scene(points=20_000)
    before = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            leaves = images.clone().requires_grad_(), coordinates.clone().requires_grad_()
            found = sample(*leaves)
            results.append((found, *torch.autograd.grad(found.square().sum(), leaves)))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        torch.testing.assert_close(other[0], results[0][0], atol=1e-6, rtol=0)
        torch.testing.assert_close(other[1:], results[0][1:], atol=1e-3, rtol=1e-5)


def test_the_operator_passes_opcheck():
    """torch.library.opcheck tests the schema, the fake tensor and the registration of autograd."""
    from hyperplanes.geometry.kernels.lookup import operators

    images, coordinates = scene(points=7)
    tests = ("test_schema", "test_autograd_registration", "test_faketensor")
    leaves = images.requires_grad_(), coordinates.requires_grad_()
    torch.library.opcheck(operators.sample, (*leaves, None, 0, 1.0), test_utils=tests)
    bare = images.detach(), coordinates.detach()
    pull = torch.ones(7, 4, 3)
    for geometry, pixels in ((True, True), (True, False), (False, True)):
        arguments = (*bare, None, 0, pull, geometry, pixels)
        torch.library.opcheck(operators.sample_backward, arguments, test_utils=("test_schema", "test_faketensor"))


def test_compiled_code_gives_the_same():
    """Another implementation: eager mode. One graph with gradients, without untraceable checks of shapes."""
    from hyperplanes.geometry.kernels.lookup import operators

    images, coordinates = scene(points=50)

    def loss(images, coordinates):
        return operators.sample(images, 0.9 * coordinates, None, 0, 1.0).square().sum()

    values = []
    for function in (loss, torch.compile(loss, backend="aot_eager", fullgraph=True)):
        leaves = [value.clone().requires_grad_() for value in (images, coordinates)]
        values.append(torch.autograd.grad(function(*leaves), leaves))
    torch.testing.assert_close(values[0], values[1])


def test_wrong_arguments_are_named(monkeypatch):
    images, coordinates = scene(points=4)
    with pytest.raises(ValueError, match=r"coordinates: expected shape \(point, 4, 2\).* got \(4, 3, 2\)"):
        inspect.unwrap(sample)(images, coordinates[:, :3])  # without the tests' check of shapes
    with pytest.raises(ValueError, match="backend: expected torch or cpu for float32 on cpu, got 'triton'"):
        sample(images, coordinates, backend="triton")
    monkeypatch.setitem(_INSTALLED, "numba", False)
    with pytest.raises(ValueError, match="backend: expected torch for float32 on cpu, got 'cpu'"):
        sample(images, coordinates, backend="cpu")
    assert sample(images, coordinates).shape == (4, 4, 3)
