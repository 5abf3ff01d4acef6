"""Source of truth: the ball of conftest, with files changed as cameras, phones and users change them."""

import io
import json
import re

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from hyperplanes.adaptation.base import hull
from hyperplanes.data import DataError, read_task, read_views
from hyperplanes.data.pictures.images import image_header, opacity_of, read_image, read_mask
from hyperplanes.data.pictures.masks import match_masks
from hyperplanes.data.pictures.posed import Posed
from hyperplanes.export.images import orbit_cameras
from hyperplanes.geometry import cameras as camera


def jpeg(path, picture, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(picture).convert("RGB").save(path, quality=95, exif=exif)


def balls(views, masks):
    """The distance in pixels between the centroid of each mask and the projection of the ball's centre."""
    centre = torch.tensor([[[0.1, 0.2, 0.0]]]).expand(len(views), 1, 3)
    for mask, pixel in zip(masks, views.cameras.project(centre), strict=True):
        rows, columns = torch.nonzero(mask, as_tuple=True)
        yield float((torch.stack([columns.float().mean(), rows.float().mean()]) - pixel[0]).abs().max())


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_rotated_if_the_stated_size_requires_it(scene, tmp_path, orientation):
    """The stored pixels are upright ones, rotated back by NumPy. The file states the upright or the stored size."""
    (tmp_path / "images").mkdir()
    document = scene.document(w=32, h=24)
    back = {
        1: lambda a: a,
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.swapaxes(0, 1),
        6: lambda a: np.rot90(a),
        7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
        8: lambda a: np.rot90(a, -1),
    }[orientation]
    for frame, picture in zip(document["frames"], scene.pictures, strict=True):
        flat = np.where(picture[..., 3:] > 0, [220, 30, 30, 255], [20, 20, 200, 255]).astype(np.uint8)
        stored = np.ascontiguousarray(back(flat) if orientation >= 5 else flat)
        frame["file_path"] = frame["file_path"].replace(".png", ".jpg")
        jpeg(tmp_path / frame["file_path"], stored, orientation)
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    if orientation >= 5:
        with pytest.warns(UserWarning, match="8 images rotated by their EXIF orientation: images/000.jpg"):
            views = read_views(tmp_path)
    else:
        views = read_views(tmp_path)  # pixels as they are stored, as in COLMAP and nerfstudio
    assert max(balls(views, views.images[:, 0] > 0.5)) < 0.6
    del document["w"], document["h"]
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    if orientation > 1:
        with pytest.raises(
            DataError, match=rf"000\.jpg: expected pixels stored upright, .*EXIF orientation {orientation}"
        ):
            read_views(tmp_path)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        (
            {"w": 24, "h": 32},
            r"000\.png: expected the aspect ratio of the 24 x 32 pixels that transforms.json states, found 32",
        ),
        ({"w": 64, "h": 64}, "expected the aspect ratio of the 64 x 64 pixels"),
        ({"is_fisheye": True}, "expected perspective cameras, found is_fisheye set; undistort"),
        ({"ortho": True}, "found ortho set"),
        (
            {"k2": -3690.0},
            "frame images/000.png: expected a lens that maps one direction to each pixel, found k2 = -3690, which fold",
        ),
    ],
)
def test_impossible_values_are_refused_by_name(scene, tmp_path, fields, match):
    with pytest.raises(DataError, match=match):
        read_views(scene.write(tmp_path, scene.document(**fields)))


def test_masks_of_a_folder_are_found_by_name(scene, tmp_path):
    document = scene.document()
    folder = scene.write(tmp_path, document, mode="RGB")
    (tmp_path / "masks").mkdir()
    for index, picture in enumerate(scene.pictures):
        name = f"{index:03d}.png" if index % 2 else f"{index:03d}.png.png"
        Image.fromarray(picture[..., 3]).save(tmp_path / "masks" / name)
    assert torch.allclose(read_views(folder).images, scene.over_white(), atol=1e-6)
    (tmp_path / "masks/003.png").unlink()
    with pytest.raises(DataError, match=r"masks: expected a mask for each of the 8 images, found 7, none for 003.png"):
        read_views(folder)


def test_an_empty_folder_for_masks_counts_as_none(scene, tmp_path):
    folder = scene.write(tmp_path, scene.document(), mode="RGB")
    (tmp_path / "masks").mkdir()
    assert read_views(folder).masks is None


def test_frames_that_are_missing_are_left_out_and_named(scene, tmp_path):
    document = scene.document(train_filenames=scene.names[:5], test_filenames=scene.names[5:])
    folder = scene.write(tmp_path, document)
    for name in (scene.names[1], scene.names[6]):
        (tmp_path / name).unlink()
    said = "6 of 8 frames have an image; missing: images/001.png, images/006.png"
    with pytest.warns(UserWarning, match=re.escape(said)):
        task = read_task(folder)
    assert task.support.names == tuple(scene.names[at] for at in (0, 2, 3, 4))
    assert task.query.names == (scene.names[5], scene.names[7])
    pose = torch.from_numpy(scene.camera_from_world[[5, 7]]).float()
    assert torch.allclose(camera.camera_from_world(task.query.cameras), pose, atol=1e-6)


def test_pictures_of_several_sizes_are_scaled_to_one(scene, tmp_path):
    """Property: the ball's centre is projected to the centroid of every silhouette."""
    folder = scene.write(tmp_path)
    for name in scene.names[:2]:
        with Image.open(tmp_path / name) as image:
            large = image.resize((96, 72), Image.Resampling.BICUBIC)
        large.save(tmp_path / name)
    with pytest.warns(UserWarning, match="2 images of another size, scaled to 32 x 24 pixels"):
        views = read_views(folder)
    assert len(views) == 8
    assert max(balls(views, views.masks[:, 0] > 0.5)) < 0.6


def test_portraits_among_landscapes_keep_their_geometry(scene, tmp_path):
    """Property: the ball's centre is projected to the centroid of every silhouette; the hull is that of landscapes."""
    folder = scene.write(tmp_path)
    landscapes = read_views(folder)
    upright = type(scene)(size=(40, 30))
    for at in (0, 4, 6):
        Image.fromarray(upright.pictures[at]).save(tmp_path / scene.names[at])
    with pytest.warns(UserWarning, match="3 images of another size, scaled to 32 x 24 pixels"):
        views = read_views(folder)
    focal = camera.intrinsics(views.cameras)[:, [0, 1], [0, 1]].numpy()
    np.testing.assert_allclose(focal[1], scene.matrix[0, 0], rtol=1e-6)
    np.testing.assert_allclose(focal[4], upright.matrix[0, 0] * np.array([32 / 30, 24 / 40]), rtol=1e-6)
    assert max(balls(views, views.masks[:, 0] > 0.5)) < 0.6
    volumes = [float(hull(each, 64).occupied.sum()) * each.bounds.radius**3 for each in (views, landscapes)]
    assert volumes[0] == pytest.approx(volumes[1], rel=0.05)
    orbit = camera.intrinsics(orbit_cameras(views, 3))
    torch.testing.assert_close(orbit[:, 0, 0], orbit[:, 1, 1])


def test_scaling_down_keeps_the_geometry(scene, tmp_path):
    """By hand: 33 x 25 pixels become 8 x 6, with f / 4 and (c + 1/2) / 4 - 1/2; colours are means over white."""
    big = type(scene)(size=(25, 33))
    folder = big.write(tmp_path)
    with pytest.warns(UserWarning, match="scaled down by 4, to 8 x 6 pixels"):
        small = read_views(folder, downscale=4)
    matrix = camera.intrinsics(small.cameras)[0].numpy()
    assert matrix[0, 0] == pytest.approx(big.matrix[0, 0] / 4)
    np.testing.assert_allclose(matrix[:2, 2], (big.matrix[:2, 2] + 0.5) / 4 - 0.5, rtol=1e-6)
    expected = torch.nn.functional.avg_pool2d(big.over_white()[:, :, :24, :32], 4)
    assert (small.images - expected).abs().max() < 3 / 255
    with pytest.raises(DataError, match="expected a downscale from 1 to 25, found 40"):
        read_views(folder, downscale=40)


def test_more_than_a_megapixel_is_scaled_down(scene, tmp_path):
    (tmp_path / "images").mkdir()
    for name in scene.names[:2]:
        Image.new("RGB", (1600, 1200)).save(tmp_path / name)
    document = scene.document()
    (tmp_path / "transforms.json").write_text(json.dumps(document | {"frames": document["frames"][:2]}))
    with pytest.warns(UserWarning, match="scaled down by 2, to 800 x 600 pixels; --downscale 1 keeps every pixel"):
        assert read_views(tmp_path).size == (600, 800)


def test_bounds_are_those_of_the_support(scene, tmp_path):
    """Property: masks of the query views do not change the bounds."""
    whole = read_task(scene.write(tmp_path / "a"))
    other = type(scene)()
    for index in range(1, 8, 2):
        other.pictures[index] = np.full_like(other.pictures[index], 255)
    task = read_task(other.write(tmp_path / "b"))
    assert task.support.bounds == whole.support.bounds == task.query.bounds
    from hyperplanes.data.formats.recognise import read_posed

    scene_of_all = read_posed(tmp_path / "a")
    assert isinstance(scene_of_all, Posed)
    assert scene_of_all.bounds != whole.support.bounds


@pytest.mark.parametrize("place", [".", "images", "input"])
def test_for_photographs_without_poses_the_error_says_how_to_get_them(scene, tmp_path, place):
    (tmp_path / place).mkdir(exist_ok=True)
    for index in range(3):
        Image.fromarray(scene.pictures[index]).convert("RGB").save(tmp_path / place / f"{index}.JPG", "JPEG")
    from hyperplanes.data import open_dataset

    for action in (read_views, read_task, open_dataset):
        with pytest.raises(DataError, match=r"found 3 photographs and no poses; find them: hyperplanes capture "):
            action(tmp_path)


@pytest.mark.parametrize("given", ["walk.webm", "."])
def test_for_a_video_without_poses_the_error_says_how_to_get_them(given, tmp_path):
    (tmp_path / "walk.webm").touch()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(DataError, match=rf"found a video; find .*: hyperplanes capture {tmp_path}/walk.webm "):
        read_views(tmp_path / given)


@pytest.mark.parametrize("image", [None, "images/0.jpg"])
def test_for_an_unfinished_capture_the_error_says_how_to_continue_it(image, tmp_path):
    """Also if it was interrupted while it wrote the images."""
    from hyperplanes.data import open_dataset

    out = tmp_path / "scene"
    (out / "capture" / "pictures").mkdir(parents=True)
    (out / "capture" / "pictures.json").write_text('{"key": "1", "done": false}')
    (out / ".lock").touch()
    if image is not None:
        (out / image).parent.mkdir()
        Image.new("RGB", (8, 8)).save(out / image)
    said = f"{out}: expected a scene, found an unfinished capture; continue it: hyperplanes capture PHOTOS --out {out}"
    for action in (read_views, read_task, open_dataset):
        with pytest.raises(DataError) as caught:
            action(out)
        assert str(caught.value) == said


def test_heic_photographs_of_a_phone_are_counted(tmp_path):
    for index in range(3):
        (tmp_path / f"{index}.HEIC").touch()
    with pytest.raises(DataError, match=r"found 3 photographs and no poses; find them: hyperplanes capture "):
        read_views(tmp_path)


def test_a_linked_folder_of_pictures_inside_the_tree_is_followed(scene, tmp_path):
    """The pictures of a scene are next to it in the given folder. Given alone, its link leads outside."""
    from hyperplanes.data import open_dataset

    document = scene.document()
    for frame in document["frames"]:
        frame["file_path"] = frame["file_path"].replace("images", "linked")
    scene.write(tmp_path / "shared", document)
    (tmp_path / "shared/transforms.json").unlink()
    (tmp_path / "car").mkdir()
    (tmp_path / "car/transforms.json").write_text(json.dumps(document))
    (tmp_path / "car/linked").symlink_to(tmp_path / "shared/images")
    assert len(open_dataset(tmp_path).task("car").support) == 4
    with pytest.raises(DataError, match="expected file names inside"):
        read_views(tmp_path / "car")


def masks_of_widths(paths):
    """Write masks of 8 x 8 pixels: the first has one column set, the second two, and so on."""
    for width, path in enumerate(paths, 1):
        path.parent.mkdir(parents=True, exist_ok=True)
        mask = np.zeros((8, 8), np.uint8)
        mask[:, :width] = 255
        Image.fromarray(mask).save(path)


def test_masks_of_one_name_belong_to_the_pictures_of_their_folders(tmp_path):
    names = ["cam0/0.png", "cam1/0.png", "cam0/1.png", "cam1/1.png"]
    masks_of_widths([tmp_path / "masks" / name for name in names])
    pictures = [tmp_path / "images" / name for name in names]
    assert match_masks(tmp_path / "masks", pictures) == [tmp_path / "masks" / name for name in names]
    with pytest.raises(DataError, match="expected one mask for .*cam2/0.png, found 2: cam0/0.png, cam1/0.png"):
        match_masks(tmp_path / "masks", [tmp_path / "images/cam2/0.png"])


@pytest.mark.parametrize("transparent", [False, True])
def test_a_mask_is_used_for_a_picture_with_an_opaque_alpha_channel(transparent, tmp_path):
    picture = np.full((8, 8, 4), 200, np.uint8)
    picture[..., 3] = 255
    picture[0, 0, 3] -= transparent
    (tmp_path / "images").mkdir()
    Image.fromarray(picture).save(tmp_path / "images/0.png")
    masks_of_widths([tmp_path / "masks/0.png"])
    pose = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 3.0], [0, 0, 0, 1.0]]
    frames = [{"file_path": "images/0.png", "transform_matrix": pose}]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    shown = read_views(tmp_path)
    assert float(shown.masks.mean()) == pytest.approx((64 * 255 - 1) / 64 / 255 if transparent else 1 / 8)


@pytest.mark.parametrize("white", [1.0, 255.0, 65535.0])
def test_floating_point_pictures_are_scaled_by_their_range(white, tmp_path):
    Image.fromarray(np.linspace(0, white, 64, dtype=np.float32).reshape(8, 8)).save(tmp_path / "mask.tiff")
    pixels, _ = read_image(tmp_path / "mask.tiff")
    np.testing.assert_allclose(pixels[..., 0].flatten(), np.linspace(0, 255, 64), atol=0.51)


@pytest.mark.parametrize("how", [Image.Resampling.BICUBIC, Image.Resampling.LANCZOS])
def test_masks_that_overshoot_after_resampling_are_clipped(how, tmp_path):
    mask = np.zeros((12, 12), np.float32)
    mask[3:9, 3:9] = 1.0
    scaled = Image.fromarray(mask).resize((30, 30), how)
    assert np.asarray(scaled).max() > 1.05
    scaled.save(tmp_path / "mask.tiff")
    pixels, _ = read_image(tmp_path / "mask.tiff")
    np.testing.assert_allclose(pixels[..., 0], 255 * np.asarray(scaled).clip(0, 1), atol=0.51)


@pytest.mark.parametrize(
    ("mask", "has_alpha", "opacity"), [((0, 255), True, 0), ((0, 90), True, 90), ((80, 255), False, 80)]
)
def test_masks_of_one_colour_are_read_from_their_alpha_channel(mask, has_alpha, opacity):
    grey, alpha = mask
    pixels = np.full((2, 2, 4), grey, np.uint8)
    pixels[..., 3] = alpha
    assert (opacity_of(pixels, has_alpha) == opacity).all()


def test_a_cut_out_is_read_from_its_alpha_channel():
    """A dark object on a light background, as programs that remove backgrounds write it."""
    pixels = np.full((2, 2, 4), 220, np.uint8)
    pixels[0, 0], pixels[..., 3] = 60, 0
    pixels[0, 0, 3] = 255
    assert opacity_of(pixels, True).tolist() == [[255, 0], [0, 0]]


def test_heic_is_read_after_pillow_heif_has_registered_it(tmp_path, monkeypatch):
    # a replacement of its opener reads a PNG after eight other bytes
    monkeypatch.setattr(Image, "OPEN", dict(Image.OPEN))
    monkeypatch.setattr(Image, "ID", list(Image.ID))
    path = tmp_path / "a.heic"
    picture = io.BytesIO()
    Image.new("RGB", (3, 2), "red").save(picture, "PNG")
    path.write_bytes(b"heicheic" + picture.getvalue())
    with pytest.raises(DataError, match="expected an image"):
        read_image(path)

    def opened(file, _):
        content = file.read()
        file.close()
        return PngImageFile(io.BytesIO(content[8:]))

    Image.register_open("HEIF", opened, lambda prefix: prefix.startswith(b"heic"))
    assert read_image(path)[0][0, 0].tolist() == [255, 0, 0, 255]


def test_masks_of_zeros_and_ones_are_black_and_white():
    """NumPy's `mask.astype(np.uint8)` has such values."""
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[0, :, :3], pixels[..., 3] = 1, 255
    assert opacity_of(pixels, False).tolist() == [[255, 255], [0, 0]]
    assert not opacity_of(np.zeros((2, 2, 4), np.uint8), False).any()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, bool])
def test_masks_of_zeros_and_ones_are_black_and_white_at_any_depth(kind, tmp_path):
    values = np.array([[0, 1, 1], [1, 0, 0]])
    path = tmp_path / ("mask.tiff" if kind is np.int32 else "mask.png")
    Image.fromarray(values.astype(kind)).save(path)
    np.testing.assert_array_equal(read_mask(path), 255 * values)


def test_every_label_of_a_coloured_palette_is_opaque_but_the_first(tmp_path):
    """PASCAL VOC's masks: the palette gives 0 black, 1 (128, 0, 0) and the border 255 (224, 224, 192)."""
    labels = np.array([[0, 1, 1], [2, 0, 255]], np.uint8)
    image = Image.fromarray(labels)
    colours = np.zeros((256, 3), np.uint8)
    colours[1], colours[2], colours[255] = (128, 0, 0), (0, 128, 0), (224, 224, 192)
    image.putpalette(colours.tobytes())
    assert image.mode == "P"
    image.save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), [[0, 255, 255], [255, 0, 255]])


def test_a_palette_of_greys_gives_the_opacity_whatever_the_order_of_its_colours(tmp_path):
    """As programs that compress PNG write a mask: here white is the first colour."""
    image = Image.fromarray(np.array([[0, 1, 2]], np.uint8))
    image.putpalette([255, 255, 255, 0, 0, 0, 90, 90, 90])
    image.save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), [[255, 0, 90]])


def test_hardly_opaque_pixels_of_masks_are_transparent(tmp_path):
    """Programs that cut objects out leave 1 or 2 of 255 in the background; 16 is the edge of a supersampled picture."""
    Image.fromarray(np.array([[0, 1, 7, 16, 255]], np.uint8)).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), [[0, 0, 0, 16, 255]])
    edge = np.zeros((20, 20), np.uint8)
    edge[:, 10], edge[:, 11:] = 3, 255  # of a clean picture: a pixel that the object hardly covers
    Image.fromarray(edge).save(tmp_path / "edge.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "edge.png"), edge)


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_tiff_that_is_stored_on_its_side_is_refused(orientation, tmp_path):
    picture = np.arange(24, dtype=np.uint8).reshape(4, 6)
    Image.fromarray(picture).save(tmp_path / "0.tiff", tiffinfo={274: orientation})
    if orientation == 1:
        np.testing.assert_array_equal(read_image(tmp_path / "0.tiff")[0][..., 0], picture)
        return
    for read in (image_header, read_image):
        with pytest.raises(DataError, match="expected a TIFF that is stored upright, found orientation 6"):
            read(tmp_path / "0.tiff")
