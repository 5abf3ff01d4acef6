"""Source of truth: scenes with correct poses by construction, and the same scenes with known errors."""

import json
import math
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.data.inspection.checks import check_duplicates, check_gaze, check_masks, check_poses, check_splits
from hyperplanes.data.inspection.conventions import check_conventions
from hyperplanes.data.inspection.describe import describe
from hyperplanes.data.inspection.matches import match_pictures, sampson
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import cast, pixel_grid
from hyperplanes.views import Views

SIZE, RADIUS = 96, 0.8


def photographs(count, start=0.0):
    """A textured ball in a textured sphere, without masks, from cameras a few degrees apart; in closed form."""
    angle = start + torch.arange(count) * 0.12
    eyes = 3 * torch.stack([angle.sin(), 0.25 * (angle * 5).sin(), angle.cos()], -1)
    cameras = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.7), camera.look_at(eyes), SIZE, SIZE)
    pixels = pixel_grid(SIZE, SIZE)
    images = []
    for view in range(count):
        rays = cast(cameras, torch.full((len(pixels),), view), pixels)
        along = -(rays.origins * rays.directions).sum(-1)
        for radius, sign in ((RADIUS, -1.0), (6.0, 1.0)):
            square = radius**2 - rays.origins.square().sum(-1) + along.square()
            points = rays.origins + (along + sign * square.clamp_min(0).sqrt())[:, None] * rays.directions
            if radius == RADIUS:
                near, hit = points, square > 0
        points = torch.where(hit[:, None], near * 7, points * 2)
        cells = (points * 1.7).floor()
        values = torch.frac((cells @ torch.tensor([12.9898, 78.233, 37.719])).sin().abs() * 43758.5453)
        images.append(values.reshape(1, SIZE, SIZE).expand(3, -1, -1))
    return Views(torch.stack(images), cameras)


def moved(views, matrix):
    """The same pictures, with poses in other world coordinates."""
    return replace(views, cameras=camera.with_poses(views.cameras, views.cameras.extrinsics @ matrix))


def other_world():
    turn = torch.eye(4)
    turn[:3] = torch.tensor([[0.0, 0, 1, 0], [1, 0, 0, 0.8], [0, 1, 0, 0]])
    return turn


def balls(scene_class, views=12):
    """Views of the ball of conftest with masks."""
    scene = scene_class(views=views)
    pixels = torch.from_numpy(np.stack(scene.pictures)).permute(0, 3, 1, 2).float() / 255
    pose = torch.from_numpy(scene.camera_from_world).float()
    cameras = camera.pinhole(torch.from_numpy(scene.matrix).float(), pose, *scene.size)
    return Views(scene.over_white(), cameras, (pixels[:, 3:] > 0).float())


def test_the_sampson_error_is_that_of_opencv():
    generator = np.random.default_rng(0)
    pixels = generator.uniform(0, 100, (1, 2, 2))
    matrix = np.array([[80.0, 0, 50], [0, 90, 40], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0], [0.5, 0.1, -0.2]
    x, y, z = pose[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    fundamental = np.linalg.inv(matrix).T @ cross @ pose[:3, :3] @ np.linalg.inv(matrix)
    homogeneous = [np.append(pixels[0, side], 1.0)[:, None] for side in (0, 1)]
    expected = cv2.sampsonDistance(homogeneous[0], homogeneous[1], fundamental)  # the square of the product's error
    ours = sampson(*(torch.from_numpy(each) for each in (pixels, matrix[None], matrix[None], pose[None])))
    assert float(ours) ** 2 == pytest.approx(expected, rel=1e-6)


def test_photographs_without_masks_are_checked_by_matched_corners():
    views = photographs(8)
    matches = match_pictures(views)
    assert float(matches.errors(views.cameras.extrinsics).median()) < 0.5
    found = check_conventions(views)
    assert found.consistent
    assert found.by == "pictures"
    assert "matched corners of the pictures agree with the poses" in found.line()
    rolled = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ views.cameras.extrinsics
    wrong = check_conventions(replace(views, cameras=camera.with_poses(views.cameras, rolled)))
    assert not wrong.consistent
    assert "WRONG" in wrong.line()
    plain = replace(views, images=torch.full_like(views.images, 0.5))
    assert "not checked, there are no masks, and only 0 corners" in check_conventions(plain).line()


def test_photographs_in_the_axes_of_another_program_are_recognised():
    views = photographs(8)
    flipped = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])) @ views.cameras.extrinsics
    found = check_conventions(replace(views, cameras=camera.with_poses(views.cameras, flipped)))
    assert not found.consistent
    fine, line = check_gaze(replace(views, cameras=camera.with_poses(views.cameras, flipped)))
    assert (fine, "only 0 of 8 look at one place (0 have it ahead)" in line) == (False, True)
    assert check_gaze(views) == (True, "cameras: 8 of 8 look at one place")


def test_cameras_with_parallel_axes_may_look_at_one_place_or_not():
    views = photographs(8)
    assert check_gaze(views[:1]) is None
    moved = views.cameras.extrinsics[:1].repeat(8, 1, 1)
    moved[:, 0, 3] += torch.arange(8)
    assert check_gaze(replace(views, cameras=camera.with_poses(views.cameras, moved))) is None


def test_masks_that_agree_under_no_convention_are_wrong(scene):
    """Randomly permuted poses agree with no mask; the relative comparison alone accepted them."""
    views = balls(type(scene))
    assert check_conventions(views).consistent
    order = [5, 9, 0, 7, 11, 2, 10, 1, 4, 3, 6, 8]
    cut = views.masks.clone()
    cut[::2, :, :, 16:] = 0.0
    cut[1::2, :, :, :16] = 0.0
    wrong = check_conventions(replace(views, masks=cut, images=views.images)[order])
    assert not wrong.consistent
    assert "WRONG, the hull of the masks covers" in wrong.line()


def test_one_picture_for_many_poses_is_found(scene):
    views = balls(type(scene))
    assert check_duplicates(views) is None
    names = tuple(f"{index}.png" for index in range(12))
    repeated = replace(views, images=views.images[[0, 1, 2, 0, 0, 5, 6, 7, 8, 9, 10, 0]], names=names)
    assert "4 of 12 poses have the image of another pose (0.png and 3.png" in check_duplicates(repeated)
    assert check_duplicates(views[[0, 0, 1]]) is None  # the same view twice is consistent


def test_one_picture_in_support_and_query_is_found(scene, tmp_path):
    """A copy with another name has another pose, and is reported; a file listed twice is one view, with a note."""
    document, home = scene.document(), scene.write(tmp_path)
    shutil.copy(home / scene.names[0], home / scene.names[3])
    document["frames"].append(document["frames"][5])
    (home / "transforms.json").write_text(json.dumps(document))
    found = describe(home).lines()
    assert any("2 of 8 poses have the image of another pose (images/000.png and images/003.png" in s for s in found)
    assert f"{home.name}: 1 frame left out, whose images earlier frames list: images/005.png" in found


def test_equal_poses_and_inverted_masks_are_problems_of_a_described_scene(scene, tmp_path):
    document, home = scene.document(), scene.write(tmp_path)
    assert describe(home).objects[0].consistent
    right = [frame["transform_matrix"] for frame in document["frames"]]
    for frame in document["frames"]:
        frame["transform_matrix"] = right[0]
    (home / "transforms.json").write_text(json.dumps(document))
    assert any("poses: WRONG, 8 of 8 are the same" in line for line in describe(home).objects[0].problems)
    for frame, pose in zip(document["frames"], right, strict=True):
        frame["transform_matrix"] = pose
    (home / "transforms.json").write_text(json.dumps(document))
    pixels = np.array(Image.open(home / scene.names[1]))
    pixels[..., 3] = 255 - pixels[..., 3]
    Image.fromarray(pixels).save(home / scene.names[1])
    described = describe(home)
    assert not described.broken
    found = described.objects[0]
    assert "masks: WRONG, 1 of 8 seem to show the background" in found.problems
    assert not found.consistent


def test_splits_with_different_world_coordinates_are_found(scene):
    whole = balls(type(scene), 16)
    support, query = whole[::2], whole[1::2]
    assert check_splits(support, query)[0]
    fine, line = check_splits(support, moved(query, other_world()))
    assert not fine
    assert "posed in different worlds" in line
    opaque = photographs(9)
    assert check_splits(opaque[::2], opaque[1::2])[0]
    turn = torch.eye(4)
    turn[:3, :3] = torch.from_numpy(cv2.Rodrigues(np.array([0.0, 0.2, 0.2]))[0])
    fine, line = check_splits(opaque[::2], moved(opaque[1::2], turn))
    assert not fine
    assert "corners matched between support and query" in line


def test_one_pose_for_many_pictures_is_found(scene):
    views = balls(type(scene))
    assert check_poses(views) is None
    same = views.cameras.extrinsics[[0] * 7 + list(range(7, 12))]
    repeated = replace(views, cameras=camera.with_poses(views.cameras, same))
    assert "poses: WRONG, 7 of 12 are the same" in check_poses(repeated)
    assert check_poses(views[[0, 0, 0, 1, 2, 3]]) is None  # half of the pictures, from a tripod


def test_masks_that_show_the_background_are_found(scene):
    views = balls(type(scene))
    assert check_masks(views) is None
    assert check_masks(replace(views, masks=None)) is None
    masks = views.masks.clone()
    masks[[2, 5]] = 1 - masks[[2, 5]]
    assert check_masks(replace(views, masks=masks)) == "masks: WRONG, 2 of 12 seem to show the background"


def test_empty_masks_are_named_and_hide_nothing_else(scene, tmp_path):
    """The hull, its extent and the check of the poses are those of the other views."""
    views = balls(type(scene))
    masks = views.masks.clone()
    masks[[2, 5]] = 0
    wrong = replace(views, masks=masks)
    line = "masks: WRONG, 2 of 12 are empty ({}); leave these views out or correct their masks"
    assert check_masks(wrong) == line.format("2, 5")
    rest = views[[index for index in range(12) if index not in (2, 5)]]
    assert check_conventions(wrong) == check_conventions(rest)
    assert check_splits(wrong, views) == check_splits(rest, views)
    damaged = type(scene)()
    for index in (1, 4):  # one of the support, one of the query
        damaged.pictures[index][..., 3] = 0
    found = describe(damaged.write(tmp_path)).objects[0]
    assert found.problems == (
        "masks: WRONG, 2 of 8 are empty (images/001.png, images/004.png); leave these views out or correct their masks",
    )
    assert math.dist(found.bounds[0], scene.centre) + scene.radius < found.bounds[1]
    assert found.extent is not None
    assert min(found.extent) > 2 * scene.radius


def test_masks_without_any_object_are_reported(scene):
    views = balls(type(scene))
    blank = replace(views, masks=torch.zeros_like(views.masks))
    assert check_masks(blank).startswith("masks: WRONG, 12 of 12 are empty (0, 1, 2,")
