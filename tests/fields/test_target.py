"""Sources of truth: the formula of the MLP, point by point; float64 gradcheck; and properties (a delta of zero changes
nothing, permuted planes with permuted weights of the first layer give the same field).
"""

import math
from dataclasses import replace

import pytest
import torch

from hyperplanes.fields import TARGETS, MultiPlaneNeRF, NeRF, PointMultiPlaneNeRF, TargetConfig
from hyperplanes.fields.base import Target
from hyperplanes.fields.encoding import encode
from hyperplanes.geometry.cameras import select
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.rays import Sphere, cast
from hyperplanes.parameters import Parameters
from tests.reference_rendering import ring

PLANES = 3
SMALL = TargetConfig(depth=4, width=12, planes=PLANES, point_frequencies=2, direction_frequencies=2)


def planes(count=PLANES, seed=0, dtype=torch.float32):
    images = torch.rand(count, 3, 9, 11, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    return ImagePlanes(images, ring(count, (9, 11)))


def queries(count=20, seed=1, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator, dtype=dtype) - 0.5
    directions = torch.randn(count, 3, generator=generator, dtype=dtype)
    return points, directions / directions.norm(dim=1, keepdim=True)


def make(name="point_multiplane", config=SMALL, seed=0):
    torch.manual_seed(seed)
    return TARGETS[name](config)


@pytest.fixture(params=["nerf", "multiplane", "point_multiplane"])
def target(request):
    return make(request.param)


def slow_field(parameters, inputs, direction, config, radius=1.0):
    """Evaluate one point by the formulas: an MLP with a skip connection, and heads with softplus and sigmoid."""

    def layer(name, value):
        return parameters[f"{name}.weight"] @ value + parameters[f"{name}.bias"]

    value = inputs
    for index in range(config.depth):
        if index > 0 and index == config.depth // 2:
            value = torch.cat([inputs, value])
        value = layer(f"layers.{index}", value).clamp_min(0)
    density = torch.log1p(torch.exp(layer("density", value))) * config.density_scale / radius
    seen = torch.cat([layer("feature", value), encode(direction, config.direction_frequencies)])
    return 1 / (1 + torch.exp(-layer("colour", layer("view", seen).clamp_min(0)))), density[0]


@pytest.mark.parametrize("depth", [1, 2, 5])
def test_the_reading_layers_are_those_with_the_point_as_input(depth):
    network = make(config=TargetConfig(depth=depth, width=8, planes=PLANES, point_frequencies=2))
    sizes = {f"layers.{index}": layer.in_features for index, layer in enumerate(network.layers)}
    assert network.reading_layers == tuple(name for name, size in sizes.items() if size >= network.input_size > 8)


@pytest.mark.parametrize("depth", [1, 2, 5])
@torch.no_grad()
def test_a_field_agrees_with_its_formula(depth):
    config = TargetConfig(depth=depth, width=8, planes=PLANES, point_frequencies=2, direction_frequencies=1)
    network = make(config=config).double()
    images, bounds = planes(dtype=torch.float64), Sphere((0.1, 0.0, -0.2), 1.5)
    parameters = Parameters.of(network)
    points, directions = queries(dtype=torch.float64)
    colour, density = network.bind(parameters, images, bounds)(points, directions)
    found = images.lookup(points)
    for index, point in enumerate(points):
        here = encode((point - torch.tensor(bounds.centre, dtype=point.dtype)) / 1.5, 2)
        z = [2 * found.colours[index, view] - 1 for view in range(PLANES)]
        z += [found.coordinates[index, view] for view in range(PLANES)]
        expected = slow_field(parameters, torch.cat([*z, here]), directions[index], config, 1.5)
        torch.testing.assert_close(colour[index], expected[0])
        torch.testing.assert_close(density[index], expected[1])


@torch.no_grad()
def test_colour_and_density_are_in_range(target):
    points, directions = queries(200)
    colour, density = target.bind(Parameters.of(target), planes())(3 * points, directions)
    assert colour.shape == (200, 3)
    assert density.shape == (200,)
    assert ((colour >= 0) & (colour <= 1)).all()
    assert (density >= 0).all()


@torch.no_grad()
def test_density_does_not_depend_on_direction_but_colour_does(target):
    field = target.bind(Parameters.of(target), planes())
    points, directions = queries()
    one, other = field(points, directions), field(points, -directions)
    assert torch.equal(one[1], other[1])
    assert torch.equal(one[1], field.density(points))
    assert (one[0] != other[0]).any(1).all()


@torch.no_grad()
def test_colours_along_many_directions_are_those_along_each(target):
    # Source of truth: the colour head, evaluated for one direction after the other.
    points, directions = queries(7)
    field = target.bind(Parameters.of(target), None if isinstance(target, NeRF) else planes())
    hidden = field.hidden(points)
    expected = torch.stack([field.colour_of(hidden, each.expand(7, 3)) for each in directions], 1)
    torch.testing.assert_close(field.colours_along(hidden, directions), expected)


def test_delta_of_zero_changes_nothing_and_each_head_only_its_own(target):
    theta, images, (points, directions) = Parameters.of(target), planes(), queries()
    colour, density = target.bind(theta, images)(points, directions)
    nothing = Parameters((name, torch.zeros_like(value)) for name, value in theta.items())
    again = target.bind(theta + nothing, images)(points, directions)
    assert torch.equal(again[0], colour)
    assert torch.equal(again[1], density)
    tinted = target.bind(theta + Parameters({"colour.bias": torch.ones(3)}), images)(points, directions)
    assert torch.equal(tinted[1], density)
    assert (tinted[0] > colour).all()
    denser = target.bind(theta + Parameters({"density.bias": torch.ones(1)}), images)(points, directions)
    assert torch.equal(denser[0], colour)
    assert (denser[1] > density).all()


@torch.no_grad()
def test_density_is_per_world_unit():
    # in a scene twice as large, colours at doubled positions are the same, and densities are half
    network, (points, directions) = make("nerf"), queries()
    small = network.bind(Parameters.of(network), None, Sphere((0.1, 0.2, 0.3), 1.0))
    large = network.bind(Parameters.of(network), None, Sphere((0.2, 0.4, 0.6), 2.0))
    torch.testing.assert_close(large(2 * points, directions)[0], small(points, directions)[0])
    torch.testing.assert_close(large.density(2 * points), small.density(points) / 2)


def test_gradients_reach_parameters_points_and_directions():
    config = TargetConfig(depth=2, width=4, planes=2, point_frequencies=1, direction_frequencies=1)
    network = make(config=config).double()
    images = planes(2, dtype=torch.float64)
    points, directions = queries(2, seed=4, dtype=torch.float64)
    names = list(Parameters.of(network))

    def outputs(points, directions, *values):
        return network.bind(Parameters(zip(names, values, strict=True)), images)(points, directions)

    values = [value.detach().clone().requires_grad_() for value in Parameters.of(network).values()]
    inputs = (points.requires_grad_(), directions.requires_grad_(), *values)
    assert torch.autograd.gradcheck(outputs, inputs)


def test_every_parameter_has_a_gradient(target):
    points, directions = queries(100)
    colour, density = target.bind(Parameters.of(target), planes())(points, directions)
    (colour.sum() + density.sum()).backward()
    assert all(value.grad is not None and value.grad.abs().sum() > 0 for value in target.parameters())


def test_another_number_of_planes_is_refused():
    with pytest.raises(ValueError, match="planes: expected 3, got 2"):
        make().bind(Parameters(), planes(2))
    with pytest.raises(ValueError, match="planes: expected ImagePlanes, got None"):
        make().bind(Parameters.of(make()), None)(*queries())


def test_nerf_needs_no_planes():
    network = make("nerf")
    field = network.bind(Parameters.of(network), None)
    assert isinstance(network, NeRF)
    assert all(torch.isfinite(value).all() for value in field(*queries()))


def ray_of_one_camera(images, count=6):
    """Points along one ray through a pixel of the first camera."""
    ray = cast(images.cameras, torch.zeros(1, dtype=torch.long), torch.tensor([[4.3, 3.6]]))
    return ray.at(torch.linspace(2.5, 3.5, count)[None])[0]


@torch.no_grad()
def test_multiplane_reads_only_projections_and_point_multiplane_also_the_point():
    # all points on a ray of the only camera project to one pixel
    config = TargetConfig(depth=3, width=16, planes=1, point_frequencies=2)
    images = planes(1)
    points = ray_of_one_camera(images)
    blind = MultiPlaneNeRF(config)
    density = blind.bind(Parameters.of(blind), images).density(points)
    torch.testing.assert_close(density, density[:1].expand_as(density), atol=1e-4, rtol=1e-4)
    seeing = PointMultiPlaneNeRF(config)
    assert seeing.bind(Parameters.of(seeing), images).density(points).std() > 0.01


@torch.no_grad()
def test_the_field_depends_on_the_images_of_the_planes():
    network, (points, directions) = make(), queries()
    theta = Parameters.of(network)
    one = network.bind(theta, planes(seed=0))(points, directions)[0]
    assert not torch.equal(one, network.bind(theta, planes(seed=1))(points, directions)[0])


@torch.no_grad()
def test_permuted_planes_with_permuted_first_weights_are_the_same_field():
    network, order = make("multiplane"), torch.tensor([2, 0, 1])
    theta, images = Parameters.of(network), planes()
    shuffled = ImagePlanes(images.images[order], select(ring(PLANES, (9, 11)), order))
    # inputs are three colours of each plane, then two coordinates of each plane
    colours = 3 * order[:, None] + torch.arange(3)
    columns = torch.cat([colours.flatten(), 3 * PLANES + (2 * order[:, None] + torch.arange(2)).flatten()])
    moved = Parameters(theta)
    first, skip = theta["layers.0.weight"], theta[f"layers.{network.skip}.weight"]
    moved["layers.0.weight"] = first[:, columns]
    moved[f"layers.{network.skip}.weight"] = torch.cat([skip[:, :15][:, columns], skip[:, 15:]], 1)
    points, directions = queries()
    torch.testing.assert_close(
        network.bind(moved, shuffled)(points, directions), network.bind(theta, images)(points, directions)
    )


@torch.no_grad()
def test_inputs_are_five_numbers_per_plane_in_minus_1_to_1():
    network = make("multiplane")
    far = torch.tensor([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, -50.0, 3.0]])
    z = network.inputs(far, planes(), Sphere())
    assert z.shape == (3, 5 * PLANES)
    assert (z.abs() <= 1).all()


@torch.no_grad()
def test_points_outside_all_planes_have_the_background_colour():
    network, images = make("multiplane"), planes()
    far = 50 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    away = far[~images.lookup(far).valid.any(1)][:1]
    found = images.lookup(away)
    z = network.inputs(away, images, Sphere())
    assert (z[0, : 3 * PLANES] == 1).all()  # white, 2 c - 1 = 1
    torch.testing.assert_close(z[0, 3 * PLANES :], found.coordinates.flatten())


def test_a_masked_plane_has_five_zeros():
    points, _ = queries()
    target, shown = make("multiplane"), planes()
    before = target.inputs(points, shown, Sphere())
    found = target.inputs(points, shown.mask_views(torch.tensor([1])), Sphere())
    gone = torch.tensor([3, 4, 5, 9 + 2, 9 + 3])  # three colours of each plane, then two coordinates of each plane
    assert before[:, gone].abs().amin() > 0
    assert torch.equal(found[:, gone], torch.zeros(len(points), 5))
    before[:, gone] = 0
    assert torch.equal(found, before)


def test_an_incomplete_target_is_refused():
    with pytest.raises(TypeError, match="Target does not define input_size"):
        Target(SMALL)


@torch.no_grad()
def test_impossible_shapes_are_refused():
    with pytest.raises(ValueError, match="width: expected a whole number from 2 to 8192, got 1"):
        replace(SMALL, width=1)
    with pytest.raises(ValueError, match="network.point_frequencies: expected at least 1 for simplified_nerf, got 0"):
        make("simplified_nerf", replace(SMALL, point_frequencies=0))


def test_the_simplified_nerf_agrees_with_its_formula():
    # tancik/learnit: sines and cosines at 2 ** linspace(0, 8, L), layers without a skip connection, ReLU of the density
    config = TargetConfig(depth=3, width=8, point_frequencies=4)
    network, bounds = make("simplified_nerf", config).double(), Sphere((0.1, 0.0, -0.2), 2.0)
    torch.nn.init.ones_(network.density.bias)  # so that ReLU does not make all densities zero
    parameters, (points, directions) = Parameters.of(network), queries(dtype=torch.float64)
    colour, density = network.bind(parameters, None, bounds)(points, directions)
    for index, point in enumerate(points):
        here = [float(value) - centre for value, centre in zip(point, bounds.centre, strict=True)]
        angles = [value * 2 ** (8 * step / 3) for step in range(4) for value in here]
        value = torch.tensor([*map(math.sin, angles), *map(math.cos, angles)], dtype=torch.float64)
        for layer in range(3):
            value = (parameters[f"layers.{layer}.weight"] @ value + parameters[f"layers.{layer}.bias"]).clamp_min(0)
        expected = torch.sigmoid(parameters["colour.weight"] @ value + parameters["colour.bias"])
        torch.testing.assert_close(colour[index], expected)
        thick = (parameters["density.weight"] @ value + parameters["density.bias"])[0].clamp_min(0)
        torch.testing.assert_close(density[index], thick)
    assert (density > 0).any()
    along = network.bind(parameters, None, bounds).colours_along(torch.ones(1, 8).double(), directions)
    assert along.shape == (1, len(directions), 3)
