"""NMR, CO3D, Objaverse and OmniObject3D, written here as their authors describe them.

Source of truth: pixels of known points by hand, as in test_formats; axes and units as pixelNeRF's loader (NMR), CO3D's
data_types.py and Implicitron, Zero-1-to-3's Blender script and OmniObject3D's loader state them.
"""

import gzip
import json

import numpy as np
import pytest
import torch
from PIL import Image
from test_formats import FOCAL, HEIGHT, VIEWS, WIDTH, are_graded, expected, eyes_and_axes, found, graded_masks, pictures

from hyperplanes.data import DataError, open_dataset, read_views


def poses():
    """Matrices camera_from_world (3, 4) with OpenCV axes."""
    for eye, right, down, forward in eyes_and_axes():
        rotation = np.stack([right, down, forward])
        yield np.concatenate([rotation, -rotation @ eye[:, None]], 1)


def nmr(folder):
    arrays = {}
    for index, pose in enumerate(poses()):
        arrays[f"world_mat_{index}"] = np.vstack([pose, [0, 0, 0, 1]])
        arrays[f"camera_mat_{index}"] = np.diag([FOCAL / (WIDTH / 2), FOCAL / (HEIGHT / 2), 1, 1])
    pictures(folder / "image", [f"{index:04d}.png" for index in range(VIEWS)])
    graded_masks(folder / "mask", [f"{index:04d}.png" for index in range(VIEWS)])
    np.savez(folder / "cameras.npz", **arrays)


def test_nmr(tmp_path):
    for name in "abc":
        nmr(tmp_path / "02958343" / name)
    (tmp_path / "02958343/softras_train.lst").write_text("a\nb\nlost\n")
    (tmp_path / "02958343/softras_test.lst").write_text("c\n")
    data = open_dataset(tmp_path)
    assert (data.names("train"), data.names("test"), data.class_of("a")) == (["a", "b"], ["c"], "02958343")
    assert "skipped 1 of 3 objects" in data.skipped[0]
    views = read_views(tmp_path / "02958343/a")
    np.testing.assert_allclose(found(views), expected(), atol=1e-3)
    assert are_graded(views.masks)
    assert len(data.task("c").support) == 3
    (tmp_path / "02958343/softras_test.lst").write_text("../a\n")
    with pytest.raises(DataError, match="softras_test.lst: expected a plain name"):
        open_dataset(tmp_path)


@pytest.mark.parametrize("kind", ["ndc_isotropic", "ndc_norm_image_bounds"])
def test_co3d(tmp_path, kind):
    """By hand: PyTorch3D has x left and y up, the -x and -y of OpenCV, and multiplies row vectors, x_world R."""
    flip = np.diag([-1.0, -1.0, 1.0])
    unit = np.array([HEIGHT / 2] * 2 if kind == "ndc_isotropic" else [WIDTH / 2, HEIGHT / 2])
    frames = []
    for name in ("110_1_2", "111_3_4"):
        for index, pose in enumerate(poses()):
            ends = {"images": "jpg", "masks": "png"}
            paths = {part: f"car/{name}/{part}/frame{index:06d}.{end}" for part, end in ends.items()}
            view = {
                "R": (flip @ pose[:, :3]).T.tolist(),
                "T": (flip @ pose[:, 3]).tolist(),
                "focal_length": (FOCAL / unit).tolist(),
                "principal_point": ((np.array([WIDTH / 2, HEIGHT / 2]) - [14.5, 9.5]) / unit).tolist(),
                "intrinsics_format": kind,
            }
            image, mask = {"path": paths["images"], "size": [HEIGHT, WIDTH]}, {"path": paths["masks"]}
            frames.append(
                {"sequence_name": name, "frame_number": index, "image": image, "mask": mask, "viewpoint": view}
            )
        pictures(tmp_path / f"car/{name}/images", [f"frame{index:06d}.jpg" for index in range(VIEWS)])
        pictures(tmp_path / f"car/{name}/masks", [f"frame{index:06d}.png" for index in range(VIEWS)])
    with gzip.open(tmp_path / "car/frame_annotations.jgz", "wt") as file:
        json.dump(frames[::-1], file)
    (tmp_path / "car/set_lists").mkdir()
    lists = {"train": [["110_1_2", 0, "x"]], "val": [["110_1_2", 1, "x"]], "test": [["111_3_4", 0, "x"]]}
    (tmp_path / "car/set_lists/set_lists_fewview_dev.json").write_text(json.dumps(lists))
    data = open_dataset(tmp_path)
    assert (data.names("train"), data.names("test"), data.class_of("110_1_2")) == (["110_1_2"], ["111_3_4"], "car")
    views = read_views(tmp_path / "car/110_1_2")
    np.testing.assert_allclose(found(views), expected((14.0, 9.0)), atol=1e-3)
    assert views.masks is not None
    assert views.names[1] == "images/frame000001.jpg"
    (tmp_path / "car/frame_annotations.jgz").rename(tmp_path / "elsewhere.jgz")
    (tmp_path / "car/frame_annotations.jgz").symlink_to(tmp_path / "elsewhere.jgz")
    with pytest.raises(DataError, match=r"frame_annotations.jgz: expected a file inside .*a symbolic link to"):
        read_views(tmp_path / "car/110_1_2")
    (tmp_path / "car/frame_annotations.jgz").unlink()
    (tmp_path / "car/frame_annotations.jgz").write_bytes(b"no gzip")
    with pytest.raises(DataError, match="frame_annotations.jgz: expected a list of frames, compressed by gzip"):
        open_dataset(tmp_path / "car")


def test_objaverse(tmp_path):
    """By hand: a focal length of 35 mm on 32 mm is 35 / 32 of the width; points are at the pixels of that lens."""
    for name in "ab":
        pictures(tmp_path / name, [f"{index:03d}.png" for index in range(VIEWS)], "RGBA")
        for index, pose in enumerate(poses()):
            np.save(tmp_path / name / f"{index:03d}.npy", np.diag([1.0, -1.0, -1.0]) @ pose)
    assert open_dataset(tmp_path).names("test") == ["a", "b"]
    (tmp_path / "valid_paths.json").write_text(json.dumps(["a", "b", "lost"]))
    data = open_dataset(tmp_path)
    assert (data.names("train"), data.names("test")) == (["a", "b"], [])
    assert "skipped 1 of 3" in data.skipped[0]
    views = read_views(tmp_path / "a")
    middle = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    np.testing.assert_allclose((found(views) - middle) / (WIDTH * 35 / 32), (expected() - middle) / FOCAL, atol=1e-5)
    assert views.bounds.radius == pytest.approx(0.75**0.5)
    (tmp_path / "a/003.npy").unlink()
    with pytest.raises(DataError, match=r"003\.npy: expected the camera of 003.png, found nothing"):
        read_views(tmp_path / "a")


def test_omniobject3d(tmp_path):
    for number in range(1, 6):
        home = tmp_path / f"blender_renders/apple/apple_{number:03d}/render"
        (home / "images").mkdir(parents=True)
        frames = []
        for index, (eye, right, down, forward) in enumerate(eyes_and_axes()):
            picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
            picture[5:9, 10:20, index % 3] = 80
            Image.fromarray(picture).save(home / f"images/r_{index}.png")
            matrix = np.vstack([np.stack([right, -down, -forward, eye], 1), [0, 0, 0, 1]])
            frames.append({"file_path": f"r_{index}", "transform_matrix": matrix.tolist(), "scale": 0.1})
        document = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL), "frames": frames}
        (home / "transforms.json").write_text(json.dumps(document))
    for place in (tmp_path, tmp_path / "blender_renders", tmp_path / "blender_renders/apple"):
        data = open_dataset(place)
        assert data.names("test") == ["apple_001", "apple_002", "apple_003"]
        assert data.names("train") == ["apple_004", "apple_005"]
        assert data.class_of("apple_001") == "apple"
    views = read_views(tmp_path / "blender_renders/apple/apple_001")
    assert views.names[1] == "render/images/r_1.png"
    np.testing.assert_allclose(found(views), expected(), atol=1e-3)
    assert views.masks is not None
    assert views.masks.sum((1, 2, 3)).tolist() == [40.0] * VIEWS
    assert torch.equal(views.images[:, :, 0], torch.ones_like(views.images[:, :, 0]))
