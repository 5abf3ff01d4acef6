"""Sources of truth: the pixels of the images themselves, and the uniform distribution of drawn rays."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hyperplanes.geometry.cameras import centres, cropped, image_size, pinhole, resized, select
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Views
from tests.reference_rendering import ring, small_model

NAMES = ("a", "b", "c", "d")


def views(size=(6, 9), **others):
    images = torch.rand(4, 3, *size, generator=torch.Generator().manual_seed(0))
    masks = (images[:, :1] > 0.5).float()
    return Views(images, ring(4, size), masks, **{"names": NAMES, **others})


@pytest.mark.parametrize(
    ("index", "chosen"),
    [
        (slice(1, None, 2), [1, 3]),
        ([2, 0], [2, 0]),
        (torch.tensor([3, 3]), [3, 3]),
        (torch.tensor([0, -1], dtype=torch.int32), [0, 3]),
        (torch.tensor([1, 0], dtype=torch.uint8), [1, 0]),
        ([True, False, False, True], [0, 3]),
        (np.array([2, 1], np.uint16), [2, 1]),
        (torch.tensor([False, True, True, False]), [1, 2]),
        (slice(0, 0), []),
        ([], []),
    ],
)
def test_chosen_views_keep_their_cameras_masks_and_names(index, chosen):
    whole = views(bounds=Sphere((1.0, 0.0, 0.0), 2.0))
    part = whole[index]
    assert len(part) == len(chosen)
    assert part.names == tuple(NAMES[i] for i in chosen)
    assert torch.equal(part.images, whole.images[chosen])
    assert torch.equal(part.masks, whole.masks[chosen])
    assert torch.equal(part.cameras.extrinsics, whole.cameras.extrinsics[chosen])
    assert part.bounds == whole.bounds


@pytest.mark.parametrize(
    ("index", "message"),
    [
        (2, r"views: expected a slice, a list, a tensor or an array of indices \(chosen\), got 2; use \[\[2\]\]"),
        (torch.tensor(2), "views: expected a slice, a list, a tensor or an array of indices"),
        (["a"], "views: expected a slice, a list, a tensor or an array of indices"),
        (torch.tensor([0.0]), "views: expected a slice, a list, a tensor or an array of indices"),
        ([4], "views: expected indices of 4 views, got 4 to 4"),
        ([-5, 0], "views: expected indices of 4 views, got -5 to 0"),
        ([True, False], "views: expected 4 booleans, one each, got 2"),
    ],
)
def test_indices_of_other_types_or_out_of_range_are_refused(index, message):
    with pytest.raises(ValueError, match=message):
        views()[index]


def test_views_without_masks_or_names():
    plain = Views(views().images, views().cameras)
    assert plain[1:].masks is None
    assert plain[1:].names == ()
    assert plain.to("cpu").masks is None


def test_size_is_height_and_width():
    assert views((6, 9)).size == (6, 9)


def test_rays_go_row_by_row_through_the_pixels_of_one_view():
    whole = views()
    rays = whole.rays(2)
    assert len(rays) == 6 * 9
    torch.testing.assert_close(rays.origins, centres(whole.cameras)[2].expand(54, 3))
    # points on the ray of row 4, column 7 project to pixel (7, 4) of the same camera
    point = rays.at(torch.full((54,), 2.5))[4 * 9 + 7]
    pixel = select(whole.cameras, [2]).project(point[None, None])
    torch.testing.assert_close(pixel.flatten(), torch.tensor([7.0, 4.0]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("near_far", ["sphere", "constant"])
def test_sampled_rays_come_with_the_colours_that_their_pixels_show(near_far):
    whole = views()
    rays, truth = whole.sample_rays(200, generator=torch.Generator().manual_seed(1), near_far=near_far)
    for index in range(200):
        view = int((centres(whole.cameras) - rays.origins[index]).norm(dim=1).argmin())
        point = rays.origins[index] + 3 * rays.directions[index]
        column, row = select(whole.cameras, [view]).project(point[None, None]).flatten().round().long().tolist()
        assert torch.equal(truth[index], whole.images[view, :, row, column])


def test_rays_are_drawn_uniformly_from_all_views():
    whole = views((2, 2))
    unique = torch.arange(16.0).reshape(4, 1, 2, 2).expand(4, 3, 2, 2) / 16
    _, truth = Views(unique, whole.cameras).sample_rays(16_000, generator=torch.Generator().manual_seed(0))
    counts = torch.bincount((truth[:, 0] * 16).round().long(), minlength=16)
    # one standard deviation of a count of 1000 is 31
    assert (counts - 1000).abs().max() < 150


def test_rays_are_drawn_among_the_given_pixels_only():
    whole = views((6, 9))
    # view 2, row 4, column 7 and view 1, row 0, column 8
    among = torch.tensor([(2 * 6 + 4) * 9 + 7, (1 * 6 + 0) * 9 + 8])
    rays, truth = whole.sample_rays(300, generator=torch.Generator().manual_seed(0), among=among)
    colours = torch.stack([whole.images[2, :, 4, 7], whole.images[1, :, 0, 8]])
    which = (truth[:, None] == colours).all(-1)
    assert which.any(1).all()
    assert 100 < which[:, 0].sum() < 200
    torch.testing.assert_close(rays.origins, centres(whole.cameras)[torch.where(which[:, 0], 2, 1)])


def test_the_same_generator_draws_the_same_rays():
    def draw(seed):
        return views().sample_rays(50, generator=torch.Generator().manual_seed(seed))[1]

    before = torch.random.get_rng_state()
    assert torch.equal(draw(1), draw(1))
    assert not torch.equal(draw(1), draw(2))
    assert torch.equal(before, torch.random.get_rng_state())


def test_views_in_another_precision_and_their_memory():
    double = views().to(dtype=torch.float64)
    assert double.images.dtype == double.masks.dtype == double.cameras.extrinsics.dtype == torch.float64
    # 4 views of 6 x 9 pixels, 3 + 1 numbers of 8 bytes
    assert double.nbytes == 4 * 6 * 9 * 4 * 8
    assert replace(double, masks=None).nbytes == 4 * 6 * 9 * 3 * 8


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_keeps_the_size_of_the_images(dtype):
    half = views((6, 2049)).to(dtype=dtype)
    assert half.images.dtype == half.cameras.intrinsics.dtype == dtype
    assert image_size(half.cameras) == half.size
    assert image_size(pinhole(torch.eye(3), torch.eye(4, dtype=dtype)[None], 6, 2049)) == (6, 2049)


def test_rays_go_through_the_pixels_whose_colours_they_have_in_any_precision():
    single = views((6, 2049))
    coarse = replace(single, images=single.images.bfloat16(), masks=None)
    rays, _ = coarse.sample_rays(50, generator=torch.Generator().manual_seed(0))
    expected, _ = single.sample_rays(50, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(rays.directions, expected.directions)


@pytest.mark.parametrize("dtype", [torch.int32, torch.uint8, torch.bool])
def test_integer_types_of_views_are_refused(dtype, tmp_path):
    for call in (views().to, lambda dtype: small_model().save(tmp_path, dtype)):
        with pytest.raises(ValueError, match=f"dtype: expected a floating-point type, got {dtype}"):
            call(dtype=dtype)
    assert not list(tmp_path.iterdir())


def test_sizes_below_one_pixel_are_refused():
    for no_size in (0, -5):
        with pytest.raises(ValueError, match=f"longest: expected at least 1 pixel, got {no_size}"):
            views().resized(no_size)
        for change in (resized, cropped):
            with pytest.raises(ValueError, match=f"image size: expected at least 1 x 1, got {no_size} x 4"):
                change(views().cameras, no_size, 4)


def test_no_views_can_be_resized():
    none = views()[:0].resized(2)
    assert len(none) == 0
    assert max(none.size) == 2
    assert none.cameras.batch_size == 0


def test_drawing_rays_from_no_pixels_is_refused():
    with pytest.raises(ValueError, match="among: expected at least one pixel of 4 views to draw rays from, got none"):
        views().sample_rays(3, among=torch.zeros(0, dtype=torch.long))
    for wrong in (216, -1):
        with pytest.raises(ValueError, match=f"among: expected indices of 216 pixels of 4 views, got {wrong} to"):
            views().sample_rays(3, among=torch.tensor([wrong]))
        with pytest.raises(ValueError, match=f"pixels: expected indices of 216 pixels of 4 views, got {wrong} to"):
            views().rays_at(torch.tensor([wrong]))


def test_rays_through_pixels_are_those_of_their_view():
    whole = views((6, 9))
    rays, truth, opacity = whole.rays_at(torch.tensor([(2 * 6 + 4) * 9 + 7, 8]))
    for place, (view, row, column) in enumerate([(2, 4, 7), (0, 0, 8)]):
        expected = whole.rays(view)[row * 9 + column : row * 9 + column + 1]
        torch.testing.assert_close(rays.directions[place : place + 1], expected.directions)
        assert torch.equal(truth[place], whole.images[view, :, row, column])
        assert torch.equal(opacity[place], whole.masks[view, :, row, column])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": torch.rand(4, 1, 6, 9)}, r"images: expected shape \(view, 3, height, width\), got \(4, 1, 6, 9\)"),
        ({"images": torch.rand(3, 6, 9)}, r"images: expected shape"),
        ({"images": torch.rand(3, 3, 6, 9), "masks": None}, "images: expected one a camera, 4, got 3"),
        (
            {"images": torch.rand(4, 3, 9, 6), "masks": None},
            r"images: expected the cameras' size \(6, 9\)",
        ),
        ({"masks": torch.ones(4, 6, 9)}, r"masks: expected \(4, 1, 6, 9\), got \(4, 6, 9\)"),
        ({"names": ("a",)}, "names: expected one a view, 4, got 1"),
        (
            {"images": torch.rand(4, 6, 9, 3)},
            r"images: expected channels before rows.* got \(4, 6, 9, 3\); write images\.permute\(0, 3, 1, 2\)",
        ),
    ],
)
def test_parts_of_other_shapes_are_refused(change, message):
    whole = views()
    parts = {"images": whole.images, "cameras": whole.cameras, "masks": whole.masks, "names": NAMES}
    with pytest.raises(ValueError, match=message):
        Views(**{**parts, **change})


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("size", [(5, 1), (3, 1), (1, 3), (3, 4), (3, 3)])
def test_the_size_of_the_cameras_determines_which_dimension_is_which(size):
    """Images are (N, C, H, W) as in PyTorch, also if small; channels last are refused if the shape shows it."""
    cameras, images = ring(2, size), torch.rand(2, 3, *size)
    assert Views(images, cameras).size == size
    if size[0] != 3 or size[1] != 3:
        with pytest.raises(ValueError, match=r"^images: expected channels before rows, .*; write images\.permute"):
            Views(images.permute(0, 2, 3, 1), cameras)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("images", "found"),
    [
        (
            lambda images: images * 255,
            "expected finite numbers in .0, 1., got 0 to 255; divide 8-bit pixels",
        ),
        (lambda images: (images * 255).to(torch.uint8), "got a tensor of uint8, shape .*/ 255 converts 8-bit"),
        (lambda images: images * float("nan"), "expected finite numbers in .0, 1., got NaN"),
        (lambda images: images > 0.5, r"got a tensor of bool, shape .*; x.float\(\) converts booleans"),
        (lambda images: images.numpy(), "got a numpy.ndarray; torch.from_numpy"),
        (lambda images: None, "got None"),
    ],
)
def test_values_that_are_no_images_are_refused_by_views(images, found):
    """Property: images that would be rendered as white never reach the model."""
    picture = torch.linspace(0, 1, 2 * 3 * 4 * 4).reshape(2, 3, 4, 4)
    cameras = ring(2, (4, 4))
    with pytest.raises(ValueError, match=f"^images: .*{found}"):
        Views(images(picture), cameras)
    with pytest.raises(ValueError, match="^cameras: expected a PinholeCamera of Kornia, got a list"):
        Views(picture, [cameras])
    views = Views(picture, cameras)
    with pytest.raises(ValueError, match=r"got 0; use \[\[0\]\]"):
        views[0]
    for count, expected in (
        (-1, "at least 1 ray"),
        (0, "at least 1 ray"),
        (None, "int, got None"),
        (2.5, "int, got 2.5"),
    ):
        with pytest.raises(ValueError, match=f"^count: expected {expected}"):
            views.sample_rays(count)
