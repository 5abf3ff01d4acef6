"""Source of truth: plain PyTorch on the same input, or an error message of one sentence; never memory out of bounds."""

import math

import jaxtyping
import numpy as np
import pytest
import torch
from torch.autograd import forward_ad, gradgradcheck

from hyperplanes.geometry import ImagePlanes, Sphere, cameras, carve, cast, sample
from hyperplanes.geometry.kernels.lookup import operators
from hyperplanes.geometry.lookup import lookup
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.packed_images import pack
from hyperplanes.geometry.rays import pixel_grid


def rig(views=3, height=6, width=7, distance=2.5):
    matrix = torch.tensor([[6.0, 0.0, 3.1], [0.0, 5.0, 2.4], [0.0, 0.0, 1.0]])
    return cameras.pinhole(matrix, cameras.fibonacci_sphere(views, distance), height, width)


def scene(dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(5, 3, generator=generator, dtype=dtype) * 0.8 - 0.4
    images = torch.rand(3, 3, 6, 7, generator=generator, dtype=dtype)
    return points, cameras.projection_matrices(rig()).to(dtype), images


def pictures(images):
    """Images as 8-bit pixels with channels last, as image decoders return them."""
    return (images * 255).byte().permute(0, 2, 3, 1)


WRONG = [
    (lambda p, m, i: ImagePlanes(i.permute(0, 2, 3, 1), rig()), r"channels before rows.*images\.permute\(0, 3, 1, 2\)"),
    (lambda p, m, i: lookup(p, m, i, torch.zeros(3, 2, dtype=torch.long)), r"views: expected shape \(5, chosen\)"),
    (lambda p, m, i: lookup(p, m, i, torch.zeros(5, dtype=torch.long)), r"views: expected shape \(5, chosen\)"),
    (lambda p, m, i: lookup(p, m, i, torch.zeros(5, 2)), "views: expected whole numbers, got torch.float32"),
    (lambda p, m, i: lookup(p, m, i, np.full((5, 1), 3)), "views: expected indices of 3 planes, got 3 to 3"),
    (lambda p, m, i: lookup(p, m, i, np.full((5, 1), -1)), "views: expected indices of 3 planes, got -1 to -1"),
    (lambda p, m, i: lookup(p, m[:1], i), r"matrices: expected shape \(3, 3, 4\).* got \(1, 3, 4\)"),
    (lambda p, m, i: lookup(p[0], m, i), r"got \(3,\); write points\[None\] for a single point"),
    (lambda p, m, i: lookup(p[:, :2], m, i), r"points: expected shape \(point, 3\), got \(5, 2\)"),
    (lambda p, m, i: lookup(p + 1j, m, i), "points: expected real numbers"),
    (lambda p, m, i: lookup(p, m, pictures(i)), r"channels before rows.*images\.permute\(0, 3, 1, 2\)"),
    (lambda p, m, i: lookup(p, m, pictures(i).numpy()), r"images\.transpose\(0, 3, 1, 2\)"),
    (
        lambda p, m, i: ImagePlanes(i[..., :1].permute(0, 2, 3, 1), rig(width=1)),
        r"channels before rows.*\(3, 6, 1, 3\)",
    ),
    (lambda p, m, i: lookup(p, m, i[0]), "images: expected shape"),
    (lambda p, m, i: lookup(p, m, i[..., :0]), "images: expected at least one pixel"),
    (lambda p, m, i: lookup(p, m, i.long()), "images: expected floating-point numbers or 8-bit ones, got torch.int64"),
    (lambda p, m, i: lookup(p, m, i, packed=pack(i[:1])), "packed: expected int32"),
    (lambda p, m, i: sample(i, p[:, None, :2]), r"coordinates: expected shape \(point, 3, 2\)"),
    (lambda p, m, i: carve(i[:2, :1], rig(), Sphere()), r"masks: expected shape \(3, 1, 6, 7\).* got \(2, 1, 6, 7\)"),
    (lambda p, m, i: carve(i[:, :1, :5], rig(), Sphere()), r"masks: expected shape \(3, 1, 6, 7\)"),
    (lambda p, m, i: carve(i, rig(), Sphere()), r"masks: expected shape \(3, 1, 6, 7\)"),
    (lambda p, m, i: carve(i[:, :1], rig(), Sphere(), 0), "side: expected 1 to 1024 voxels, got 0"),
    (lambda p, m, i: carve(i[:, :1], rig(), Sphere(), 10**6), "side: expected 1 to 1024 voxels"),
    (
        lambda p, m, i: carve(i[:, :1], rig(), Sphere(), 8, within=full(Sphere(), 9)),
        "within: expected 8 voxels an axis in .*radius=1.0.* on cpu, got 9 in ",
    ),
    (lambda p, m, i: carve(i[:, :1], rig(), Sphere(), 8, within=full(Sphere(radius=2.0), 8)), "within: .*radius=2.0"),
    (lambda p, m, i: cast(rig(), torch.zeros(2, dtype=torch.long), torch.zeros(3, 2)), "view, pixels: expected"),
    (lambda p, m, i: cast(rig(), torch.tensor([3]), p[:1, :2]), "view: expected indices of 3 cameras, got 3 to 3"),
    (lambda p, m, i: Sphere(radius=-1.0), r"radius: expected a finite number above 0, got -1\.0"),
    (lambda p, m, i: Sphere(radius=0.0), r"radius: expected a finite number above 0, got 0\.0"),
    (lambda p, m, i: Sphere((0.0, math.nan, 0.0)), "centre: expected finite numbers, got"),
    (lambda p, m, i: cameras.look_at(p, up=(0.0, 0.0, 0.0)), "up: expected a direction"),
    (lambda p, m, i: cameras.look_at(p * math.nan), "eyes: expected finite positions"),
    (lambda p, m, i: cameras.look_at(p, target=tuple(p[2].tolist())), "eyes: expected every eye away from the target"),
    (lambda p, m, i: cameras.fibonacci_sphere(4, 1.0, -2.0, 2.0), "lowest, highest: expected -1 <= lowest <="),
]


@pytest.mark.parametrize(("action", "message"), WRONG)
def test_inputs_that_cannot_be_computed_are_refused(action, message):
    with pytest.raises(ValueError, match=message) as caught:
        action(*scene())
    assert "\n" not in str(caught.value)


OPERATORS = [
    (operators.lookup, lambda p, m, i: (p, m[:1], i, None, 0, None, 1e-4, 1.0), "matrices: expected"),
    (operators.lookup, lambda p, m, i: (p, m, i, None, 0, torch.zeros(3, 2, dtype=torch.long), 1e-4, 1.0), "views: ex"),
    (operators.lookup, lambda p, m, i: (p, m, i, None, 0, torch.full((5, 2), 9), 1e-4, 1.0), "views: expected indices"),
    (operators.lookup, lambda p, m, i: (p[:, :2], m, i, None, 0, None, 1e-4, 1.0), "points: expected"),
    (operators.lookup, lambda p, m, i: (p, m, i, torch.zeros(1, dtype=torch.int32), 8, None, 1e-4, 1.0), "packed: "),
    (operators.lookup, lambda p, m, i: (p, m, i.double(), None, 0, None, 1e-4, 1.0), "images: expected float32"),
    (operators.sample, lambda p, m, i: (i, p[:, None, :2], None, 0, 1.0), "coordinates: expected shape"),
    (
        operators.lookup_backward,
        lambda p, m, i: (p, m, i, None, 0, None, 1e-4, torch.zeros(1, 1, 1), None, True, True),
        "grad_colours: expected",
    ),
    (
        operators.sample_backward,
        lambda p, m, i: (i, torch.zeros(5, 3, 2), None, 0, torch.zeros(1, 1, 1), True, True),
        "grad_colours: expected",
    ),
]


@pytest.mark.parametrize(("operator", "arguments", "message"), OPERATORS)
def test_the_operators_check_their_arguments_before_they_read(operator, arguments, message):
    """Without these checks each call reads out of bounds; most of them end in a segmentation fault."""
    with pytest.raises(ValueError, match=message):
        operator(*arguments(*scene()))


def test_numpy_whole_numbers_and_8_bits_are_converted():
    """Source of truth: the equal float32 tensors."""
    _, matrices, images = scene()
    points, eight = torch.tensor([[0, 0, 0], [1, 0, -1]]), (images * 255).round().to(torch.uint8)
    expected = lookup(points.float(), matrices, eight.float() / 255)
    for given in (
        (points, matrices, eight),
        (points.numpy(), matrices.numpy(), eight.numpy()),
        (points.numpy().astype(">i4"), matrices.numpy()[:, ::-1][:, ::-1], np.asfortranarray(eight.numpy())),
    ):
        found = lookup(*given)
        torch.testing.assert_close(found.colours, expected.colours)
        assert torch.equal(found.valid, expected.valid)
    planes = ImagePlanes(eight.numpy(), rig()).lookup(points.numpy(), np.zeros((2, 1), np.int32))
    torch.testing.assert_close(planes.colours[:, 0], expected.colours[:, 0], atol=1e-6, rtol=0)
    masks = np.ones((3, 1, 6, 7), np.uint8)
    assert torch.equal(
        carve(masks, rig(), Sphere(), 8).occupied, carve(torch.ones(3, 1, 6, 7), rig(), Sphere(), 8).occupied
    )
    rays = cast(rig(), np.array([0, 1]), np.array([[0, 0], [3, 2]]))
    torch.testing.assert_close(
        rays.directions, cast(rig(), torch.tensor([0, 1]), torch.tensor([[0.0, 0], [3, 2]])).directions
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_on_the_rays_of_border_pixels_are_valid(dtype):
    """Round trip: points on the rays through pixel centres are projected to these pixels and have their colours."""
    generator = torch.Generator().manual_seed(1)
    matrix = cameras.symmetric_intrinsics(48, 64, 0.8)
    ours = cameras.to(cameras.pinhole(matrix, cameras.fibonacci_sphere(20, 3.0), 48, 64), dtype=dtype)
    images = torch.rand(20, 3, 48, 64, generator=generator, dtype=dtype)
    pixels = pixel_grid(48, 64).to(dtype)
    border = ((pixels == 0) | (pixels == pixels.new_tensor([63, 47]))).any(1)
    pixels = pixels[border].repeat(20, 1)
    view = torch.arange(20).repeat_interleave(int(border.sum()))
    rays = cast(ours, view, pixels)
    points = rays.at(1 + 4 * torch.rand(len(rays), generator=generator, dtype=dtype))
    for backend in ("torch", "cpu"):
        found = ImagePlanes(images, ours, exact=True, backend=backend).lookup(points, view[:, None])
        assert found.valid.all(), backend
        column, row = pixels.long().unbind(1)
        torch.testing.assert_close(found.colours[:, 0], images[view, :, row, column], atol=2e-3, rtol=0)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_the_scale_of_the_scene_changes_no_lookup(size):
    """Property: if all lengths are multiplied by one number, coordinates and validity do not change."""
    points, _, images = scene()
    behind = 4 * torch.nn.functional.normalize(points, dim=1)
    points = torch.cat([points, behind])
    expected = ImagePlanes(images, rig()).lookup(points)
    found = ImagePlanes(images, rig(distance=2.5 * size)).lookup(size * points)
    assert 0.2 < float(expected.valid.float().mean()) < 0.9
    assert torch.equal(found.valid, expected.valid)
    torch.testing.assert_close(found.coordinates, expected.coordinates, atol=1e-4, rtol=0)
    full, small = (carve(torch.zeros(3, 1, 6, 7), rig(distance=2.5 * s), Sphere(radius=s / 2), 16) for s in (1.0, size))
    assert torch.equal(full.occupied, small.occupied)
    assert not full.occupied.all()


@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (1.0, 1.0, 1.0), (2.0, 2.0, -1.0), (0.0, 0.0, 1e-9)])
def test_a_camera_that_looks_along_up_has_a_rotation(up):
    """Closed form: the third row points at the target, and the rows are orthonormal for any direction of up."""
    axis = torch.nn.functional.normalize(torch.tensor(up), dim=0, eps=1e-30)
    pose = cameras.look_at(torch.stack([3 * axis, -3 * axis, torch.tensor([1.0, 2.0, 0.5])]), up=up)
    rotation = pose[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(3, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(rotation[0, 2], -axis, atol=1e-5, rtol=0)
    assert (torch.linalg.det(rotation) > 0).all()
    assert (rotation[2, 1] @ axis) < 0  # rows go down


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # raised by torch.func
def test_forward_mode_and_function_transforms_are_those_of_plain_torch():
    """Finite differences, and another implementation: the plain backend, which autograd differentiates."""
    points, matrices, images = scene(torch.float64)
    direction = torch.randn(points.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def loss(p, i=images):
        found = lookup(p, matrices, i)
        return found.colours.square().sum() + sample(i, found.coordinates).sum()

    step = 1e-6 * direction
    slope = (loss(points + step) - loss(points - step)) / 2e-6
    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(loss(forward_ad.make_dual(points, direction))).tangent
        with pytest.raises(ValueError, match="backend: cpu has no forward-mode derivatives; use backend='torch'"):
            lookup(forward_ad.make_dual(points, direction), matrices, images, backend="cpu")
    torch.testing.assert_close(tangent, slope, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(torch.func.jvp(loss, (points,), (direction,))[1], tangent)
    torch.testing.assert_close((torch.func.grad(loss)(points) * direction).sum(), tangent)
    each = torch.func.vmap(lambda p: loss(p[None]))(points)
    torch.testing.assert_close(each, torch.stack([loss(p[None]) for p in points]))
    with pytest.raises(ValueError, match="backend: cpu has no torch.func transforms"):
        torch.func.grad(lambda p: lookup(p, matrices, images, backend="cpu").colours.sum())(points)


def test_second_derivatives_of_the_default_backend():
    """Finite differences of the first ones."""
    points, matrices, images = scene(torch.float64)
    views = torch.tensor([[0, 2]] * 5)
    leaves = [value.clone().requires_grad_() for value in (points, matrices, images)]
    assert gradgradcheck(lambda p, m, i: lookup(p, m, i).colours, leaves, fast_mode=True)
    assert gradgradcheck(lambda p, i: lookup(p, matrices, i, views).colours, leaves[::2], fast_mode=True)
    places = lookup(points, matrices, images).coordinates.requires_grad_()
    assert gradgradcheck(lambda i, c: sample(i, c), (leaves[2], places), fast_mode=True)


def test_compiled_in_one_graph(monkeypatch):
    """Another implementation: eager mode. Checks of annotations are off, since they cannot be traced."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    _, _, images = scene()
    planes = ImagePlanes(images, rig(), exact=True)
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 0.5

    def loss(points):
        found = planes.lookup(2 * points, return_directions=True)
        return (found.colours.square().sum() + found.coordinates.sin().sum()) * found.distances.mean()

    found = []
    for function in (loss, torch.compile(loss, backend="aot_eager", fullgraph=True)):
        leaf = points.clone().requires_grad_()
        value = function(leaf)
        found.append((value, *torch.autograd.grad(value, leaf)))
    torch.testing.assert_close(*found)


@pytest.mark.parametrize("width", [1, 3, 4])
def test_images_of_several_channels_may_be_three_pixels_wide(width):
    """The same columns in a wider image give the same colours. Without cameras, the order defines the dimensions."""
    points, matrices, _ = scene()
    images = torch.rand(3, 8, 60, width, generator=torch.Generator().manual_seed(0))
    narrow = cameras.cropped(rig(height=60), 60, width)
    found = ImagePlanes(images, narrow).lookup(points)
    wide = ImagePlanes(torch.nn.functional.pad(images, (0, 7 - width)), rig(height=60)).lookup(points)
    torch.testing.assert_close(found.colours[found.valid], wide.colours[found.valid])
    torch.testing.assert_close(lookup(points, matrices, images).colours, found.colours)
    assert sample(images, torch.zeros(5, 3, 2)).shape == (5, 3, 8)


def test_pixels_of_another_precision_are_converted_to_that_of_the_cameras():
    view, pixels = torch.zeros(4, dtype=torch.long), pixel_grid(2, 2)
    assert torch.equal(cast(rig(), view, pixels.double()).directions, cast(rig(), view, pixels).directions)


def test_poses_of_half_precision_are_checked():
    poses = cameras.fibonacci_sphere(3, 2.5)
    assert torch.equal(cameras.with_poses(rig(), poses.half()).extrinsics, poses.half())
    with pytest.raises(ValueError, match="camera_from_world: expected a rotation"):
        cameras.with_poses(rig(), (2 * poses).half())


@pytest.mark.parametrize(
    "call",
    [
        lambda batch: cameras.cropped(batch, "60", 4),
        lambda batch: cameras.resized(batch, 4.5, 4),
        lambda batch: cameras.moved(batch, [[1.0]]),
    ],
)
def test_functions_of_cameras_name_the_wrong_argument(call):
    with pytest.raises(ValueError, match=r"^(height|motion): expected"):
        call(rig())
