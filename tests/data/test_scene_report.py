"""The report of `inspect` about a scene's views.

Source of truth: areas of spherical caps, angles by hand, and known damage to one view.
"""

import math
import struct
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.data.formats.scenes.sparse_points import read_sparse_points
from hyperplanes.data.inspection.picture import draw_coverage
from hyperplanes.data.inspection.scene import describe_scene
from hyperplanes.geometry import Sphere
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.poses import look_at
from hyperplanes.views import Views

SIZE = 48


def standing(*angles):
    """Grey views without masks, from azimuths and elevations in degrees."""
    azimuth, elevation = torch.deg2rad(torch.tensor(angles, dtype=torch.float64)).T
    flat = elevation.cos()
    eyes = 3 * torch.stack([flat * azimuth.sin(), elevation.sin(), flat * azimuth.cos()], -1)
    cameras = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.7), look_at(eyes).float(), SIZE, SIZE)
    names = tuple(f"images/{index}.png" for index in range(len(angles)))
    return Views(torch.full((len(angles), 3, SIZE, SIZE), 0.5), cameras, None, Sphere(), names, "y")


def ball():
    """Twelve views of a ball with a texture of noise."""
    views = standing(*((30 * index, 20 * (-1) ** index) for index in range(12)))
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    middle = (SIZE - 1) / 2
    mask = ((rows - middle) ** 2 + (columns - middle) ** 2 < (SIZE / 4) ** 2).float().expand(12, 1, SIZE, SIZE)
    noise = torch.rand(12, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    return replace(views, images=noise * mask + 1 - mask, masks=mask.clone())


def test_coverage_is_the_area_of_spherical_caps():
    report = describe_scene(standing((0, 0), (180, 0)))
    assert report.covered == pytest.approx(1 - math.cos(math.radians(30)), abs=0.01), "two caps of (1 - cos 30) / 2"
    assert (report.above, report.below, report.gap) == (0.0, 0.0, None)
    assert [view.neighbour for view in report.views] == pytest.approx([180, 180], abs=1e-3)
    assert report.expectation().startswith("poor pictures: there are no masks")
    assert "only from near where the views stand" in replace(report, masked=True).expectation()


def test_masks_of_the_background_are_reported_as_inverted():
    views = ball()
    assert describe_scene(views).expectation().startswith("good pictures")
    found = describe_scene(replace(views, masks=1 - views.masks)).expectation()
    assert found == "poor pictures: 12 of 12 masks seem to show the background; invert them, white is the object"
    one = views.masks.clone()
    one[3] = 1 - one[3]
    report = describe_scene(replace(views, masks=one))
    assert report.expectation().startswith("poor pictures: 1 of 12 masks")
    assert report.views[3].faults == ("the mask seems to show the background",)
    assert not any(view.cut for view in report.views), "an inverted mask does not say that the object is cut off"
    assert [view.name for view in report.views if view.faults] == [report.views[3].name]


def test_an_empty_mask_is_named():
    views = ball()
    views.masks[3] = 0
    report = describe_scene(views)
    assert {view.name: view.faults for view in report.views if view.faults} == {"3.png": ("the mask is empty",)}
    assert report.worst[0].name == "3.png"
    assert (
        report.expectation()
        == "poor pictures: 1 of 12 masks show nothing; leave these views out or correct their masks"
    )


def test_the_widest_gap_lies_between_views_that_are_named():
    """A view that looks steeply down does not divide a gap."""
    report = describe_scene(standing(*((20 * index, 10) for index in range(11)), (280, 85)))
    assert report.views[11].faults == ("no other within 79 degrees",)
    width, left, right = report.gap
    assert (round(width), left, right) == (160, "10.png", "0.png")
    assert [round(value, 3) for value in report.views[4].direction] == [80, 10]
    assert "gap: nothing was seen from 160 degrees around between 10.png and 0.png" in report.lines()


def test_a_correct_scene_has_no_faults():
    report = describe_scene(ball())
    assert report.is_sound
    fits = [view.agreement for view in report.views]
    assert max(fits) - min(fits) < 0.1, "the hull's voxels make all silhouettes larger alike"
    assert report.shown > 3
    assert not any(view.cut for view in report.views)


def test_a_wrong_mask_and_a_blurred_picture_are_named():
    views = ball()
    views.masks[3, :, :, : SIZE // 2] = 0
    kernel = torch.ones(3, 1, 5, 5) / 25
    views.images[7] = torch.nn.functional.conv2d(views.images[7:8], kernel, padding=2, groups=3)[0]
    report = describe_scene(views)
    faults = {view.name: view.faults for view in report.views if view.faults}
    assert set(faults) == {"3.png", "7.png"}
    assert faults["3.png"][0].startswith("mask and the hull of all masks agree by ")
    assert faults["7.png"][0].startswith("blurred, ")
    assert {view.name for view in report.worst[:2]} == {"3.png", "7.png"}
    picture = Image.open(BytesIO(draw_coverage(report, views)))
    assert picture.size[0] > 800


def test_a_view_of_another_place_is_named_first_and_promises_nothing_good():
    views = ball()
    for each in (views.masks, views.images):
        each[5] = each[5].roll((SIZE // 3, SIZE // 3), (1, 2))
    views.masks[3, :, :, : SIZE * 9 // 16] = 0  # the mask of less than half of the object
    views.images[3] = torch.nn.functional.avg_pool2d(views.images[3], 5, 1, 2)
    report = describe_scene(views)
    assert len({view.name: view.faults for view in report.views}["3.png"]) == 2
    assert report.worst[0].name == "5.png"
    assert [view.name for view in report.wrong] == ["5.png"]
    assert report.expectation() == (
        "poor pictures: the pose or the mask is wrong of 5.png; correct it, or leave the view out"
    )


@pytest.mark.parametrize("binary", [False, True])
def test_reprojection_errors_of_colmap(tmp_path, binary):
    """Three points have errors of 1, 2 and 6 pixels; a.png shows the first two, b.png all three."""
    tracks = [((0, 1, 2), 1.0, (4, 9)), ((3, 4, 5), 2.0, (4, 9)), ((6, 7, 8), 6.0, (9,))]
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 4 4 4 4 2 2\n")
    (tmp_path / "images.txt").write_text("4 1 0 0 0 0 0 0 1 a.png\n\n9 1 0 0 0 0 0 0 1 b.png\n\n")
    assert read_sparse_points(tmp_path) is None
    if binary:
        data = struct.pack("<Q", 3)
        for number, (place, error, images) in enumerate(tracks):
            data += struct.pack("<Q3d3BdQ", number, *place, 9, 9, 9, error, len(images))
            data += b"".join(struct.pack("<ii", image, 0) for image in images)
        (tmp_path / "points3D.bin").write_bytes(data)
    else:
        lines = [
            f"{number} {' '.join(map(str, place))} 9 9 9 {error} {' '.join(f'{image} 0' for image in images)}"
            for number, (place, error, images) in enumerate(tracks)
        ]
        (tmp_path / "points3D.txt").write_text("# points\n" + "\n".join(lines) + "\n")
    found = read_sparse_points(tmp_path)
    assert found.errors == {"a.png": 1.5, "b.png": 3.0}
    assert (len(found.places), found.error) == (3, pytest.approx(2.4))
    np.testing.assert_array_equal(found.places[1], [3, 4, 5])
    views = replace(standing((0, 0), (20, 0)), names=("a.png", "b.png"))
    report = describe_scene(views, replace(found, errors={"a.png": 1.0, "b.png": 4.0}))
    assert "reprojection error: 2.40 pixels (mean, 3 points), 4.00 in the worst view (b.png)" in report.lines()
    assert [view.faults for view in report.views] == [(), ()], "less than twice the median"
    views = replace(standing((0, 0), (20, 0), (40, 0)), names=("a.png", "b.png", "c.png"))
    report = describe_scene(views, replace(found, errors={"a.png": 2.0, "b.png": 4.1, "c.png": 1.0}))
    assert [view.faults for view in report.views] == [(), ("reprojection error 4.1 pixels, in the median 2.0",), ()]


def test_the_silhouette_of_a_solid_hull_has_no_gaps():
    """A ball covers a disc for any number of pixels per voxel. SciPy's filling of holes changes nothing."""
    from scipy.ndimage import binary_fill_holes

    from hyperplanes.data.inspection.silhouettes import silhouettes
    from hyperplanes.geometry import cameras as camera
    from hyperplanes.geometry.occupancy import Occupancy, full
    from hyperplanes.geometry.rays import Sphere

    hull = full(Sphere(), 24)
    ball = Occupancy((hull.centres().norm(dim=-1) < 1).reshape(24, 24, 24), hull.bounds)
    for focal in (40.0, 60.0, 75.0):  # 1.1, 1.7 and 2.1 pixels per voxel
        calibration = torch.tensor([[[focal, 0, 63.5], [0, focal, 63.5], [0, 0, 1]]])
        cameras = camera.pinhole(calibration, camera.orbit(3, 3.0, 0.3)[:1], 128, 128)
        seen = silhouettes(ball.centres(), ball, cameras)[0].numpy()
        assert (binary_fill_holes(seen) == seen).all()
        assert np.sqrt(seen.sum() / np.pi) == pytest.approx(focal / np.sqrt(8), abs=2)
