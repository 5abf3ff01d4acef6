"""Source of truth: the original pictures and rig, and the loaders of other projects in a few lines each."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from data_gen import rigs
from data_gen.datasets.layouts import LAYOUTS, RenderedObject, over_white
from data_gen.datasets.sources import Item
from data_gen.rigs import fixed
from hyperplanes.cli import main
from hyperplanes.data import mesh_path, open_dataset, read_channel, read_task, read_views
from hyperplanes.data.dataset import open_datasets
from hyperplanes.data.formats.collections.npz import catalogue
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.reading import DataError

VIEWS = 6
ITEMS = [
    Item("car_00000", "car", "train", seed=1),
    Item("car_00001", "car", "train", seed=2),
    Item("car_test_00000", "car", "test", seed=3),
]


def rendered(layout, item, **more):
    style = LAYOUTS[layout]
    size = style.resolution or 20
    rig = rigs.random(
        VIEWS, size, seed=item.seed, distance=style.distance(item.class_name), field_of_view=style.field_of_view
    )
    rgba = np.random.default_rng(item.seed).integers(0, 256, (VIEWS, size, size, 4), dtype=np.uint8)
    rgba[..., 3] = np.where(rgba[..., 3] < 128, 0, rgba[..., 3])
    rgba[:, [0, -1]] = rgba[:, :, [0, -1]] = 0
    return RenderedObject(item, rig, rgba, **more)


def write(layout, folder, manifest=True):
    objects = [rendered(layout, item) for item in ITEMS]
    files = LAYOUTS[layout].splits(ITEMS)
    for one in objects:
        files |= LAYOUTS[layout].files(one)
    if manifest:
        files["manifest.json"] = json.dumps(
            {
                "format": "hyperplanes-dataset",
                "version": 1,
                "layout": layout,
                "scene_sphere": {"centre": [0, 0, 0], "radius": LAYOUTS[layout].scale},
                "objects": {item.name: {"class": item.class_name} for item in ITEMS},
                "splits": {
                    split: [item.name for item in ITEMS if item.split == split] for split in ("train", "val", "test")
                },
            }
        ).encode()
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return objects


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_round_trip_gives_the_same_pixels_and_the_same_rays(layout, tmp_path):
    objects = write(layout, tmp_path)
    data = open_dataset(tmp_path)
    assert data.layout == layout
    assert [len(data.names(split)) for split in ("train", "val", "test")] == [2, 0, 1]
    for name, original in zip(data.names(), objects, strict=True):
        task = data.task(name)
        for views, part in ((task.support, slice(0, None, 2)), (task.query, slice(1, None, 2))):
            alpha = original.rgba[part, ..., 3:].astype(np.float32) / 255
            white = original.rgba[part, ..., :3] / np.float32(255) * alpha + 1 - alpha
            exact = layout != "srn"  # SRN's pictures have no alpha; over white they are rounded
            tolerance = 1e-6 if exact else 0.5 / 255 + 1e-6
            assert np.abs(views.images.permute(0, 2, 3, 1).numpy() - white).max() <= tolerance
            if exact:
                assert np.abs(views.masks[:, 0].numpy() - alpha[..., 0]).max() < 1e-6
            wanted = camera.select(original.rig.cameras(), part)
            scale = LAYOUTS[layout].scale
            assert views.bounds == Sphere((0.0, 0.0, 0.0), scale)
            assert torch.allclose(camera.intrinsics(views.cameras).double(), camera.intrinsics(wanted), atol=2e-5)
            assert torch.allclose(camera.centres(views.cameras).double() / scale, camera.centres(wanted), atol=1e-5)
            turned = camera.camera_from_world(views.cameras)[:, :3, :3].double()
            assert torch.allclose(turned, camera.camera_from_world(wanted)[:, :3, :3], atol=1e-6)


def test_the_loader_of_learnit_reads_its_layout(tmp_path):
    """As in the code of the learned initialisations: base name of file_path + .png, angle, OpenGL poses."""
    original = write("learnit-128", tmp_path)[0]
    splits = json.loads((tmp_path / "car_splits.json").read_text())
    assert splits == {"train": ["car_00000", "car_00001"], "val": [], "test": ["car_test_00000"]}
    folder = tmp_path / "cars" / splits["train"][0]
    document = json.loads((folder / "transforms.json").read_text())
    for index, frame in enumerate(document["frames"]):
        picture = folder / (frame["file_path"].split("/")[-1] + ".png")
        assert np.array_equal(np.array(Image.open(picture)), original.rgba[index])
        pose = np.array(frame["transform_matrix"])
        assert np.allclose(pose[:3, 3], original.rig.world_from_camera[index, :3, 3])
        assert np.allclose(-pose[:3, 2], original.rig.world_from_camera[index, :3, 2]), "OpenGL looks along -z"
    focal = 0.5 * 20 / np.tan(0.5 * document["camera_angle_x"])
    assert np.isclose(focal, original.rig.intrinsics[0, 0, 0])
    assert 2.0 < original.rig.near < original.rig.far < 6.0


def test_the_loader_of_the_authors_reads_its_layout(tmp_path):
    """As in the code of the HyperPlanes authors: floats in [0, 1], cam_poses, 277.77 pixels, name after the last _."""
    original = write("hyperplanes-200", tmp_path)[2]
    path = sorted((tmp_path / "cars/sampled").glob("*.npz"))[-1]
    assert path.name == f"{VIEWS}_car-test-00000.npz"
    with np.load(path, allow_pickle=False) as arrays:
        assert arrays["images"].shape == (VIEWS, 200, 200, 3)
        assert arrays["images"].dtype == np.float32
        assert np.array_equal(np.rint(arrays["images"] * 255), over_white(original.rgba))
        assert arrays["cam_poses"].shape == (VIEWS, 4, 4)
    assert abs(original.rig.intrinsics[0, 0, 0] - 277.77) < 1e-9
    data = open_dataset(tmp_path)  # the manifest has names with underscores
    assert {data.class_of(name) for name in data.names()} == {"car"}
    assert data.skipped == ()
    path.unlink()
    lines = open_dataset(tmp_path).skipped
    assert lines == (f"{tmp_path}/manifest.json: skipped 1 of 1 objects of test without an archive, as car-test-00000",)
    assert 2.0 < original.rig.near < original.rig.far < 6.0


def test_files_of_the_authors_are_read_without_the_additions_of_the_generator(tmp_path):
    original = write("hyperplanes-200", tmp_path, manifest=False)[0]
    for path in (tmp_path / "cars/sampled").iterdir():
        with np.load(path) as arrays:
            kept = {"images": arrays["images"], "poses": arrays["cam_poses"], "data": np.zeros((10, 6))}
        np.savez(path, **kept)
    data = open_dataset(tmp_path)
    assert (data.names("train"), data.names("test")) == (["car-00000", "car-00001"], ["car-test-00000"])
    views = data.task("car-00000").support
    assert views.masks is None
    assert camera.intrinsics(views.cameras)[0].tolist() == [
        [pytest.approx(277.77), 0.0, 99.5],
        [0.0, pytest.approx(277.77), 99.5],
        [0.0, 0.0, 1.0],
    ]
    legacy = catalogue(tmp_path, {}, legacy=True).read("car-00000").support
    assert camera.intrinsics(legacy.cameras)[0, :2, 2].tolist() == [100.0, 100.0]
    centres = original.rig.world_from_camera[:, :3, 3]  # the first half, as in the authors' code
    assert np.allclose(camera.centres(views.cameras), centres[: VIEWS // 2], atol=1e-5)
    opened = open_dataset(tmp_path, legacy=True).task("car-00000").query
    assert camera.intrinsics(opened.cameras)[0, :2, 2].tolist() == [100.0, 100.0]
    assert np.allclose(camera.centres(opened.cameras), centres[VIEWS // 2 :], atol=1e-5)
    assert len(read_views(next((tmp_path / "cars/sampled").iterdir()))) == VIEWS


def test_files_of_learnit_are_split_as_in_its_notebook_and_missing_objects_are_counted(tmp_path, capsys):
    original = write("learnit-128", tmp_path, manifest=False)[0]
    shutil.rmtree(tmp_path / "cars" / "car_00001")
    data = open_dataset(tmp_path)
    assert (data.names("train"), data.names("test")) == (["car_00000"], ["car_test_00000"])
    assert data.skipped == (
        f"{tmp_path / 'car_splits.json'}: skipped 1 of 2 objects of train without a folder, as car_00001",
    )
    for legacy, centre in ((False, 9.5), (True, 10.0)):  # 20 pixels: W / 2 at integer pixel centres, or the middle
        task = open_datasets([tmp_path], legacy=legacy).task("car_00000")
        for views, part in ((task.support, slice(0, VIEWS // 2)), (task.query, slice(VIEWS // 2, None))):
            assert np.allclose(camera.centres(views.cameras), original.rig.world_from_camera[part, :3, 3], atol=1e-5)
            assert camera.intrinsics(views.cameras)[0, :2, 2].tolist() == pytest.approx([centre, centre])
    assert main(["evaluate", "--method", "nearest_view", "--data", str(tmp_path), "--legacy"]) == 0
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == data.skipped[0]
    shutil.rmtree(tmp_path / "cars")
    with pytest.raises(DataError, match="expected the objects that its splits name, found none of their folders"):
        open_dataset(tmp_path)


def test_the_loader_of_srn_reads_its_layout(tmp_path):
    """As in pixelNeRF's code: first line f cx cy, last line height width, poses OpenCV camera-to-world."""
    original = write("srn", tmp_path)[2]
    folder = tmp_path / "cars_test/car_test_00000"
    lines = (folder / "intrinsics.txt").read_text().splitlines()
    focal, x, y, _ = map(float, lines[0].split())
    assert np.allclose([focal, x, y], [original.rig.intrinsics[0, 0, 0], 10.0, 10.0])
    assert lines[-1] == "20 20"
    pose = np.loadtxt(folder / "pose/000002.txt").reshape(4, 4)
    assert np.allclose(pose[:3, :3], original.rig.world_from_camera[2, :3, :3])
    assert np.allclose(pose[:3, 3], original.rig.world_from_camera[2, :3, 3] / 2)
    assert original.rig.near / 2 >= 0.8 - 1e-9
    assert original.rig.far / 2 <= 1.8 + 1e-9
    assert len(read_task(folder).support) == 3
    assert open_dataset(tmp_path / "cars_test").names("test") == ["car_test_00000"]


@pytest.mark.parametrize(("class_name", "near", "far"), [("car", 0.8, 1.8), ("chair", 1.25, 2.75), ("lamp", 0.8, 1.8)])
def test_objects_in_the_layout_of_srn_lie_between_near_and_far_of_pixel_nerf(class_name, near, far):
    """Its loader has z_near, z_far = 1.25, 2.75 if "chair" is in the path of the data set, else 0.8, 1.8."""
    rig = rendered("srn", Item("a", class_name, "train", seed=1)).rig
    depths = np.linalg.norm(rig.world_from_camera[:, :3, 3], axis=1) * LAYOUTS["srn"].scale
    assert (depths - 0.5 >= near - 1e-9).all()
    assert (depths + 0.5 <= far + 1e-9).all()


@pytest.mark.parametrize(
    ("changes", "layouts"),
    [
        ({(0, 0): 1.1}, ("srn", "learnit-128", "hyperplanes-200")),
        ({(0, 2): 1.2}, ("learnit-128", "hyperplanes-200")),
    ],
)
def test_lenses_that_a_layout_cannot_describe_are_refused(changes, layouts):
    for layout in layouts:
        one = rendered(layout, ITEMS[0])
        lens = one.rig.intrinsics.copy()
        for (row, column), factor in changes.items():
            lens[:, row, column] *= factor
        with pytest.raises(ValueError, match=f"layout {layout}: expected .*; take the native layout"):
            LAYOUTS[layout].files(replace(one, rig=replace(one.rig, intrinsics=lens)))
        lens = one.rig.intrinsics.copy()
        lens[1:, :2, :2] *= 1.5
        with pytest.raises(ValueError, match="for both axes and all views"):
            LAYOUTS[layout].files(replace(one, rig=replace(one.rig, intrinsics=lens)))


def test_other_channels_are_read_back_exactly(tmp_path):
    random = np.random.default_rng(0)
    channels = {
        "depth": random.random((VIEWS, 20, 20), dtype=np.float32),
        "normals": random.random((VIEWS, 20, 20, 3), dtype=np.float32),
    }
    for name, data in LAYOUTS["native"].files(rendered("native", ITEMS[0], channels=channels, model=b"glTF")).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    for channel, values in channels.items():
        assert np.array_equal(read_channel(tmp_path / "car_00000", channel).numpy(), values)
    assert mesh_path(tmp_path / "car_00000").read_bytes() == b"glTF"


def test_a_native_object_is_a_nerfstudio_scene(tmp_path):
    original = write("native", tmp_path)[0]
    document = json.loads((tmp_path / "car_00000/transforms.json").read_text())
    assert (document["camera_model"], document["w"], document["h"]) == ("OPENCV", 20, 20)
    assert (document["cx"], document["cy"]) == (10.0, 10.0)
    assert document["train_filenames"] == [f"images/{index:03d}.png" for index in (0, 2, 4)]
    assert (document["near"], document["far"]) == (2.0, 4.0)
    assert np.isclose(document["fl_x"], fixed(2, 20).intrinsics[0, 0, 0])
    assert np.allclose(
        np.array(document["frames"][1]["transform_matrix"])[:3, 3], original.rig.world_from_camera[1, :3, 3]
    )
