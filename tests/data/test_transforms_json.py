"""Source of truth: a ball with pictures in closed form (conftest), and numbers by hand."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.commands.inputs.scene import read_path, read_scene
from hyperplanes.commands.output.console import Console
from hyperplanes.data import DataError, open_dataset, read_task, read_views
from hyperplanes.data.formats.recognise import read_posed_task
from hyperplanes.data.formats.scenes.transforms_document import transforms_document
from hyperplanes.data.formats.scenes.transforms_json import _lens, read_transforms
from hyperplanes.data.pictures.frames import assemble
from hyperplanes.data.pictures.undistort import distort
from hyperplanes.geometry import cameras as camera

CHAIR = Path(__file__).parents[3] / "shared/posed/chair"


def test_blender_pictures_poses_and_calibration(scene, tmp_path):
    views = read_views(scene.write(tmp_path))
    assert torch.allclose(views.images, scene.over_white(), atol=1e-6)
    assert torch.equal(views.masks[:, 0] > 0, torch.from_numpy(np.stack(scene.pictures)[..., 3] > 0))
    pose = torch.from_numpy(scene.camera_from_world).float()
    assert torch.allclose(camera.camera_from_world(views.cameras), pose, atol=1e-6)
    expected = torch.from_numpy(scene.matrix).float().expand(len(views), 3, 3)
    assert torch.allclose(camera.intrinsics(views.cameras), expected, atol=1e-5)
    assert views.names == tuple(scene.names)


def test_the_centre_of_the_ball_is_projected_to_the_centroid_of_its_silhouettes(scene, tmp_path):
    """Property: with the right convention, geometry and pictures agree to 0.35 pixels."""
    views = read_views(scene.write(tmp_path))
    points = torch.tensor(scene.centre).float().expand(len(views), 1, 3)
    pixels = views.cameras.project(points)[:, 0]
    for mask, pixel in zip(views.masks[:, 0], pixels, strict=True):
        rows, columns = torch.nonzero(mask > 0, as_tuple=True)
        middle = torch.stack([columns.float().mean(), rows.float().mean()])
        assert (middle - pixel).abs().max() < 0.35


def test_legacy_reading_moves_the_principal_point_by_half_a_pixel(scene, tmp_path):
    scene.write(tmp_path)
    legacy, _ = assemble(read_transforms(tmp_path / "transforms.json", legacy=True))
    assert camera.intrinsics(legacy.cameras)[0, :2, 2].tolist() == [16.0, 12.0]
    assert camera.intrinsics(read_views(tmp_path).cameras)[0, :2, 2].tolist() == [15.5, 11.5]


def test_nerfstudio_fields_are_scaled_to_the_size_of_the_pictures(scene, tmp_path):
    """By hand: the file describes pictures of 64 x 48; the pictures have half that size."""
    document = scene.document(fl_x=100.0, fl_y=90.0, cx=30.0, cy=25.0, w=64, h=48, camera_model="OPENCV")
    matrix = camera.intrinsics(read_views(scene.write(tmp_path, document)).cameras)[0]
    assert matrix.tolist() == [[50.0, 0.0, 14.5], [0.0, 45.0, 12.0], [0.0, 0.0, 1.0]]


def test_k4_of_nerfstudio_is_the_coefficient_of_the_eighth_power_of_the_radius(scene, tmp_path):
    """`camera_utils._compute_residual_and_jacobian` of nerfstudio: 1 + r (k1 + r (k2 + r (k3 + r k4))), r = x^2 + y^2.

    OpenCV's k4 is the first coefficient of the denominator.
    """
    k = (-0.1, 0.05, -0.02, 0.06)
    lens = dict(zip(("k1", "k2", "k3", "k4"), k, strict=True))
    square = np.linspace(0, 0.35, 50)[:, None] ** 2
    points = np.concatenate([square**0.5, 0 * square], 1)
    for model, factor in (
        ("OPENCV", 1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])))),
        ("FULL_OPENCV", (1 + square * (k[0] + square * (k[1] + square * k[2]))) / (1 + k[3] * square)),
    ):
        document = scene.document(fl_x=64.0, fl_y=64.0, w=32, h=24, camera_model=model, **lens)
        scene.write(tmp_path, document)
        found = _lens(document, tmp_path / "none.png", tmp_path / "transforms.json")
        np.testing.assert_allclose(distort(points, found), points * factor, atol=1e-5)


def test_the_calibration_of_a_frame_takes_precedence(scene, tmp_path):
    document = scene.document(fl_x=100.0)
    document["frames"][1]["fl_x"] = 50.0
    focal = camera.intrinsics(read_views(scene.write(tmp_path, document)).cameras)[:3, 0, 0]
    assert focal.tolist() == [100.0, 50.0, 100.0]


def test_skew_is_refused_as_the_file_cannot_store_it():
    lenses = np.diag([2.0, 2.0, 1.0])[None].repeat(2, 0)
    lenses[1, 0, 1] = -0.25
    with pytest.raises(ValueError, match=r"^intrinsics: expected no skew, got -0.25$"):
        transforms_document(np.eye(4)[None].repeat(2, 0), lenses, (1, 1), ["0.png", "1.png"])


def test_written_files_are_read_back(scene, tmp_path):
    document = transforms_document(
        np.linalg.inv(scene.camera_from_world),
        np.tile(scene.matrix, (8, 1, 1)),
        scene.size,
        scene.names,
        near_far=(2.0, 4.0),
        sphere=((0.1, 0.2, 0.0), 0.5),
    )
    task = read_task(scene.write(tmp_path, document))
    assert task.support.names == tuple(scene.names[::2])
    assert task.query.names == tuple(scene.names[1::2])
    assert (task.support.bounds.centre, task.support.bounds.radius) == ((0.1, 0.2, 0.0), 0.5)
    written = torch.from_numpy(scene.camera_from_world[1::2]).float()
    assert torch.allclose(camera.camera_from_world(task.query.cameras), written, atol=1e-6)
    rays = task.query.rays(0)
    other = read_views(scene.write(tmp_path / "blender")).rays(1)
    assert torch.allclose(rays.directions, other.directions, atol=1e-6)


def test_a_scene_at_map_coordinates_keeps_its_pixels(scene, tmp_path):
    """Closed form: a moved scene has its points at the same pixels. At 4e6, float32 has steps of 0.25."""
    offset = np.array([512_345.678, 4_198_765.432, 210.5])
    document = scene.document(scene_sphere={"centre": (scene.centre + offset).tolist(), "radius": 0.7})
    for frame in document["frames"]:
        frame["transform_matrix"] = np.array(frame["transform_matrix"])
        frame["transform_matrix"][:3, 3] += offset
        frame["transform_matrix"] = frame["transform_matrix"].tolist()
    near = read_task(scene.write(tmp_path / "near"))
    far = read_posed_task(scene.write(tmp_path / "far", document))
    origin = np.array(re.findall(r"[-\d.]+", far.notes[0].split(": ")[1])[:3], float)
    np.testing.assert_allclose(far.support.origin, origin)
    np.testing.assert_allclose(far.support.bounds.centre, scene.centre + offset - origin, atol=1e-9)
    assert far.query.bounds == far.support.bounds
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    moved = (points.double() + torch.from_numpy(offset - origin)).float()
    for half, reference in ((far.support, near.support), (far.query, near.query)):
        shown = half.cameras.project(moved.expand(len(half), -1, -1))
        torch.testing.assert_close(
            shown, reference.cameras.project(points.expand(len(half), -1, -1)), atol=0.01, rtol=0
        )
    assert not any("shifted" in note for note in read_posed_task(tmp_path / "near").notes)
    assert read_posed_task(tmp_path / "near").support.origin == (0.0, 0.0, 0.0)
    # a camera path with the same poses, in the world of the files
    frames = [{"camera_to_world": each["transform_matrix"], "fov": 60.0} for each in document["frames"]]
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"render_width": 8, "render_height": 8, "camera_path": frames}))
    task, up = read_scene(tmp_path / "far", Console(silent=True), all_views=True)
    cameras, _ = read_path(path, None, None, task.support, up, tmp_path / "far", Console(silent=True))
    torch.testing.assert_close(cameras.extrinsics, task.support.cameras.extrinsics, atol=1e-3, rtol=0)


def test_train_and_test_files_are_support_and_query(scene, tmp_path):
    scene.write(tmp_path)
    document = scene.document()
    for name, part in (("train", slice(0, 5)), ("test", slice(5, 8))):
        (tmp_path / f"transforms_{name}.json").write_text(json.dumps(document | {"frames": document["frames"][part]}))
    (tmp_path / "transforms.json").unlink()
    task = read_task(tmp_path)
    assert (len(task.support), len(task.query)) == (5, 3)
    assert task.support.bounds == task.query.bounds
    assert len(read_views(tmp_path)) == 8
    assert len(read_views(tmp_path / "transforms_test.json")) == 3
    assert read_task(tmp_path / "transforms_train.json").name == tmp_path.name


@pytest.mark.parametrize("folder", ["./abc", "/data/rgb", "../../rgb"])
def test_an_object_of_learnit_is_read_alone_and_in_its_data_set(scene, tmp_path, folder):
    """As published: cars/abc/transforms.json lists ./abc/000, and its loader takes the last part, next to the file."""
    home = tmp_path / "cars/abc"
    scene.write(home)
    document = scene.document()
    for name, frame in zip(scene.names, document["frames"], strict=True):
        (home / name).rename(home / Path(name).name)
        frame["file_path"] = f"{folder}/{Path(name).stem}"
    (home / "transforms.json").write_text(json.dumps(document))
    (tmp_path / "cars_splits.json").write_text(json.dumps({"train": [], "test": ["abc"]}))
    whole, alone = open_dataset(tmp_path).task("abc"), read_views(home)
    assert torch.allclose(alone.images, scene.over_white(), atol=1e-6)
    assert torch.equal(alone.images, torch.cat([whole.support.images, whole.query.images]))
    assert alone.names == tuple(Path(name).name for name in scene.names)


def test_no_picture_is_in_both_support_and_query(scene, tmp_path):
    """Property: support and query are disjoint, even if the files name one picture in different ways."""
    document, names = scene.document(), scene.names
    lists = {"train_filenames": names[:5], "test_filenames": [f"./{name}" for name in names[4:]]}
    scene.write(tmp_path / "lists", document | lists)
    twice = [frame for frame in document["frames"] for _ in range(2)]
    scene.write(tmp_path / "twice", document | {"frames": twice})
    scene.write(tmp_path / "files")
    (tmp_path / "files/images/link.png").symlink_to("000.png")
    linked = [document["frames"][0] | {"file_path": "images/link.png"}, *document["frames"][6:]]
    for half, frames in (("train", document["frames"][:6]), ("test", linked)):
        (tmp_path / f"files/transforms_{half}.json").write_text(json.dumps(document | {"frames": frames}))
    (tmp_path / "files/transforms.json").unlink()
    for folder, support, query, note in (
        ("lists", names[:5], names[5:], f"1 frame left out, whose images earlier frames list: {names[4]}"),
        ("twice", names[::2], names[1::2], f"8 frames left out, whose images earlier frames list: {', '.join(names)}"),
        ("files", names[:6], names[6:], "1 frame left out, whose images earlier frames list: images/link.png"),
    ):
        task = read_posed_task(tmp_path / folder)
        assert (task.support.names, task.query.names) == (tuple(support), tuple(query))
        assert task.notes == (note,)
    (tmp_path / "files/transforms_test.json").write_text((tmp_path / "files/transforms_train.json").read_text())
    with pytest.raises(DataError, match="found 6 to train and 0 to test on; .* each in only one split"):
        read_task(tmp_path / "files")


def test_views_alternate_without_a_split(scene, tmp_path):
    task = read_task(scene.write(tmp_path))
    assert task.support.names == tuple(scene.names[::2])
    assert task.query.names == tuple(scene.names[1::2])


def test_the_sphere_is_estimated_around_the_hull_of_the_masks(scene, tmp_path):
    """The ball has radius 0.5. Voxels, coarse pictures and the margin enlarge its sphere by less than a half."""
    bounds = read_views(scene.write(tmp_path)).bounds
    assert np.linalg.norm(np.array(bounds.centre) - scene.centre) < 0.1
    assert 0.5 < bounds.radius < 0.75
    photographs = read_views(scene.write(tmp_path / "rgb", mode="RGB"))
    assert photographs.masks is None
    assert np.linalg.norm(photographs.bounds.centre) < 1e-3
    assert abs(photographs.bounds.radius - 3 * np.sin(np.arctan(np.tan(0.4) * 24 / 32))) < 1e-3


def test_masks_beside_photographs(scene, tmp_path):
    from PIL import Image

    document = scene.document()
    for index, frame in enumerate(document["frames"]):
        frame["mask_path"] = f"mask{index}.png"
        Image.fromarray(scene.pictures[index][..., 3]).save(tmp_path / frame["mask_path"])
    views = read_views(scene.write(tmp_path, document, mode="RGB"))
    assert torch.allclose(views.images, scene.over_white(), atol=1e-6)


@pytest.mark.skipif(not CHAIR.is_dir(), reason="the posed chair is not beside this checkout")
def test_the_chair_of_blenders_format():
    task = read_task(CHAIR)
    assert task.name == "chair"
    assert task.support.images.shape == (50, 3, 200, 200)
    assert task.query.images.shape == (25, 3, 200, 200)
    assert abs(float(camera.intrinsics(task.support.cameras)[0, 0, 0]) - 277.7777) < 1e-3
    assert 1.0 < task.support.bounds.radius < 1.5


def test_a_file_of_another_name_defines_the_whole_scene(scene, tmp_path):
    """A file with some of the frames is next to transforms.json, which has all."""
    scene.write(tmp_path)
    document = scene.document()
    document["frames"] = document["frames"][:6:2]
    (tmp_path / "subset.json").write_text(json.dumps(document))
    task = read_task(tmp_path / "subset.json")
    assert task.support.names + task.query.names == (scene.names[0], scene.names[4], scene.names[2])
    assert open_dataset(tmp_path / "subset.json").names() == [tmp_path.name]
    assert len(read_task(tmp_path / "transforms.json").support) == 4
    whole, _ = read_scene(tmp_path / "subset.json", Console(silent=True), all_views=True)
    assert whole.name == task.name == tmp_path.name


def test_a_camera_path_is_in_the_world_of_the_file_if_it_or_its_folder_is_given(scene, tmp_path):
    """nerfstudio's world is that of the file by dataparser_transforms.json, without `applied_transform`."""
    applied = np.eye(4)[[1, 2, 0]]
    scene.write(tmp_path / "app", scene.document(applied_transform=applied.tolist()))
    frames = [{"camera_to_world": scene.opengl(index), "fov": 60.0} for index in range(3)]
    path, transforms = tmp_path / "path.json", tmp_path / "dataparser_transforms.json"
    path.write_text(json.dumps({"render_width": 8, "render_height": 8, "camera_path": frames}))
    transforms.write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 1.0}))
    task, up = read_scene(tmp_path / "app", Console(silent=True), all_views=True)
    found = [
        read_path(path, transforms, None, task.support, up, named, Console(silent=True))[0].extrinsics
        for named in (tmp_path / "app", tmp_path / "app" / "transforms.json")
    ]
    assert torch.equal(*found)
    assert not torch.allclose(found[0], task.support.cameras.extrinsics[:3], atol=0.1)


def test_a_camera_path_is_in_the_world_of_the_poses_of_an_archive(scene, tmp_path):
    """A path with the poses of the pictures has the cameras of the pictures."""
    poses = [scene.opengl(index) for index in range(len(scene.pictures))]
    np.savez(
        tmp_path / "ball.npz", images=np.stack(scene.pictures), cam_poses=np.array(poses), focal=scene.matrix[0, 0]
    )
    frames = [{"camera_to_world": pose, "fov": 60.0} for pose in poses]
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"render_width": 8, "render_height": 8, "camera_path": frames}))
    task, up = read_scene(tmp_path / "ball.npz", Console(silent=True), all_views=True)
    assert task.name == read_task(tmp_path / "ball.npz").name == "ball"
    cameras, _ = read_path(path, None, None, task.support, up, tmp_path / "ball.npz", Console(silent=True))
    torch.testing.assert_close(cameras.extrinsics, task.support.cameras.extrinsics, atol=1e-5, rtol=0)


def test_any_error_of_a_reader_is_one_line(tmp_path, monkeypatch):
    def stumble(*_):
        raise KeyError("viewpoint")

    monkeypatch.setattr("hyperplanes.data.formats.recognise.read_posed_task", stumble)
    with pytest.raises(DataError, match="expected posed images of one scene, found"):
        read_scene(tmp_path, Console(silent=True))


@pytest.mark.parametrize("separate", [False, True])
def test_a_background_that_is_hardly_opaque_is_transparent(scene, tmp_path, separate):
    """Images, masks and bounds are those of the same scene with a background of opacity 0 instead of 1 / 255."""
    clear = read_views(scene.write(tmp_path / "clear"))
    hazy = type(scene)()
    for picture in hazy.pictures:
        picture[picture[..., 3] == 0] = 0, 0, 0, 1
    home = hazy.write(tmp_path / "hazy")
    if separate:
        (home / "masks").mkdir()
        for name, picture in zip(hazy.names, hazy.pictures, strict=True):
            Image.fromarray(picture[..., 3]).save(home / "masks" / Path(name).name)
            Image.fromarray(picture[..., :3]).save(home / name)
    found = read_views(home)
    assert torch.equal(found.masks, clear.masks)
    assert torch.equal(found.images, clear.images)
    assert found.bounds == clear.bounds
