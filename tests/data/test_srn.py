"""Source of truth: the ball of conftest, in the layout of SRN's data."""

import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.data import DataError, open_dataset, read_views
from hyperplanes.geometry import cameras as camera


def write(scene, folder, white=True):
    for name in ("rgb", "pose"):
        (folder / name).mkdir(parents=True)
    height, width = scene.size
    focal = scene.matrix[0, 0]
    (folder / "intrinsics.txt").write_text(f"{focal} {width / 2} {height / 2} 0.\n0. 0. 0.\n1.\n1.\n{height} {width}\n")
    for index, picture in enumerate(scene.pictures):
        background = 255 if white else 90
        rgb = np.where(picture[..., 3:] > 0, picture[..., :3], background).astype(np.uint8)
        Image.fromarray(rgb).save(folder / f"rgb/{index:06d}.png")
        pose = np.linalg.inv(scene.camera_from_world[index])
        (folder / f"pose/{index:06d}.txt").write_text(" ".join(map(str, pose.ravel())))
    return folder


def test_pictures_poses_and_calibration(scene, tmp_path):
    views = read_views(write(scene, tmp_path))
    assert torch.allclose(views.images, scene.over_white(), atol=1e-6)
    assert torch.equal(views.masks[:, 0] > 0, torch.from_numpy(np.stack(scene.pictures)[..., 3] > 0))
    pose = torch.from_numpy(scene.camera_from_world).float()
    assert torch.allclose(camera.camera_from_world(views.cameras), pose, atol=1e-5)
    wanted = torch.from_numpy(scene.matrix).float().expand(8, 3, 3)
    assert torch.allclose(camera.intrinsics(views.cameras), wanted, atol=1e-4)


def test_without_a_white_background_there_are_no_masks(scene, tmp_path):
    assert read_views(write(scene, tmp_path, white=False)).masks is None


def test_splits_are_the_names_of_the_folders(scene, tmp_path):
    for home in ("cars_train/a", "cars_train/b", "cars_val/c", "cars_test/d"):
        write(scene, tmp_path / home)
    data = open_dataset(tmp_path)
    assert data.layout == "srn"
    assert [data.names(split) for split in ("train", "val", "test")] == [["a", "b"], ["c"], ["d"]]
    assert len(data.task("c").support) == 4
    assert open_dataset(tmp_path / "cars_train").names("train") == ["a", "b"]


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("pose/000003.txt", "1 2 3", r"000003\.txt: expected 16 finite numbers, found 3"),
        ("pose/000003.txt", "a b", "expected 16 finite numbers, found something else: ValueError .could not convert"),
        ("pose/000003.txt", " ".join(["2"] * 16), "expected a rotation"),
        ("intrinsics.txt", "", "intrinsics.txt: expected f cx cy first"),
        ("intrinsics.txt", "-1 2 3\n4 5", "expected finite and positive numbers"),
    ],
)
def test_wrong_files_are_named(scene, tmp_path, name, text, match):
    (write(scene, tmp_path) / name).write_text(text)
    with pytest.raises(DataError, match=match):
        read_views(tmp_path)


def test_a_missing_pose_is_named(scene, tmp_path):
    (write(scene, tmp_path) / "pose/000002.txt").unlink()
    with pytest.raises(DataError, match=r"000002\.txt: expected 16 finite numbers, found nothing"):
        read_views(tmp_path)
