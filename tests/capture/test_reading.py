"""Source of truth: the pixels of images before they were rotated, scaled and saved."""

import re
import sys

import numpy as np
import pytest
from PIL import Image

from hyperplanes.capture import Settings, capture, pipeline
from hyperplanes.capture.masks import network
from hyperplanes.capture.photographs import find_photographs, list_photographs, read_upright, without_copies
from hyperplanes.capture.scene import write_scene
from hyperplanes.capture.scene_record import SceneRecord
from hyperplanes.data.formats.recognise import read_posed
from hyperplanes.utilities.files.encoding import encode_jpeg, encode_png
from hyperplanes.utilities.files.reading import DataError
from tests.fuzz.published import Published

ORIENTATION, MODEL, EXIF, FOCAL_35 = 0x0112, 0x0110, 0x8769, 0xA405


@pytest.fixture
def upright():
    """An image of 40 x 24 pixels that is red in its upper half and green in its left half."""
    picture = np.zeros((24, 40, 3), np.uint8)
    picture[:12, :, 0], picture[:, :20, 1] = 200, 100
    return picture


def save(picture, path, orientation=1, **tags):
    """Save an image rotated, with the EXIF orientation that rotates it back upright."""
    turns = {1: 0, 8: 3, 3: 2, 6: 1}  # quarter turns counterclockwise from upright to stored
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    exif[MODEL] = tags.get("model", "phone")
    if "focal" in tags:
        exif.get_ifd(EXIF)[FOCAL_35] = tags["focal"]
    Image.fromarray(np.rot90(picture, turns[orientation])).save(path, exif=exif)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_photographs_are_read_upright(upright, tmp_path, orientation):
    for index in range(3):
        save(upright, tmp_path / f"{index}.png", orientation)
    (first, *_), notes = list_photographs(find_photographs(tmp_path))
    picture, opacity = read_upright(first, 1000)
    assert (first.size, first.turned, notes, opacity) == ((24, 40), False, [], None)
    np.testing.assert_array_equal(picture, upright)


def test_photographs_with_equal_stems_get_unique_names(upright, tmp_path):
    for name in ("a.jpg", "a.png", "a_2.jpg"):
        save(upright, tmp_path / name)
    photographs, _ = list_photographs(find_photographs(tmp_path))
    assert len({each.name for each in photographs}) == 3


def test_photographs_of_the_rarer_shape_are_rotated_and_know_their_up_direction(upright, tmp_path):
    for index in range(3):
        save(upright, tmp_path / f"{index}.png")
    tall = np.ascontiguousarray(upright.transpose(1, 0, 2))
    save(tall, tmp_path / "tall.png")
    photographs, _ = list_photographs(find_photographs(tmp_path))
    picture, _ = read_upright(photographs[3], 1000)
    assert photographs[3].turned
    assert picture.shape[:2] == (24, 40)
    x, y, _ = photographs[3].up_in_camera
    towards = picture[12, 20] - picture[12 - round(11 * y) - 1, 20 + round(18 * x)].astype(int)
    assert towards[1] < 0  # green is the upper half of the tall picture


def test_names_are_sorted_by_their_numbers(upright, tmp_path):
    for name in ("IMG_10.png", "IMG_9.png", "IMG_100.png", "IMG_9²3.png"):
        save(upright, tmp_path / name)
    assert [path.stem for path in find_photographs(tmp_path)] == ["IMG_9", "IMG_9²3", "IMG_10", "IMG_100"]


def test_the_focal_length_comes_from_exif(upright, tmp_path):
    for index in range(3):
        save(upright, tmp_path / f"{index}.jpg", focal=27)
    (first, *_), _ = list_photographs(find_photographs(tmp_path))
    assert first.focal == pytest.approx(0.75)  # 27 mm with a film width of 36 mm


@pytest.mark.parametrize("drawn", ["as stored", "upright"])
def test_masks_of_rotated_photographs_are_rotated_with_them(upright, tmp_path, drawn):
    (tmp_path / "masks").mkdir()
    mask = np.zeros((24, 40), np.uint8)
    mask[:12] = 255
    for index in range(3):
        save(upright, tmp_path / f"{index}.png", 6)
        Image.fromarray(np.rot90(mask) if drawn == "as stored" else mask).save(tmp_path / "masks" / f"{index}_mask.png")
    (first, *_), _ = list_photographs(find_photographs(tmp_path), tmp_path / "masks")
    _, opacity = read_upright(first, 1000)
    np.testing.assert_array_equal(opacity, mask)


@pytest.mark.parametrize("kind", ["masks/", "alpha"])
def test_masks_do_not_change_the_images_for_pose_estimation(kind, tmp_path, monkeypatch):
    shown = []

    def find_poses(pictures, folder, *_, **__):
        shown.append([(folder / picture.file).read_bytes() for picture in pictures])

    monkeypatch.setattr(pipeline, "find_poses", find_poses)
    rgba = np.random.default_rng(0).integers(0, 255, (3, 96, 160, 4), dtype=np.uint8)
    rgba[..., 3] = 255 * (np.arange(160) < 50)
    for given in (False, True):
        home = tmp_path / str(given)
        (home / "masks" if given and kind == "masks/" else home).mkdir(parents=True)
        for index, picture in enumerate(rgba):
            Image.fromarray(picture if given and kind == "alpha" else picture[..., :3]).save(home / f"{index}.png")
            if (home / "masks").is_dir():
                Image.fromarray(picture[..., 3]).save(home / "masks" / f"{index}.png")
        with pytest.raises(DataError, match="none can"):
            capture(home, home / "scene", Settings(max_size=80))
        assert len(list((home / "scene/capture/pictures").glob("*.mask.png"))) == 3 * given
    attempts = len(shown) // 2
    assert shown[0] == shown[attempts]


def test_an_empty_folder_of_masks_is_ignored(upright, tmp_path):
    for index in range(3):
        save(upright, tmp_path / f"{index}.jpg")
    (tmp_path / "masks").mkdir()
    photographs, notes = list_photographs(find_photographs(tmp_path), tmp_path / "masks")
    assert ([photograph.mask for photograph in photographs], notes) == ([None] * 3, [])


def test_masks_may_be_entirely_white(upright, tmp_path):
    (tmp_path / "masks").mkdir()
    for index in range(3):
        save(upright, tmp_path / f"{index}.png")
        Image.fromarray(np.full((24, 40), 255, np.uint8)).save(tmp_path / f"masks/{index}.png")
    photographs, _ = list_photographs(find_photographs(tmp_path), tmp_path / "masks")
    _, _, opacities = pipeline._pictures(photographs, pipeline._Work(pipeline.Stages(tmp_path), Settings(), print))
    assert len(opacities) == 3


def test_opaque_alpha_is_a_mask_only_if_another_image_has_transparency(upright, tmp_path):
    rgba = np.dstack([upright, np.full((24, 40), 255, np.uint8)])
    for transparent in (0, 1):
        for index in range(3):
            rgba[0, 0, 3] = 255 - transparent * (index > 0)
            rgba[1, 0, 0] = index
            Image.fromarray(rgba).save(tmp_path / f"{index}.png")
        work = pipeline._Work(pipeline.Stages(tmp_path / "work"), Settings(), print)
        _, _, opacities = pipeline._pictures(list_photographs(find_photographs(tmp_path))[0], work)
        assert len(opacities) == 3 * transparent


def test_too_few_photographs_are_refused(upright, tmp_path):
    save(upright, tmp_path / "only.png")
    with pytest.raises(DataError, match="at least 3 photographs .* found 1 photograph;"):
        find_photographs(tmp_path)


@pytest.mark.parametrize(("name", "advice"), [("day/1.png", "some in {}/day: give"), ("walk.mp4", "give {}/walk.mp4")])
def test_the_error_for_a_folder_without_photographs_suggests_another_path(name, advice, upright, tmp_path):
    if name.endswith(".png"):
        (tmp_path / "day").mkdir()
        save(upright, tmp_path / name)
    else:
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=re.escape(advice.format(tmp_path))):
        find_photographs(tmp_path)


def test_a_broken_photograph_is_named_and_left_out(upright, tmp_path):
    for index in range(3):
        save(upright, tmp_path / f"{index}.png")
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    photographs, notes = list_photographs(find_photographs(tmp_path))
    assert len(photographs) == 3
    assert [note.startswith("left out: ") and "broken.jpg" in note for note in notes] == [True]


def test_copies_of_a_file_are_left_out(upright, tmp_path):
    for index in range(4):
        save(upright if index else upright[::-1], tmp_path / f"{index}.png")
    kept, (note,) = without_copies(list_photographs(find_photographs(tmp_path))[0])
    assert [one.path.name for one in kept] == ["0.png", "1.png"]
    assert note == "2 of the files are copies of others and are left out: 2.png, 3.png"


@pytest.mark.parametrize(
    ("mask", "said"),
    [
        ("netwrok", "expected one of auto, given"),
        ("cut {image}", "{mask} in it"),
        ("rembg 'i {image} {mask}", "expected a command, got .* .No closing quotation.; correct it"),
        ("no_such_program {image} {mask}", "a program that is installed, found none called 'no_such_program'"),
        ("network", "onnx"),
        ("grabcut", "package cv2"),
    ],
)
def test_unusable_mask_methods_are_refused_before_poses_are_estimated(mask, said, tmp_path, monkeypatch):
    monkeypatch.setattr(network, "weights", lambda: None)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ValueError, match=said):
        capture(tmp_path / "nothing", tmp_path / "scene", Settings(mask=mask))


@pytest.mark.parametrize(
    ("mask", "name", "said"),
    [
        ("given", None, "expected photographs with alpha, or a folder masks/ beside them, found neither"),
        ("given", "object_0.png", "masks: expected masks named as the images, found none for 0.png"),
        ("auto", "object_0.png", "masks: expected masks named as the images, found none for 0.png"),
    ],
)
def test_missing_masks_are_reported_before_poses_are_estimated(mask, name, said, upright, tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "find_poses", lambda *_, **__: pytest.fail("poses are searched for"))
    for index in range(3):
        save(np.roll(upright, index, 0), tmp_path / f"{index}.png")
    if name is not None:
        (tmp_path / "masks").mkdir()
        Image.fromarray(upright[..., 0]).save(tmp_path / "masks" / name)
    with pytest.raises(DataError, match=said):
        capture(tmp_path, tmp_path / "scene", Settings(mask=mask))


@pytest.mark.parametrize(("given", "out"), [("scene", "scene"), ("scene/images", "scene"), ("capture/pictures", ".")])
def test_a_scene_does_not_overwrite_its_photographs(given, out, upright, tmp_path):
    for index in range(3):
        (tmp_path / given).mkdir(parents=True, exist_ok=True)
        save(upright if index else upright[::-1], tmp_path / given / f"{index}.png")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    with pytest.raises(DataError, match="expected photographs outside of the scene"):
        capture(tmp_path / given, tmp_path / out)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


def test_other_files_in_the_folders_of_a_scene_are_kept(tmp_path):
    model = Published([np.zeros((10, 12, 4), np.uint8)] * 4, np.stack([np.eye(4)] * 4)).sparse_model()
    names, size = ["0", "1", "2", "3"], [(10, 12)] * 4
    first = {f"{kind}/{name}.{end}": b"1" for kind, end in (("images", "jpg"), ("masks", "png")) for name in names}
    write_scene(SceneRecord(tmp_path, tmp_path / "record.json"), (), model, names, size, first)
    (tmp_path / "images" / "thumbs").mkdir()
    (tmp_path / "masks" / "notes.txt").write_text("mine")
    second = {f"images/{name}.jpg": b"2" for name in ["0", "1", "2", "other"]}
    write_scene(SceneRecord(tmp_path, tmp_path / "record.json"), (), model, ["0", "1", "2", "other"], size, second)
    left = sorted(
        str(path.relative_to(tmp_path)) for kind in ("images", "masks") for path in (tmp_path / kind).iterdir()
    )
    assert left == sorted([*second, "images/thumbs", "masks/notes.txt"])


def test_a_scene_that_is_written_again_without_masks_can_be_read(tmp_path):
    model = Published([np.zeros((10, 12, 4), np.uint8)] * 4, np.stack([np.eye(4)] * 4)).sparse_model()
    names, size = ["0", "1", "2", "3"], [(10, 12)] * 4
    grey = np.full((10, 12, 3), 128, np.uint8)
    images = {f"images/{name}.jpg": encode_jpeg(grey, 90) for name in names}
    masks = {f"masks/{name}.png": encode_png(grey[..., 0]) for name in names}
    write_scene(SceneRecord(tmp_path, tmp_path / "record.json"), (), model, names, size, images | masks)
    assert read_posed(tmp_path).has_alpha
    write_scene(SceneRecord(tmp_path, tmp_path / "record.json"), (), model, names, size, images)
    assert not (tmp_path / "masks").exists()
    assert not read_posed(tmp_path).has_alpha


@pytest.mark.parametrize("wrong", [{"order": "sequnce"}, {"max_size": 0}, {"frames": 2}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}: expected"):
        Settings(**wrong)
