"""All conventions of the package, compared with an independent source: OpenCV, SciPy, Kornia, or a closed form."""

import inspect
import math

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.conversions import normalize_pixel_coordinates
from scipy.ndimage import map_coordinates

from hyperplanes.data.formats.scenes.transforms_document import calibration, transforms_document
from hyperplanes.geometry import ImagePlanes, Sphere, cameras, cast
from hyperplanes.geometry.lookup import lookup
from hyperplanes.geometry.lookup_torch import interpolate, project
from hyperplanes.geometry.rays import pixel_grid

HEIGHT, WIDTH = 48, 80
K = torch.tensor([[70.0, 0.0, 33.0], [0.0, 95.0, 27.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


def poses(views=6):
    """Rotations that are orthonormal in double precision, which OpenCV's Rodrigues expects."""
    rough = cameras.pinhole(K, cameras.fibonacci_sphere(views, 3.0, -0.8, 0.9), HEIGHT, WIDTH)
    return cameras.look_at(cameras.centres(rough).double())


def some_points(count=200, dtype=torch.float64):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=dtype) * 1.6 - 0.8


def opencv_pixels(points, matrix, camera_from_world, distortion=None):
    """Pixels (view, point, 2) by cv2.projectPoints: OpenCV axes, integer pixel centres."""
    lens = np.zeros(5) if distortion is None else np.asarray(distortion)
    found = []
    for pose in camera_from_world.numpy():
        rotation, _ = cv2.Rodrigues(pose[:3, :3])
        found.append(cv2.projectPoints(points.numpy(), rotation, pose[:3, 3], matrix.numpy(), lens)[0][:, 0])
    return np.stack(found)


@pytest.mark.parametrize("axes", ["opencv", "opengl"])
@pytest.mark.parametrize("centres", ["integer", "half"])
def test_projection_agrees_with_opencv(axes, centres):
    """With poses in both axis conventions and principal points in both pixel conventions, pixels are OpenCV's."""
    pose, matrix = poses(), K.clone()
    expected = opencv_pixels(some_points(), K, pose)
    if axes == "opengl":  # as Blender stores poses: world_from_camera, y up, looking along -z
        flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        stored = torch.linalg.inv(pose) @ flip
        torch.testing.assert_close(cameras.opengl_from_opencv(pose), stored)
        pose = cameras.opencv_from_opengl(stored)
    if centres == "half":  # pixel (0, 0) centred at (0.5, 0.5): the principal point is stored half a pixel further
        stored = {"fl_x": 70.0, "fl_y": 95.0, "cx": 33.5, "cy": 28.0, "w": WIDTH, "h": HEIGHT}
        matrix = torch.from_numpy(calibration(stored, (HEIGHT, WIDTH), "transforms.json"))
        document = transforms_document(np.eye(4)[None], matrix.numpy()[None], (HEIGHT, WIDTH), ["0.png"])
        assert {name: document[name] for name in stored} == stored
    ours = cameras.pinhole(matrix, pose, HEIGHT, WIDTH)
    pixels, front = project(some_points(), cameras.projection_matrices(ours), None)
    assert front.all()
    np.testing.assert_allclose(pixels.transpose(0, 1).numpy(), expected, atol=1e-8)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lookup_coordinates_agree_with_opencv(backend, dtype):
    ours = cameras.pinhole(K, poses(), HEIGHT, WIDTH)
    expected = opencv_pixels(some_points(), K, poses())
    found = ImagePlanes(torch.zeros(6, 1, HEIGHT, WIDTH, dtype=dtype), ours, backend=backend).lookup(
        some_points().to(dtype)
    )
    pixels = ((found.coordinates + 1) / 2 * torch.tensor([WIDTH - 1, HEIGHT - 1])).transpose(0, 1)
    inside = found.valid.T.numpy()
    assert 0.5 < inside.mean() < 1
    np.testing.assert_allclose(pixels.numpy()[inside], expected[inside], atol=1e-4 if dtype == torch.float32 else 1e-9)
    within = ((expected >= 0) & (expected <= [WIDTH - 1, HEIGHT - 1])).all(-1)
    np.testing.assert_array_equal(inside, within)


def test_projection_agrees_with_kornia():
    ours = cameras.pinhole(K, poses(), HEIGHT, WIDTH)
    pixels, _ = project(some_points(), cameras.projection_matrices(ours), None)
    torch.testing.assert_close(pixels.transpose(0, 1), ours.project(some_points().expand(6, -1, 3)))


def test_coordinates_agree_with_kornia():
    ours = cameras.pinhole(K, poses(), HEIGHT, WIDTH)
    found = ImagePlanes(torch.zeros(6, 1, HEIGHT, WIDTH, dtype=torch.float64), ours).lookup(some_points())
    pixels = ours.project(some_points().expand(6, -1, 3))
    expected = normalize_pixel_coordinates(pixels, HEIGHT, WIDTH).transpose(0, 1)
    torch.testing.assert_close(found.coordinates[found.valid], expected[found.valid])


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("chosen", [False, True])
def test_sampling_agrees_with_scipy(backend, chosen):
    """SciPy's map_coordinates of order 1, in which pixel (row, column) is centred at (row, column)."""
    images = torch.rand(6, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ours = cameras.pinhole(K, poses(), HEIGHT, WIDTH)
    views = torch.arange(6).expand(200, 6) if chosen else None
    found = lookup(some_points(), cameras.projection_matrices(ours), images, views, backend=backend)
    pixels = opencv_pixels(some_points(), K, poses())
    for view in range(6):
        for channel in range(3):
            expected = map_coordinates(images[view, channel].numpy(), pixels[view][:, ::-1].T, order=1)
            inside = found.valid[:, view].numpy()
            np.testing.assert_allclose(found.colours[:, view, channel].numpy()[inside], expected[inside], atol=1e-9)


def test_pixel_centres_sample_themselves():
    """Closed form: at the coordinates of pixel centres, (column, row), samples are the pixels."""
    image = torch.arange(12.0).reshape(1, 1, 3, 4)
    coordinates = pixel_grid(3, 4) / torch.tensor([3.0, 2.0]) * 2 - 1
    assert interpolate(image, coordinates[:, None], None).flatten().tolist() == list(range(12))


def test_rays_invert_projection():
    """Property: a point on the ray through a pixel projects onto that pixel; directions are unit vectors."""
    skewed = K.clone()
    skewed[0, 1] = 4.0
    ours = cameras.pinhole(skewed, poses(), HEIGHT, WIDTH)
    view = torch.arange(6).repeat_interleave(10)
    pixels = torch.rand(60, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 40
    rays = cast(ours, view, pixels)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(60, dtype=torch.float64))
    back, _ = project(rays.at(torch.full((60,), 2.5, dtype=torch.float64)), cameras.projection_matrices(ours), None)
    torch.testing.assert_close(back[torch.arange(60), view], pixels)


def test_rays_meet_the_bounding_sphere():
    """Closed form: a ray from distance 3 through the centre of a unit sphere is inside it from 2 to 4."""
    matrix = cameras.symmetric_intrinsics(65, 65, 1.2)
    ours = cameras.pinhole(matrix, cameras.look_at(torch.tensor([[0.0, 0.0, 3.0]])), 65, 65)
    pixels = torch.tensor([[32.0, 32.0], [0.0, 0.0]])
    rays = cast(ours, torch.zeros(2, dtype=torch.long), pixels)
    assert rays.near[0].item() == pytest.approx(2, abs=1e-5)
    assert rays.far[0].item() == pytest.approx(4, abs=1e-5)
    assert rays.near[1] == rays.far[1]
    whole = cast(ours, torch.zeros(2, dtype=torch.long), pixels, Sphere(radius=0.5), near_far="constant")
    assert whole.near.tolist() == pytest.approx([2.5, 2.5])
    assert whole.far.tolist() == pytest.approx([3.5, 3.5])


def test_image_axes():
    """Closed form: seen from +z with y up, world +x points right and world +y points up in the image."""
    ours = cameras.pinhole(
        cameras.symmetric_intrinsics(64, 64, 0.7), cameras.look_at(torch.tensor([[0.0, 0.0, 3.0]])), 64, 64
    )
    pixels, _ = project(
        torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.0]]), cameras.projection_matrices(ours), None
    )
    (right, up, middle) = pixels[:, 0].tolist()
    assert middle == pytest.approx([31.5, 31.5], abs=1e-5)
    assert right[0] > middle[0]
    assert right[1] == pytest.approx(middle[1], abs=1e-5)
    assert up[1] < middle[1]


def test_orbit_is_a_ring():
    """Closed form: equal distances and elevations, optical axes through the origin, unit viewing directions."""
    ours = cameras.pinhole(cameras.symmetric_intrinsics(8, 8, 0.7), cameras.orbit(7, 2.0, math.radians(30)), 8, 8)
    torch.testing.assert_close(cameras.centres(ours)[:, 1], torch.full((7,), 1.0))
    torch.testing.assert_close(cameras.centres(ours), -2.0 * cameras.viewing_directions(ours), atol=1e-5, rtol=0)


def test_resizing_moves_borders_not_centres():
    """Closed form: the image borders are mapped to each other: column -1/2 to -1/2, W - 1/2 to 2 W - 1/2."""
    ours = cameras.pinhole(K, poses(), HEIGHT, WIDTH)
    larger = cameras.resized(ours, 2 * HEIGHT, 2 * WIDTH)
    small, _ = project(some_points(), cameras.projection_matrices(ours), None)
    large, _ = project(some_points(), cameras.projection_matrices(larger), None)
    torch.testing.assert_close(large + 0.5, 2 * (small + 0.5))


def test_cameras_are_stored_as_kornia_needs_them():
    """Kornia's `project` needs matrices (view, 4, 4) and sizes as floats."""
    ours = cameras.select(cameras.pinhole(K, poses(), HEIGHT, WIDTH), [4, 1])
    assert ours.intrinsics.shape == ours.extrinsics.shape == (2, 4, 4)
    assert ours.height.dtype == torch.float64
    assert cameras.image_size(ours) == (HEIGHT, WIDTH)
    assert ours.project(some_points(3).expand(2, 3, 3)).shape == (2, 3, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda k, p: (k * torch.tensor(-1.0), p), "expected positive focal lengths"),
        (lambda k, p: (k, 2 * p), "expected a rotation"),
        (lambda k, p: (k, p[:, :3]), r"expected shape \(view, 4, 4\)"),
        (lambda k, p: (k[None].expand(5, 3, 3), p), "expected one matrix or 6"),
        (lambda k, p: (k, p * math.nan), "got NaN or infinity in view 0"),
    ],
)
def test_wrong_cameras_are_refused(change, message):
    matrix, pose = change(K, poses())
    with pytest.raises((ValueError, TypeError), match=message):
        inspect.unwrap(cameras.pinhole)(matrix, pose, HEIGHT, WIDTH)
