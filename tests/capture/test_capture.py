"""Source of truth: the poses, lens and masks of simulated photographs (`benchmarks.parts.staged_photographs`)."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from benchmarks.captures import compare_poses
from benchmarks.parts.staged_photographs import stage, walk_around
from hyperplanes.capture.masks import consistency
from hyperplanes.capture.packages import is_installed
from hyperplanes.capture.scene import straightened

needs_pycolmap = pytest.mark.skipif(not is_installed("pycolmap"), reason="needs pycolmap, of the extra photos")
VIEWS = 9


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """Use hulls with fewer voxels to compare masks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(consistency, "COARSE_SIDE", 40)
        patch.setattr(consistency, "FINE_SIDE", 60)
        yield


@pytest.fixture(scope="module")
def staged():
    poses = walk_around(36, 3, heights=(30.0,))[:VIEWS]
    return stage(poses, (180, 240), seed=3, samples=1, lens=(-0.06, 0.01))


@pytest.fixture(scope="module")
def scene(staged, tmp_path_factory):
    """The result of capture for photographs with a folder of masks."""
    from hyperplanes.capture import capture

    folder = tmp_path_factory.mktemp("capture")
    staged.save(folder / "photos")
    (folder / "photos" / "masks").mkdir()
    for index, mask in enumerate(staged.masks):
        Image.fromarray(mask).save(folder / "photos" / "masks" / f"photo_{index:03d}.png")
    (folder / "photos" / "photo_100.jpg").write_bytes(b"broken")
    shown = []
    captured = capture(
        folder / "photos", folder / "scene", progress=lambda stage, done, total, text: shown.append((stage, done, text))
    )
    return captured, shown


@needs_pycolmap
def test_the_estimated_poses_agree_with_the_true_ones(staged, scene):
    captured, _ = scene
    document = json.loads((captured.folder / "transforms.json").read_text())
    assert [frame["file_path"] for frame in document["frames"]] == [f"images/photo_{i:03d}.jpg" for i in range(VIEWS)]
    found = np.array([frame["transform_matrix"] for frame in document["frames"]]) * [1, -1, -1, 1]
    errors = compare_poses(found, staged.world_from_camera)
    assert errors.degrees.max() < 1.0
    assert errors.percent.max() < 2.0
    assert document["fl_x"] == pytest.approx(staged.calibration[0, 0], rel=0.05)
    assert captured.error < 1.0


@needs_pycolmap
def test_the_scene_can_be_read(staged, scene):
    from hyperplanes.data import read_views

    captured, _ = scene
    views = read_views(captured.folder)
    assert (len(views), views.size, views.up, captured.mask) == (VIEWS, (180, 240), "z", "given")
    assert views.bounds.radius == 1.0
    assert views.masks is not None
    assert float(views.masks.mean()) == pytest.approx(np.mean(staged.masks), rel=0.1)


@needs_pycolmap
def test_masks_do_not_change_the_images_of_the_scene(staged, scene):
    """Source of truth: undistortion by OpenCV, which must agree also outside the object."""
    captured, _ = scene
    lens = np.array([*staged.lens, 0.0, 0.0])
    for index, (photograph, mask) in enumerate(zip(staged.photographs, staged.masks, strict=True)):
        with Image.open(captured.folder / f"images/photo_{index:03d}.jpg") as image:
            written = np.asarray(image).astype(float)
        true = cv2.undistort(photograph, staged.calibration, lens)
        around = cv2.undistort(np.where(mask, 0, 255).astype(np.uint8), staged.calibration, lens) == 255
        assert np.abs(written - true)[around].mean() < 8
        assert np.abs(true[around]).mean() > 80


def test_a_mask_is_undistorted_independently_of_the_image():
    """Source of truth: OpenCV for the mask, which is 0 outside the photograph; and the image without a mask."""
    rows, columns = np.mgrid[:60, :80]
    opacity = (128 + 127 * np.sin(columns / 9) * np.cos(rows / 7)).astype(np.uint8)
    picture = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    matrix, lens = np.array([[70.0, 0, 39.5], [0, 72.0, 29.5], [0, 0, 1]]), np.array([0.12, 0.05])
    bare, _ = straightened(picture, None, matrix, lens)
    straight, mask = straightened(picture, opacity, matrix, lens)
    np.testing.assert_array_equal(straight, bare)
    assert mask is not None
    theirs = cv2.undistort(opacity, matrix, np.array([*lens, 0.0, 0.0])).astype(int)
    assert np.abs(mask - theirs).max() <= 4, "OpenCV interpolates in steps of 1/32 of a pixel"
    assert mask[0, 0] == 0 < bare[0, 0].max()


@needs_pycolmap
def test_omitted_photographs_are_named_and_all_stages_are_reported(scene):
    captured, shown = scene
    assert [note for note in captured.notes if "photo_100.jpg" in note]
    assert {"photographs", "features", "matches", "poses", "writing"} <= {stage for stage, _, _ in shown}
    for name in ("photographs", "features", "lens"):  # by their own names, not those of the files in capture/
        assert {text for each, done, text in shown if each == name and done == 0} == {"photo_000.jpg"}


@needs_pycolmap
def test_the_same_call_reuses_finished_stages(scene):
    from hyperplanes.capture import capture

    captured, _ = scene
    shown = []
    again = capture(captured.folder.parent / "photos", captured.folder, progress=lambda *step: shown.append(step[0]))
    assert again == captured
    assert not {"features", "matches", "poses", "photographs"} & set(shown)


@needs_pycolmap
def test_photographs_without_matches_give_an_error_with_advice(tmp_path):
    from hyperplanes.capture import capture

    for index in range(3):
        Image.fromarray(np.random.default_rng(index).integers(0, 255, (60, 80, 3), dtype=np.uint8)).save(
            tmp_path / f"{index}.png"
        )
    with pytest.raises(ValueError, match="3 of which none can; walk around the object in small steps"):
        capture(tmp_path, tmp_path / "scene")
    # an unreadable photograph is named, too
    (tmp_path / "cut.png").write_bytes((tmp_path / "0.png").read_bytes()[:-2000])
    with pytest.raises(ValueError, match="3 of which none can; .*cut.png.*; walk around the object in small steps"):
        capture(tmp_path, tmp_path / "other")


def test_a_missing_package_is_reported_before_photographs_are_scaled(tmp_path, monkeypatch):
    from hyperplanes.capture import capture, pipeline

    def missing(*_):
        raise ValueError("no pycolmap")

    for index in range(3):
        Image.fromarray(np.full((60, 80, 3), index, dtype=np.uint8)).save(tmp_path / f"{index}.png")
    monkeypatch.setattr(pipeline, "require", missing)
    scaled = []
    with pytest.raises(ValueError, match="no pycolmap"):
        capture(tmp_path, tmp_path / "scene", progress=lambda stage, *_: scaled.append(stage))
    assert "photographs" not in scaled
