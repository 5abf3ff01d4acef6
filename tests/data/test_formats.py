"""LLFF, IDR and NSVF, written here as their authors describe them, from projections in closed form.

Source of truth: pixels (u, v) = (f x / z + c) of known points by hand, the readers' cameras must give the same ones.
"""

import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.data import DataError, open_dataset, read_task, read_views
from hyperplanes.geometry import cameras as camera

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
VIEWS, HEIGHT, WIDTH, FOCAL = 6, 18, 30, 40.0


def eyes_and_axes():
    """Centres, and right, down and forward axes, of cameras that look at the origin, by hand."""
    for index in range(VIEWS):
        angle = 2 * np.pi * index / VIEWS
        eye = np.array([3 * np.cos(angle), 1.0 + 0.1 * index, 3 * np.sin(angle)])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        yield eye, right, np.cross(forward, right), forward


def expected(centre=((WIDTH - 1) / 2, (HEIGHT - 1) / 2)):
    """Pixels (view, point, 2), with pixel centres at integers."""
    pixels = []
    for eye, right, down, forward in eyes_and_axes():
        x, y, z = ((POINTS - eye) @ axis for axis in (right, down, forward))
        pixels.append(np.stack([FOCAL * x / z + centre[0], FOCAL * y / z + centre[1]], -1))
    return np.stack(pixels)


def found(views, points=POINTS):
    return views.cameras.project(torch.from_numpy(points).float().expand(len(views), -1, 3)).numpy()


def pictures(folder, names, mode="RGB", size=(WIDTH, HEIGHT)):
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        Image.new(mode, size, tuple([20 * index, 50, 90, 128][: len(mode)])).save(folder / name)


def graded_masks(folder, names):
    """Write a mask for each image, of another grey level each."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        Image.new("L", (WIDTH, HEIGHT), 40 * index).save(folder / name)


def are_graded(masks):
    """Whether every image has its own mask of `graded_masks`."""
    return (masks.amax((1, 2, 3)) * 255).round().tolist() == [40 * index for index in range(VIEWS)]


def llff(folder, **change):
    rows = []
    for eye, right, down, forward in eyes_and_axes():
        matrix = np.stack([down, right, -forward, eye, np.array([2 * HEIGHT, 2 * WIDTH, 2 * FOCAL])], 1)
        rows.append([*matrix.reshape(-1), 1.5, 6.0])
    pictures(folder / "images_2", [f"IMG_{index}.JPG" for index in range(VIEWS)])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def test_llff(tmp_path):
    """The file describes pictures of twice the size; only the downscaled ones exist."""
    llff(tmp_path)
    views = read_views(tmp_path)
    np.testing.assert_allclose(found(views), expected(), atol=1e-3)
    assert np.linalg.norm(views.bounds.centre) < 0.3
    assert len(read_task(tmp_path).support) == 3
    assert open_dataset(tmp_path).names("test") == [tmp_path.name]
    (tmp_path / "images_2/IMG_3.JPG").unlink()
    with pytest.raises(DataError, match=r"poses_bounds.npy: expected 6 images, one per row, found 5 in images_2"):
        read_views(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((3, 16)))
    with pytest.raises(DataError, match=r"expected an array \(view, 17\), found float64 \(3, 16\)"):
        read_views(tmp_path)


def test_masks_next_to_the_pictures_of_llff(tmp_path):
    """Source of truth: the written masks. The product's error message says to add that folder."""
    llff(tmp_path)
    graded_masks(tmp_path / "masks", [f"IMG_{index}.png" for index in range(VIEWS)])
    assert are_graded(read_views(tmp_path).masks)
    (tmp_path / "masks/IMG_3.png").unlink()
    with pytest.raises(DataError, match=r"masks: expected a mask for each of the 6 images, found 5, none for IMG_3"):
        read_views(tmp_path)


def test_forward_facing_cameras_have_their_bounds_before_them(tmp_path):
    """By hand: cameras on a plane look along -z. The mean disparity of depths 2 and 6 is that of depth 3."""
    rows = []
    for x in (-0.2, 0.0, 0.2):
        axes = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # columns: down = -y, right = x, backwards = z
        matrix = np.concatenate([axes, [[x], [0], [0]], [[HEIGHT], [WIDTH], [FOCAL]]], 1)
        rows.append([*matrix.reshape(-1), 2.0, 6.0])
    pictures(tmp_path / "images", ["a.png", "b.png", "c.png"])
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    bounds = read_views(tmp_path).bounds
    assert bounds.centre == pytest.approx((0.0, 0.0, -3.0), abs=1e-5)
    assert 0.5 < bounds.radius < 3


@pytest.mark.parametrize("name", ["cameras.npz", "cameras_sphere.npz"])
def test_idr(tmp_path, name):
    """The projections are of a world in which the unit sphere is moved and scaled. There are masks of the object."""
    scale, shift = 2.5, np.array([1.0, -2.0, 0.5])
    arrays = {}
    for index, (eye, right, down, forward) in enumerate(eyes_and_axes()):
        rotation = np.stack([right, down, forward])
        matrix = np.array([[FOCAL, 0, 14.0], [0, FOCAL, 9.0], [0, 0, 1]])
        pose = np.concatenate([rotation, -rotation @ (scale * eye + shift)[:, None]], 1)
        arrays[f"world_mat_{index}"] = np.vstack([-3.0 * matrix @ pose, [0, 0, 0, 1]])  # of any scale
        arrays[f"scale_mat_{index}"] = np.diag([scale, scale, scale, 1.0])
        arrays[f"scale_mat_{index}"][:3, 3] = shift
    np.savez(tmp_path / name, **arrays)
    pictures(tmp_path / "image", [f"{index:03d}.png" for index in range(VIEWS)])
    pictures(tmp_path / "mask", [f"{index:03d}.png" for index in range(VIEWS)])
    views = read_views(tmp_path)
    np.testing.assert_allclose(found(views), expected((14.0, 9.0)), atol=1e-3)
    assert (views.bounds.centre, views.bounds.radius) == ((0.0, 0.0, 0.0), 1.0)
    assert views.masks is not None
    assert (
        camera.centres(views.cameras) - torch.from_numpy(np.stack([each[0] for each in eyes_and_axes()]))
    ).abs().max() < 1e-4
    for index in range(VIEWS):  # as NeuS publishes DTU: six digits for the pictures, three for their masks
        Image.new("L", (WIDTH, HEIGHT), 40 * index).save(tmp_path / f"mask/{index:03d}.png")
        (tmp_path / f"image/{index:03d}.png").rename(tmp_path / f"image/{index:06d}.png")
    renamed = read_views(tmp_path).masks
    assert (renamed.amax((1, 2, 3)) * 255).round().tolist() == [40 * index for index in range(VIEWS)]
    (tmp_path / "mask/005.png").rename(tmp_path / "mask/five.png")
    with pytest.raises(DataError, match="mask: expected masks named as the images, found none for 000000"):
        read_views(tmp_path)
    (tmp_path / "image/000005.png").unlink()
    with pytest.raises(DataError, match=rf"{name}: expected 6 or more images, one per world_mat, found 5"):
        read_views(tmp_path)


def nsvf(folder, intrinsics):
    names = [f"{digit}_{index:04d}" for index, digit in enumerate("001222")]
    pictures(folder / "rgb", [f"{name}.png" for name in names], "RGBA")
    (folder / "pose").mkdir()
    for name, (eye, right, down, forward) in zip(names, eyes_and_axes(), strict=True):
        matrix = np.vstack([np.stack([right, down, forward, eye], 1), [0, 0, 0, 1]])
        (folder / f"pose/{name}.txt").write_text("\n".join(" ".join(map(str, row)) for row in matrix))
    (folder / "intrinsics.txt").write_text(intrinsics)
    (folder / "bbox.txt").write_text("-1 -2 -2 1 2 2 0.4\n")


@pytest.mark.parametrize(
    "intrinsics",
    [
        f"{FOCAL} {WIDTH / 2} {HEIGHT / 2} 0.\n0. 0. 0.\n1.\n{HEIGHT} {WIDTH}\n",
        f"{2 * FOCAL} {WIDTH} {HEIGHT} 0.\n0. 0. 0.\n1.\n{2 * HEIGHT} {2 * WIDTH}\n",
        f"{FOCAL} 0 {WIDTH / 2} 0\n0 {FOCAL} {HEIGHT / 2} 0\n0 0 1 0\n0 0 0 1\n",
        f"{FOCAL} 0 {WIDTH / 2}\n0 {FOCAL} {HEIGHT / 2}\n0 0 1\n",
    ],
)
def test_nsvf(tmp_path, intrinsics):
    nsvf(tmp_path, intrinsics)
    np.testing.assert_allclose(found(read_views(tmp_path)), expected(), atol=1e-3)
    task = open_dataset(tmp_path).task(tmp_path.name)
    assert (task.support.names, len(task.query)) == (("rgb/0_0000.png", "rgb/0_0001.png"), 3)
    assert (task.support.bounds.centre, task.support.bounds.radius) == ((0.0, 0.0, 0.0), 3.0)
    (tmp_path / "bbox.txt").write_text("1 1 1 0 0 0")
    with pytest.raises(DataError, match=r"bbox.txt: expected a box: lowest corner, then the highest"):
        read_views(tmp_path)
