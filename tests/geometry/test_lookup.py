"""Source of truth: tests/reference.py (one lookup at a time), stated edge cases, and another backend."""

import math

import numpy as np
import pytest
import torch

from hyperplanes.geometry import ImagePlanes, cameras
from hyperplanes.geometry.distortion import distorted
from hyperplanes.geometry.lookup import _INSTALLED, backends, choose, lookup
from hyperplanes.geometry.packed_images import pack
from tests import reference

BACKENDS = ["torch", "cpu"]
TOLERANCE = {torch.float32: 2e-4, torch.float64: 1e-10}


def ring(views=5, height=9, width=13, dtype=torch.float32):
    """Cameras around the origin with fx != fy, principal points that are not central, and skew."""
    matrix = torch.tensor([[14.0, 0.3, 5.1], [0.0, 11.0, 4.7], [0.0, 0.0, 1.0]], dtype=dtype)
    return cameras.pinhole(matrix, cameras.fibonacci_sphere(views, 2.5).to(dtype), height, width)


def scene(points=300, views=5, channels=3, dtype=torch.float32):
    generator = torch.Generator().manual_seed(3)
    images = torch.rand(views, channels, 9, 13, generator=generator, dtype=dtype)
    where = 1.5 * torch.randn(points, 3, generator=generator, dtype=dtype)  # also outside and behind
    return where, ring(views, dtype=dtype), images


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_all_planes_match_the_loop(backend, dtype, channels):
    points, ours, images = scene(channels=channels, dtype=dtype)
    found = ImagePlanes(images, ours, 0.25, backend=backend, exact=True).lookup(points)
    matrices = cameras.projection_matrices(ours)
    colours, coordinates, valid = reference.lookup(points.numpy(), matrices.numpy(), images.numpy(), background=0.25)
    assert 0.1 < valid.mean() < 0.9
    np.testing.assert_array_equal(found.valid.numpy(), valid)
    np.testing.assert_allclose(found.coordinates.numpy(), coordinates, atol=TOLERANCE[dtype])
    np.testing.assert_allclose(found.colours.numpy(), colours, atol=TOLERANCE[dtype])


@pytest.mark.parametrize("backend", BACKENDS)
def test_chosen_planes_match_the_loop(backend):
    points, ours, images = scene(points=700)
    views = torch.randint(0, 5, (700, 3), generator=torch.Generator().manual_seed(0))
    found = ImagePlanes(images, ours, backend=backend, exact=True).lookup(points, views)
    matrices = cameras.projection_matrices(ours).numpy()
    colours, coordinates, valid = reference.lookup(points.numpy(), matrices, images.numpy(), views.numpy())
    np.testing.assert_array_equal(found.valid.numpy(), valid)
    np.testing.assert_allclose(found.coordinates.numpy(), coordinates, atol=1e-5)
    np.testing.assert_allclose(found.colours.numpy(), colours, atol=2e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_several_objects_in_one_batch_are_independent(backend):
    """Property: the lookup of two objects, each with its planes, is equal to the lookups of each alone."""
    points, ours, images = scene(points=64, views=6)
    views = torch.cat([torch.arange(3).expand(32, 3), torch.arange(3, 6).expand(32, 3)])
    together = ImagePlanes(images, ours, backend=backend).lookup(points, views)
    for part, planes in ((slice(0, 32), slice(0, 3)), (slice(32, 64), slice(3, 6))):
        alone = ImagePlanes(images[planes], cameras.select(ours, planes), backend=backend).lookup(points[part])
        torch.testing.assert_close(together.colours[part], alone.colours)
        torch.testing.assert_close(together.coordinates[part], alone.coordinates)


def frontal(height=4, width=4, focal=2.0):
    """A camera at the origin that looks along z, with its principal point at the centre."""
    middle = ((width - 1) / 2, (height - 1) / 2)
    matrix = torch.tensor([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    return cameras.pinhole(matrix, torch.eye(4)[None], height, width)


@pytest.mark.parametrize("backend", BACKENDS)
def test_edge_cases_have_the_stated_values(backend):
    """Closed form: f = 2, c = 1.5, a ramp 0..3 over columns. Coordinates are 0 behind the camera, clamped outside."""
    ramp = torch.arange(4.0).expand(1, 1, 4, 4).contiguous()
    planes = ImagePlanes(ramp, frontal(), background=9.0, backend=backend)
    cases = [
        ((0.0, 0.0, 1.0), 1.5, (0.0, 0.0), True),  # the centre
        ((0.75, 0.75, 1.0), 3.0, (1.0, 1.0), True),  # at the centre of the last pixel
        ((-0.75, -0.75, 1.0), 0.0, (-1.0, -1.0), True),  # at the centre of the first pixel
        ((0.754, 0.0, 1.0), 3.0, (1.0, 0.0), True),  # 0.008 pixels beyond it: within the tolerance for rounding
        ((0.756, 0.0, 1.0), 9.0, (1.0, 0.0), False),  # 0.012 pixels beyond it: just outside
        ((1e6, -1e6, 1.0), 9.0, (1.0, -1.0), False),  # far outside
        ((0.0, 0.0, -1.0), 9.0, (0.0, 0.0), False),  # behind
        ((0.3, 0.1, 0.0), 9.0, (0.0, 0.0), False),  # at z = 0
        ((0.0, 0.0, 5e-5), 9.0, (0.0, 0.0), False),  # nearer than MIN_Z
        ((math.nan, 0.0, 1.0), 9.0, (0.0, 0.0), False),
        ((0.0, math.inf, math.inf), 9.0, (0.0, 0.0), False),
    ]
    found = planes.lookup(torch.tensor([case[0] for case in cases]))
    for index, (point, colour, coordinate, valid) in enumerate(cases):
        assert found.valid[index].item() == valid, point
        assert found.colours[index].item() == pytest.approx(colour, abs=1e-6), point
        assert found.coordinates[index, 0].tolist() == pytest.approx(coordinate, abs=1e-6), point


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 5), (5, 1)])
def test_images_of_one_row_or_column(backend, height, width):
    """Source of truth: the loop. Only points exactly on a single row are valid."""
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(2, 3, height, width, generator=generator).requires_grad_()
    ours = cameras.concatenate([frontal(height, width), frontal(height, width)])
    points = torch.rand(50, 3, generator=generator) - 0.5
    points[:, 2] = 1
    points[:25, 1 if height == 1 else 0] = 0
    if height == width:
        points[:25, :2] = 0
    found = ImagePlanes(images, ours, backend=backend).lookup(points)
    matrices = cameras.projection_matrices(ours).numpy()
    colours, coordinates, valid = reference.lookup(points.numpy(), matrices, images.detach().numpy())
    np.testing.assert_array_equal(found.valid.numpy(), valid)
    np.testing.assert_allclose(found.coordinates.detach().numpy(), coordinates, atol=1e-6)
    np.testing.assert_allclose(found.colours.detach().numpy(), colours, atol=1e-5)
    (gradient,) = torch.autograd.grad(found.colours.sum(), images)
    assert gradient.sum().item() == pytest.approx(3 * valid.sum(), rel=1e-5)  # the weights of each lookup sum to 1


@pytest.mark.parametrize("backend", BACKENDS)
def test_there_may_be_no_points_no_views_or_no_channels(backend):
    points, ours, images = scene(points=10)
    planes = ImagePlanes(images, ours, backend=backend)
    assert planes.lookup(points[:0]).colours.shape == (0, 5, 3)
    assert planes.lookup(points[:1]).colours.shape == (1, 5, 3)
    assert planes.lookup(points, torch.zeros(10, 0, dtype=torch.long)).colours.shape == (10, 0, 3)
    none = ImagePlanes(images[:0], cameras.select(ours, slice(0, 0)), backend=backend).lookup(points)
    assert none.colours.shape == (10, 0, 3)
    assert none.valid.shape == (10, 0)
    bare = ImagePlanes(images[:, :0], ours, backend=backend).lookup(points)
    assert bare.colours.shape == (10, 5, 0)
    torch.testing.assert_close(bare.coordinates, planes.lookup(points).coordinates)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("chosen", [False, True])
@pytest.mark.parametrize("channels", [2, 3])
def test_the_gradients_of_the_kernels_are_those_of_plain_torch(dtype, chosen, channels):
    """Another implementation: autograd through the torch backend, on smooth images."""
    points, ours, images = scene(points=500, channels=channels, dtype=dtype)
    images = torch.nn.functional.avg_pool2d(images, 5, 1, 2)
    views = torch.randint(0, 5, (500, 2), generator=torch.Generator().manual_seed(1)) if chosen else None
    matrices = cameras.projection_matrices(ours)
    results = []
    for backend in BACKENDS:
        leaves = [value.clone().requires_grad_() for value in (points, matrices, images)]
        found = lookup(*leaves, views, backend=backend)
        generator = torch.Generator().manual_seed(2)
        pulls = [torch.randn(v.shape, generator=generator, dtype=dtype) for v in (found.colours, found.coordinates)]
        results.append(torch.autograd.grad([found.colours, found.coordinates], leaves, pulls))
    for plain, fused in zip(*results, strict=True):
        near = (fused - plain).abs() <= (1e-8 if dtype == torch.float64 else 2e-2) * (1 + plain.abs())
        assert near.float().mean() > 0.99  # in float32, a point on a pixel boundary may round to either side


def test_packed_gradients_are_those_of_the_images_they_hold():
    points, ours, images = scene(points=300)
    eight = (images * 255).round() / 255
    matrices = cameras.projection_matrices(ours)
    results = []
    for packed in (None, pack(eight)):
        leaf = points.clone().requires_grad_()
        found = lookup(leaf, matrices, eight, packed=packed, backend="cpu")
        results.append((found.colours, torch.autograd.grad(found.colours.square().sum(), leaf)[0]))
    torch.testing.assert_close(results[0][0], results[1][0], atol=1e-6, rtol=0)
    torch.testing.assert_close(results[0][1], results[1][1], atol=1e-4, rtol=1e-4)


def test_packed_images_have_the_stated_precision():
    """Property: 8-bit pictures are exact, others within 1/512; values out of range are refused."""
    images = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    assert (reference.unpack(pack(images)) - images).abs().max() < 1 / 1024
    eight = (images * 255).round() / 255
    assert pack(eight).bits == 8
    torch.testing.assert_close(reference.unpack(pack(eight)), eight, atol=1e-7, rtol=0)
    assert pack(images * 2) is None
    assert pack(images * math.nan) is None
    assert pack(images[:, :2]) is None
    points, ours, _ = scene()
    images = torch.rand(5, 3, 9, 13, generator=torch.Generator().manual_seed(1))
    fast, exact = ImagePlanes(images, ours).lookup(points), ImagePlanes(images, ours, exact=True).lookup(points)
    assert (fast.colours - exact.colours).abs().max() < 1 / 512
    torch.testing.assert_close(fast.coordinates, exact.coordinates)


def test_images_changed_in_place_are_looked_up():
    points, ours, images = scene()
    planes = ImagePlanes(images, ours, background=0.0)
    before = planes.lookup(points).colours
    images.mul_(0.5)
    torch.testing.assert_close(planes.lookup(points).colours, before / 2, atol=2e-3, rtol=0)


def test_lookups_copy_no_images_whatever_their_layout(monkeypatch):
    """Decoded pictures have channels last. A copy at every lookup took ten times as long as the lookup itself."""
    points, ours, images = scene()
    by_pixels = images.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
    planes, copied, contiguous = ImagePlanes(by_pixels, ours, exact=True), [], torch.Tensor.contiguous

    def counted(self):
        copied.extend([] if self.is_contiguous() else [self.numel()])
        return contiguous(self)

    with monkeypatch.context() as patched:
        patched.setattr(torch.Tensor, "contiguous", counted)
        found = planes.lookup(points).colours
    assert images.numel() not in copied
    assert torch.equal(found, ImagePlanes(images, ours, exact=True).lookup(points).colours)


def test_gradients_reach_images_of_any_layout():
    points, ours, images = scene()
    by_pixels = images.permute(0, 2, 3, 1).contiguous().requires_grad_()
    ImagePlanes(by_pixels.permute(0, 3, 1, 2), ours).lookup(points).colours.sum().backward()
    images.requires_grad_()
    ImagePlanes(images, ours).lookup(points).colours.sum().backward()
    torch.testing.assert_close(by_pixels.grad.permute(0, 3, 1, 2), images.grad)
    assert images.grad.abs().sum() > 0


def test_directions_and_distances_match_centres():
    """Closed form: centre + distance * direction = point, directions are unit vectors."""
    points, ours, images = scene(points=20)
    views = torch.tensor([[4, 0]]).expand(20, 2)
    found = ImagePlanes(images, ours).lookup(points, views, return_directions=True)
    back = cameras.centres(ours)[views] + found.distances[..., None] * found.directions
    torch.testing.assert_close(back, points[:, None].expand_as(back))
    torch.testing.assert_close(found.directions.norm(dim=-1), torch.ones(20, 2))
    assert ImagePlanes(images, ours).lookup(points).directions is None


def test_the_operator_passes_opcheck():
    """torch.library.opcheck tests the schema, the fake tensor and the registration of autograd."""
    from hyperplanes.geometry.kernels.lookup import operators

    points, ours, images = scene(points=7)
    matrices = cameras.projection_matrices(ours)
    leaves = (points.requires_grad_(), matrices.requires_grad_(), images.requires_grad_())
    tests = ("test_schema", "test_autograd_registration", "test_faketensor")
    for views in (None, torch.zeros(7, 2, dtype=torch.long)):
        torch.library.opcheck(operators.lookup, (*leaves, None, 0, views, 1e-4, 1.0), test_utils=tests)


def test_wrong_arguments_are_named():
    points, ours, images = scene(points=4)
    with pytest.raises(ValueError, match="views: expected indices of 5 planes, got 0 to 5"):
        ImagePlanes(images, ours).lookup(points, torch.tensor([[0], [5], [1], [1]]))
    with pytest.raises(ValueError, match="backend: expected one of torch, cpu, triton, got 'gpu'"):
        ImagePlanes(images, ours, backend="gpu").lookup(points)
    with pytest.raises(ValueError, match="one a camera, 5, got 4"):
        ImagePlanes(images[:4], ours)
    with pytest.raises(ValueError, match=r"the cameras' size \(9, 13\), got \(9, 12\)"):
        ImagePlanes(images[..., :12], ours)


def test_the_default_follows_device_and_dtype(monkeypatch):
    points, _, images = scene(points=4)
    assert [backend.name for backend in backends()] == ["torch", "cpu", "triton"]
    assert choose(points, images) == "cpu"
    assert choose(points.half(), images) == "torch"
    monkeypatch.setitem(_INSTALLED, "numba", False)
    assert choose(points, images) == "torch"
    assert not {backend.name: backend for backend in backends()}["cpu"].available


@pytest.mark.parametrize("chosen", [False, True])
def test_hidden_planes_show_no_point_and_the_others_are_unchanged(chosen):
    points, ours, images = scene()
    planes = ImagePlanes(images, ours, 0.25)
    views = torch.randint(0, 5, (len(points), 3), generator=torch.Generator().manual_seed(0)) if chosen else None
    before, found = planes.lookup(points, views), planes.mask_views(torch.tensor([1, 4])).lookup(points, views)
    gone = torch.isin(views if chosen else torch.arange(5).expand(len(points), 5), torch.tensor([1, 4]))
    assert before.valid[gone].any()
    assert torch.equal(found.valid, before.valid & ~gone)
    assert torch.equal(found.colours[~gone], before.colours[~gone])
    assert torch.equal(found.colours[gone], torch.full_like(found.colours[gone], 0.25))
    assert torch.equal(planes.lookup(points, views).colours, before.colours)


def test_other_images_of_the_same_cameras_have_the_coordinates_of_the_first():
    points, ours, images = scene()
    planes = ImagePlanes(images, ours, 0.25)
    planes.lookup(points)  # packs the first images
    other = torch.rand(5, 2, *images.shape[2:], generator=torch.Generator().manual_seed(3))
    found = planes.mask_views(torch.tensor([1])).with_images(other).lookup(points)
    expected = ImagePlanes(other, ours, 0.25, exact=True).lookup(points)
    assert torch.equal(found.colours, expected.colours)
    assert torch.equal(found.valid, expected.valid)


@pytest.mark.parametrize("chosen", [False, True])
def test_without_channels_coordinates_still_have_gradients(chosen):
    points, ours, images = scene(points=20)
    views = torch.randint(0, 5, (20, 2), generator=torch.Generator().manual_seed(1)) if chosen else None
    found = []
    for backend in BACKENDS:
        leaf = points.clone().requires_grad_()
        seen = ImagePlanes(images[:, :0], ours, backend=backend).lookup(leaf, views)
        found.append(torch.autograd.grad(seen.coordinates.sum(), leaf)[0])
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-3)


def test_tensors_without_a_version_counter_are_copied():
    points, ours, images = scene()
    with torch.inference_mode():
        unseen = images.clone()
        planes = ImagePlanes(unseen, ours)
        expected = planes.lookup(points).colours
        unseen.fill_(1.0)
        assert torch.equal(planes.lookup(points).colours, expected)
        eight, last = (255 * images).round().byte(), images.permute(0, 2, 3, 1).contiguous()
        for other in (eight, last.permute(0, 3, 1, 2)):  # which are converted to other tensors
            assert ImagePlanes(other, ours).lookup(points).colours.shape == expected.shape
    array = images.numpy().copy()
    made = [ImagePlanes(array, ours), ImagePlanes(1 - images, ours).with_images(array)]
    before = [planes.lookup(where).colours for planes in made for where in (points, points.double())]
    array[:] = 1.0
    after = [planes.lookup(where).colours for planes in made for where in (points, points.double())]
    assert all(torch.equal(*each) for each in zip(before, after, strict=True))


def test_a_single_camera_sees_points_before_it_for_any_origin():
    for far, size in ((0.0, 1.0), (1e3, 1.0), (1e5, 1.0), (1e7, 1.0), (1e-4, 1e-5)):
        eye = torch.tensor([[far, 0.0, 3.0 * size]], dtype=torch.double)
        pose = cameras.look_at(eye, target=(far, 0.0, 0.0)).double()
        one = cameras.pinhole(cameras.symmetric_intrinsics(9, 13, 0.7), pose, 9, 13)
        planes = ImagePlanes(torch.rand(1, 3, 9, 13, dtype=torch.double), one)
        ahead, behind = [far, 0.0, 0.0], [far, 0.0, 6.0 * size]
        assert planes.lookup(torch.tensor([ahead, behind], dtype=torch.double)).valid[:, 0].tolist() == [True, False]


def test_masks_and_other_images_need_the_shape_of_the_views():
    points, ours, images = scene()
    planes = ImagePlanes(images, ours)
    for masked in (torch.tensor([1, 3]), [1, 3], [False, True, False, True, False]):
        assert not planes.mask_views(masked).lookup(points).valid[:, [1, 3]].any()
    with pytest.raises(ValueError, match="views: expected indices of 5 views, got 7 to 7"):
        planes.mask_views([7])
    for other in (images[:4], images[..., :5]):
        with pytest.raises(ValueError, match=r"images: expected shape \(5, channel, 9, 13\)"):
            planes.with_images(other)


def test_images_may_be_under_a_transform():
    points, ours, images = scene(points=10)
    stack = torch.stack([images, 0.5 * images])

    def summed(each):
        return ImagePlanes(each, ours).lookup(points).colours.square().sum()

    torch.testing.assert_close(
        torch.func.vmap(summed)(stack), torch.stack([summed(each) for each in stack]), rtol=1e-3, atol=0
    )


def test_other_images_are_converted_as_the_first_are():
    points, ours = scene()[0], cameras.pinhole(cameras.symmetric_intrinsics(9, 13, 0.7), cameras.orbit(5, 3.0), 9, 13)
    bytes_ = torch.randint(256, (5, 2, 9, 13), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    lens = distorted(ours, torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0]))
    for shown in (ours, lens):
        expected = ImagePlanes(bytes_, shown, exact=True).lookup(points).colours
        first = ImagePlanes(torch.zeros(5, 3, 9, 13), shown)
        for images in (bytes_, bytes_.numpy()):
            assert torch.equal(first.with_images(images).lookup(points).colours, expected)


def test_images_that_replace_others_are_looked_up():
    points, ours, images = scene()
    planes = ImagePlanes(images, ours)
    before = planes.lookup(points).colours
    planes.images = 1 - images
    after = planes.lookup(points).colours
    assert torch.equal(after, ImagePlanes(1 - images, ours).lookup(points).colours)
    assert not torch.equal(after, before)


def test_the_direction_at_a_camera_is_zero_with_a_finite_gradient():
    _, ours, images = scene()
    points = cameras.centres(ours).clone().requires_grad_()
    found = ImagePlanes(images, ours).lookup(points, return_directions=True)
    own = found.directions.diagonal().T
    assert torch.equal(own, torch.zeros_like(own))
    (gradient,) = torch.autograd.grad(found.directions.sum(), points)
    assert gradient.abs().max() < 10
