"""Source of truth: files damaged on purpose. A message has the file, what was expected and found, and a remedy."""

import json
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from hyperplanes.data import DataError, Dataset, open_dataset, read_channel, read_task, read_views
from hyperplanes.data.formats.collections.npz import read_npz
from hyperplanes.utilities.files.reading import DATA_SET


def refused(action, *argument, match):
    with pytest.raises(DataError, match=match) as caught:
        action(*argument)
    text = str(caught.value)
    assert "\n" not in text
    assert ": expected " in text
    assert ", found " in text
    assert "; " in text


def test_missing_and_empty_folders(tmp_path):
    for action in (read_views, read_task, open_dataset):
        refused(action, tmp_path / "absent", match="absent: expected .* found nothing; check the path")
        refused(action, tmp_path, match="(an empty folder|neither)")
        refused(action, "example-cars", match=r"found nothing; did you mean example-car\?$")
    (tmp_path / "notes.txt").write_text("none of these")
    refused(open_dataset, tmp_path / "notes.txt", match=r"notes.txt: expected the folder of a data set, found a file")


def test_a_single_view_cannot_be_held_out(scene, tmp_path):
    one = type(scene)(views=1).write(tmp_path)
    refused(read_task, one, match="expected two views or more, found 1; add views, or use `render --all-views`")
    assert len(read_views(one)) == 1


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{not json", r"transforms\.json: expected valid JSON, found Expecting property name"),
        ("[1, 2]", "expected a JSON object, found a list"),
        ("{}", "expected frames, a list of one or more objects, found None"),
        ('{"frames": []}', "found 0 of them"),
        ('{"frames": [{"file_path": 3}]}', "expected a file_path in every frame, found 3"),
        ("[" * 100000, "transforms.json: expected valid JSON"),
        ("\udcff", "expected valid JSON"),
    ],
)
def test_malformed_json(tmp_path, text, match):
    (tmp_path / "transforms.json").write_bytes(text.encode(errors="surrogateescape"))
    refused(read_views, tmp_path, match=match)


def test_a_truncated_picture(scene, tmp_path):
    path = scene.write(tmp_path) / scene.names[3]
    whole = path.read_bytes()
    for length in (0, 4, 20, 40, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:length])
        refused(read_views, tmp_path, match=r"003\.png: expected (an image|a whole image), found")


def test_missing_pictures(scene, tmp_path):
    scene.write(tmp_path)
    for name in scene.names[2:5]:
        (tmp_path / name).unlink()
    refused(read_views, tmp_path, match=r"at least two thirds of its 8 frames, found 5 \(.*002\.png and 2 others")


def test_a_missing_picture_of_a_generated_object(scene, tmp_path):
    manifest = {"format": DATA_SET, "version": 1, "splits": {"train": ["a"]}}
    (scene.write(tmp_path / "a") / scene.names[2]).unlink()
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    refused(Dataset(tmp_path).task, "a", match=r"002\.png: expected an image, found nothing; generate or copy")


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@pytest.mark.parametrize(("side", "found"), [(200_000, "more"), (10_000, "10000 x 10000")])
def test_an_absurd_size_is_refused_before_decoding(scene, tmp_path, side, found):
    header = struct.pack(">IIBBBBB", side, side, 8, 6, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100)))
    (scene.write(tmp_path) / scene.names[0]).write_bytes(bomb)
    refused(read_views, tmp_path, match=rf"000\.png: expected at most 64000000 pixels, found {found}; scale it down")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda pose: (np.array(pose) * 2).tolist(), r"frame images/004\.png: expected a rotation"),
        (lambda pose: (np.array(pose) * [-1, 1, 1, 1]).tolist(), "expected a rotation .* determinant -1"),
        (lambda pose: [[float("nan")] * 4] * 4, "expected a pose of finite numbers, found NaN"),
        (lambda pose: pose[:2], r"expected a 4 x 4 pose, found shape \(2, 4\)"),
        (lambda pose: "here", "expected a 4 x 4 pose of numbers"),
        (lambda pose: None, "expected a 4 x 4 pose"),
    ],
)
def test_an_invalid_pose(scene, tmp_path, change, match):
    document = scene.document()
    frame = document["frames"][4]
    frame["transform_matrix"] = change(frame["transform_matrix"])
    refused(read_views, scene.write(tmp_path, document), match=match)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"camera_angle_x": None}, "expected a finite number as camera_angle_x, found None"),
        ({"camera_angle_x": 40.0}, "expected camera_angle_x in radians between 0 and pi, found 40"),
        ({"fl_x": -3.0}, "expected positive focal lengths, found -3, -3"),
        ({"fl_x": float("inf")}, "expected a finite number as fl_x, found inf"),
        ({"fl_x": 10.0, "w": 0}, "expected positive w and h, found 0 x 24"),
        ({"fl_x": 10.0, "k1": "0.1"}, "expected a finite number as k1, found '0.1'"),
        ({"camera_model": "EQUIRECTANGULAR"}, "expected a perspective camera_model, found 'EQUIRECTANGULAR'"),
        ({"scene_sphere": {"centre": [0, 0, 0]}}, "expected scene_sphere with centre and radius"),
        ({"scene_sphere": {"centre": [0, 0, 0], "radius": -1}}, "radius > 0"),
        ({"train_filenames": ["a"], "test_filenames": ["b"]}, "expected a frame for 'a' .* found none"),
        ({"train_filenames": ["a"], "test_filenames": [1]}, "expected names of files in train_filenames"),
    ],
)
def test_an_invalid_calibration(scene, tmp_path, fields, match):
    refused(read_task, scene.write(tmp_path, scene.document(**fields)), match=match)


def test_no_calibration_at_all(scene, tmp_path):
    document = scene.document()
    del document["camera_angle_x"]
    refused(read_views, scene.write(tmp_path, document), match="expected fl_x or camera_angle_x, found only file_path")


@pytest.mark.parametrize("name", ["../secret.png", "/etc/passwd", "images/../../secret.png", "..\\secret.png", "a\0b"])
def test_paths_that_leave_the_folder_are_refused(scene, tmp_path, name):
    Image.new("RGBA", (32, 24)).save(tmp_path / "secret.png")
    document = scene.document()
    document["frames"][0]["file_path"] = name
    refused(read_views, scene.write(tmp_path / "scene", document), match="expected file names inside .* found")


def test_a_link_that_leaves_the_folder_is_refused(scene, tmp_path):
    Image.new("RGBA", (32, 24)).save(tmp_path / "secret.png")
    folder = scene.write(tmp_path / "scene")
    (folder / scene.names[0]).unlink()
    (folder / scene.names[0]).symlink_to(tmp_path / "secret.png")
    refused(read_views, folder, match="expected file names inside")


def test_manifests(scene, tmp_path):
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps({"format": DATA_SET, "version": 9}))
    refused(Dataset, tmp_path, match="expected version 1, found 9")
    path.write_text(json.dumps({"format": DATA_SET, "version": 1, "splits": {"train": ["../x"]}}))
    refused(Dataset, tmp_path, match=r"expected plain names in splits\.train")
    path.write_text(json.dumps({"format": DATA_SET, "version": 1, "splits": {"train": ["a"]}}))
    refused(Dataset(tmp_path).task, "b", match=r"expected one of its 1 objects \(a\), found 'b'")
    refused(Dataset(tmp_path).task, "a", match="expected transforms.json or transforms_train.json, found neither")


def test_archives(tmp_path):
    path = tmp_path / "50_car.npz"
    refused(read_npz, path, match="expected an .npz file, found nothing")
    path.write_bytes(b"PK\x03\x04 and no more")
    refused(read_npz, path, match="expected an .npz file of plain arrays")
    np.savez(path, images=np.array([{"a": 1}], dtype=object), cam_poses=np.eye(4)[None])
    refused(read_npz, path, match="allow_pickle=False")
    np.savez(path, images=np.zeros((2, 8, 8, 3)), cam_poses=np.eye(4)[None])
    refused(read_npz, path, match=r"expected images \(view, height, width, 3 or 4\), a pose each")
    np.savez(path, images=np.full((1, 8, 8, 3), 7.0), cam_poses=np.eye(4)[None])
    refused(read_npz, path, match=r"expected floating-point images in \[0, 1\], found 7 to 7")
    np.savez(path, images=np.full((1, 8, 8, 3), np.nan), cam_poses=np.eye(4)[None])
    refused(read_npz, path, match="finite floats")
    np.savez(path, images=np.zeros((1, 8, 8, 3)))
    refused(read_npz, path, match="expected arrays images and cam_poses, found images")


def test_archives_of_one_name_are_refused_and_those_of_no_split_are_named(tmp_path):
    """The authors take the first 80 % of the sorted names to train on and the last 20 % to test."""
    home = tmp_path / "cars" / "sampled"
    home.mkdir(parents=True)
    for name in "abcdefg":
        np.savez(home / f"8_{name}.npz", images=np.zeros((8, 8, 8, 3)), cam_poses=np.stack([np.eye(4)] * 8), focal=8.0)
    data = open_dataset(tmp_path)
    assert (data.names("train"), data.names("test")) == (list("abcde"), ["g"])
    assert "skipped f, neither of the first 80 % nor of the last 20 %" in data.skipped[0]
    other = tmp_path / "chairs" / "sampled"
    other.mkdir(parents=True)
    (home / "8_a.npz").rename(other / "8_b.npz")
    refused(open_dataset, tmp_path, match="8_b.npz: expected a name that no other object has")
    with pytest.raises(DataError, match="expected a downscale from 1 to 8, found 0"):
        read_views(other / "8_b.npz", downscale=0)


def test_missing_channels(tmp_path):
    refused(read_channel, tmp_path, "depth", match=r"depth\.npz: expected the depth of the object, found nothing")
    np.savez(tmp_path / "depth.npz", depth=np.zeros((2, 3)))
    refused(read_channel, tmp_path, "depth", match=r"found float64 \(2, 3\)")
    with pytest.raises(ValueError, match="channel: expected one of depth, normals, coordinates, got 'flow'"):
        read_channel(tmp_path, "flow")
