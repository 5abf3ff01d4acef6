"""Sources of truth: invariances (order of views, views that see nothing), plain PyTorch, and the hull of a ball."""

from dataclasses import asdict, replace

import pytest
import torch

from hyperplanes.fields import ImageBasedConfig, ImageBasedNeRF
from hyperplanes.geometry import carve
from hyperplanes.geometry.cameras import camera_from_world
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.parameters import Parameters
from hyperplanes.rendering import RayMarching, render
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Views, join_views
from tests.reference_rendering import ball_views, camera_at, ring

SMALL = ImageBasedConfig(depth=3, width=16, planes=4, blended=2, point_frequencies=2, direction_frequencies=1)
SIZE = (24, 24)


def network(seed=0, config=SMALL):
    torch.manual_seed(seed)
    return ImageBasedNeRF(config)


def coloured(count, distance=3.0):
    """Views of a ball with noise in every image, so that no two views show the same colour."""
    views = ball_views(ring(count, SIZE, distance=distance))
    noise = torch.rand(views.images.shape, generator=torch.Generator().manual_seed(3))
    return Views(torch.where(views.masks > 0, 0.5 * views.images + 0.5 * noise, 1.0), views.cameras, views.masks)


def bound(target, views, parameters=None, occupancy=None):
    occupancy = occupancy or carve(views.masks, views.cameras, views.bounds, 32)
    return target.bind(parameters or Parameters.of(target), target.planes_of(views, occupancy))


def queries(count=200, seed=1):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator) - 0.5
    return points, torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


@torch.no_grad()
def test_the_order_of_the_views_does_not_matter():
    target, views, (points, directions) = network(), coloured(7), queries()
    expected = bound(target, views)(points, directions)
    for seed in range(3):
        order = torch.randperm(7, generator=torch.Generator().manual_seed(seed))
        for one, other in zip(bound(target, views[order])(points, directions), expected, strict=True):
            torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


@torch.no_grad()
@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_any_number_of_views_makes_a_field(count):
    colour, density = bound(network(), coloured(count))(*queries())
    assert ((colour >= 0) & (colour <= 1)).all()
    assert (density >= 0).all()
    assert density.isfinite().all()


@torch.no_grad()
def test_a_view_that_sees_nothing_changes_nothing():
    target, views, (points, directions) = network(), coloured(3), queries()
    away = camera_at((0.0, 0.0, 3.0), SIZE, target=(0.0, 0.0, 9.0))
    blind = Views(torch.rand(1, 3, *SIZE), away, torch.zeros(1, 1, *SIZE))
    occupancy = carve(views.masks, views.cameras, views.bounds, 32)
    expected = bound(target, views, occupancy=occupancy)(points, directions)
    found = bound(target, join_views(views, blind), occupancy=occupancy)(points, directions)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_masking_a_view_is_the_same_as_omitting_it():
    target, views, (points, directions) = network(), coloured(5), queries()
    occupancy = carve(views.masks, views.cameras, views.bounds, 32)
    hidden = target.planes_of(views, occupancy).mask_views(torch.tensor([1, 4]))
    expected = bound(target, views[[0, 2, 3]], occupancy=occupancy)(points, directions)
    found = target.bind(Parameters.of(target), hidden)(points, directions)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_masked_views_are_not_read_even_if_few_others_are_left():
    target, views, (points, directions) = network(), coloured(3), queries()
    occupancy, hidden = carve(views.masks, views.cameras, views.bounds, 32), torch.tensor([1])
    images = views.images.clone()
    images[1] = torch.rand(images[1].shape)

    def seen(views):
        planes = target.planes_of(views, occupancy).mask_views(hidden).mask_views(torch.tensor([2]))
        return target.bind(Parameters.of(target), planes)(points, directions)

    for one, other in zip(seen(views), seen(replace(views, images=images)), strict=True):
        assert torch.equal(one, other)


@torch.no_grad()
def test_a_rotation_of_the_world_changes_only_inputs_in_world_coordinates():
    """The weights of points and viewing directions are zero; all other inputs do not depend on the world frame."""
    config = ImageBasedConfig(depth=2, width=16, planes=4, blended=2, point_frequencies=0, direction_frequencies=0)
    target, views, (points, directions) = network(config=config), coloured(5), queries()
    parameters = Parameters({name: value.clone() for name, value in Parameters.of(target).items()})
    for index in range(2):
        first = parameters[f"layers.{index}.weight"]
        first[:, :3] = 0  # the point
        for slot in range(4):
            first[:, 3 + 9 * slot + 6 : 3 + 9 * slot + 9] = 0  # directions of the views
    parameters["view.weight"][:, 16:19] = 0  # the viewing direction
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0))).Q
    turn = turn * torch.sign(torch.linalg.det(turn))
    occupancy = carve(views.masks, views.cameras, views.bounds, 32)
    pose = camera_from_world(views.cameras).clone()
    pose[:, :3, :3] = pose[:, :3, :3] @ turn.T
    cameras = type(views.cameras)(views.cameras.intrinsics, pose, views.cameras.height, views.cameras.width)
    shown = target.planes_of(views, occupancy)
    moved = VisibilityPlanes(views.images, cameras, views.masks, occupancy)
    moved._maps = shown._maps  # the hull is rotated with the world, so that depths are the same
    expected = target.bind(parameters, shown)(points, directions)
    found = target.bind(parameters, moved)(points @ turn.T, directions @ turn.T)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-3)


@torch.no_grad()
def test_the_initial_field_is_the_visual_hull_with_the_colours_of_the_views():
    views, query = ball_views(ring(12, (48, 48))), ball_views(ring(3, (48, 48), shift=1))
    occupancy = carve(views.masks, views.cameras, views.bounds, 64)
    target = network(config=ImageBasedConfig(depth=3, width=32, planes=4))
    field = bound(target, views, occupancy=occupancy)
    pictures = render(field, query.cameras, RayMarching(128), occupancy=occupancy)
    assert psnr(pictures.images, query.images).min() > 25  # measured: 26.2 and more
    assert (pictures.opacity - query.masks).abs().mean() < 0.02
    inside, outside = field.density(torch.tensor([[0.0, 0.0, 0.0], [0.62, 0.0, 0.0]]))
    assert outside < 0.1 * inside


def test_density_does_not_depend_on_the_direction_and_colour_does():
    field, (points, directions) = bound(network(), coloured(5)), queries()
    one, other = field(points, directions), field(points, -directions)
    assert torch.equal(one[1], other[1])
    torch.testing.assert_close(one[1], field.density(points))
    assert not torch.allclose(one[0], other[0], atol=1e-3)


@torch.no_grad()
@pytest.mark.parametrize("count", [1, 3, 9])
@pytest.mark.parametrize("grid", [0, 3])
def test_the_kernel_computes_the_same_inputs_as_pytorch(count, grid, monkeypatch):
    """Another implementation, also for points outside the images, masked views, and images that cut the ball."""
    config = ImageBasedConfig(**{**asdict(SMALL), "grid": grid})
    target, views, (points, directions) = network(config=config), coloured(count), queries()
    parameters = Parameters({name: value.clone() for name, value in Parameters.of(target).items()})
    if grid:
        parameters["grid.weight"].normal_(generator=torch.Generator().manual_seed(2))
    field, points = bound(target, views, parameters), 2.5 * points
    hiding = replace(field, planes=field.planes.mask_views(torch.tensor([0])))
    occupancy = field.planes.occupancy
    smaller = Occupancy(occupancy.occupied & ~occupancy.surface().occupied, occupancy.bounds)
    judged = replace(field, planes=field.planes.with_surface(smaller))
    close = bound(target, coloured(count, distance=1.2), parameters)
    close = replace(close, planes=close.planes.with_penalty_offsets(torch.linspace(0, 0.1, count)))

    def outputs():
        for each in (field, hiding, judged, close):
            hidden = each.hidden(points)
            yield each(points, directions)
            yield each.colour_of(hidden[::3], directions[::3]), each.density_of(hidden)

    compiled = list(outputs())
    monkeypatch.setattr(VisibilityPlanes, "can_describe", lambda planes, *_: False)
    for found, expected in zip(compiled, outputs(), strict=True):
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_gradients_are_those_of_plain_pytorch(monkeypatch):
    config = ImageBasedConfig(**{**asdict(SMALL), "grid": 3})
    target, (points, directions) = network(config=config), queries()
    field, gradients = bound(target, coloured(5)), []
    for _ in range(2):
        colour, density = field(points, directions)
        loss = (colour - 0.3).square().sum() + density.log1p().sum()
        gradients.append(torch.autograd.grad(loss, list(target.parameters())))
        monkeypatch.setattr(VisibilityPlanes, "can_describe", lambda planes, *_: False)
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-3)


def test_every_parameter_has_a_gradient():
    target = network()
    colour, density = bound(target, coloured(5))(*queries())
    ((colour - 0.3).square().sum() + density.log1p().sum()).backward()
    for name, value in target.named_parameters():
        assert value.grad is not None, name
        assert value.grad.abs().sum() > 0, name


def test_no_views_are_refused():
    with pytest.raises(ValueError, match="at least one view"):
        network().bind(Parameters(), None)


@torch.no_grad()
def test_in_place_changes_of_the_grid_change_the_field():
    target = ImageBasedNeRF(ImageBasedConfig(depth=2, width=64, planes=2, grid=4, cells=4))
    views, parameters = coloured(3), Parameters.of(target)
    field, (points, _) = bound(target, views, parameters), queries()
    before = field.density(points)
    parameters["grid.weight"].add_(torch.randn(parameters["grid.weight"].shape, generator=torch.Generator()))
    after = field.density(points)
    assert not torch.allclose(before, after)
    torch.testing.assert_close(after, bound(target, views, parameters).density(points))


def derivatives_of(value, leaf):
    return torch.autograd.grad(value.square().sum(), leaf)[0]


def test_gradients_of_directions_without_gradients_of_points(monkeypatch):
    field, (points, directions), found = bound(network(), coloured(5)), queries(), []
    for _ in range(2):
        leaf = directions.clone().requires_grad_()
        colour, _ = field(points, leaf)
        found.append([derivatives_of(colour, leaf), derivatives_of(field.colour_of(field.hidden(points), leaf), leaf)])
        monkeypatch.setattr(VisibilityPlanes, "can_describe", lambda planes, *_: False)
    assert found[0][0].abs().sum() > 0.1
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-3)


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")  # in torch.func.jvp
def test_function_transforms_agree_with_autograd():
    target, views, (points, directions) = (
        network(config=ImageBasedConfig(**{**asdict(SMALL), "grid": 3})),
        coloured(4),
        queries(60),
    )
    parameters = Parameters.of(target).detach()
    occupancy = carve(views.masks, views.cameras, views.bounds, 16)

    def loss(name):
        def of(value):
            given = {**parameters, name: value} if name else parameters
            field = bound(target, views, Parameters(given), occupancy)  # computes its own depths
            return field(points, directions if name else value)[0].square().sum()

        return of

    for name in ("layers.0.weight", "grid.weight", ""):
        start = parameters[name] if name else directions
        leaf, tangent = (
            start.clone().requires_grad_(),
            torch.randn(start.shape, generator=torch.Generator().manual_seed(0)),
        )
        expected = torch.autograd.grad(loss(name)(leaf), leaf)[0]
        torch.testing.assert_close(torch.func.grad(loss(name))(start), expected, atol=1e-3, rtol=1e-3)
        if name == "grid.weight":  # PyTorch has no forward derivative of grid_sample
            with pytest.raises(NotImplementedError):
                torch.func.jvp(loss(name), (start,), (tangent,))
            continue
        along = torch.func.jvp(loss(name), (start,), (tangent,))[1]
        torch.testing.assert_close(along, (expected * tangent).sum(), atol=1e-3, rtol=1e-3)


@torch.no_grad()
def test_the_kernel_encodes_many_octaves_as_pytorch_does(monkeypatch):
    config = ImageBasedConfig(**{**asdict(SMALL), "point_frequencies": 20, "direction_frequencies": 18})
    field, (points, directions) = bound(network(config=config), coloured(4)), queries()
    compiled = field(points, directions)
    monkeypatch.setattr(VisibilityPlanes, "can_describe", lambda planes, *_: False)
    for one, other in zip(compiled, field(points, directions), strict=True):
        torch.testing.assert_close(one, other, atol=2e-3, rtol=1e-3)
