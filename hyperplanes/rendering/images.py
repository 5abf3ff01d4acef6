"""Pictures of a field: the loop over cameras and pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays, Sphere, cast, pixel_grid
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.footprint import footprint
from hyperplanes.utilities.machine.memory import require_memory

__all__ = ["EDGE_SUBPIXELS", "Pictures", "join_pictures", "pixels_at_edges", "render_images"]

BYTES_OF_VIEW, BYTES_KEPT = 200, 32
"""Bytes a pixel takes: for the rays of the view being rendered, and for the finished pictures of all views."""

RAYS_OF_GROUP = 1 << 14
"""Most rays of small views that are rendered together: with two threads, 25 views of 64x64 take 0.94 s, and 1.78 s one
by one (`small`, idle)."""

EDGE_THRESHOLD = 0.7
"""Difference between neighbouring pixels, in colour or opacity, from which on more rays are cast through both. Lowering
it to 0.35 gains next to nothing more; 0.9 gains half as much."""

EDGE_SUBPIXELS = ((0.0, 0.0), (-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
"""Offsets of rays from the centre of such a pixel: the centre and a rotated grid of four."""


@dataclass(frozen=True)
class Pictures:
    """Rendered views.

    Attributes:
        images: RGB over the background, by default white.
        opacity: of each pixel, in [0, 1].
        depth: expected distance along the ray in world units, not the z coordinate in the camera; 0 if the ray hits
            nothing.
        samples: number of field evaluations, over all pixels.
    """

    images: Float[Tensor, "view 3 height width"]
    opacity: Float[Tensor, "view 1 height width"]
    depth: Float[Tensor, "view 1 height width"]
    samples: int


def join_pictures(parts: Sequence[Pictures]) -> Pictures:
    """Several pictures concatenated.

    Args:
        parts: at least one, of one image size.
    """
    return Pictures(
        torch.cat([part.images for part in parts]),
        torch.cat([part.opacity for part in parts]),
        torch.cat([part.depth for part in parts]),
        sum(part.samples for part in parts),
    )


def render_images(
    cameras: PinholeCamera,
    bounds: Sphere,
    render_rays: Callable[[Rays], Rendered],
    *,
    occupancy: Occupancy | None = None,
    near_far: str = "sphere",
    background: float = 1.0,
    antialias: bool = False,
    edge: float = EDGE_THRESHOLD,
) -> Pictures:
    """The pictures of cameras, by a function that renders rays.

    Rays are cast in the precision of the cameras and rendered in single precision. A pixel of a photograph is the mean
    over its area, but one ray samples only its centre. With `antialias`, pixels that differ much from a neighbour are
    the mean of five rays (docs/image-based.md, "Edges").

    Args:
        cameras: any number, one image size.
        bounds: sphere for near and far of the rays.
        render_rays: makes the pixels of rays.
        occupancy: pixels whose rays miss every occupied voxel are background, and no ray is rendered for them.
        near_far: as in `geometry.cast`.
        background: grey value of those pixels.
        antialias: cast five rays through pixels at edges; the depth stays that of the centre.
        edge: difference from a neighbour from which on a pixel is at an edge.

    Returns:
        One picture a camera.
    """
    height, width = camera.image_size(cameras)
    needed = height * width * (BYTES_OF_VIEW + BYTES_KEPT * cameras.batch_size)
    require_memory("cameras", f"{cameras.batch_size} of {width}x{height}", needed, "render fewer or smaller pictures")
    pixels = pixel_grid(height, width, cameras.intrinsics.device)
    # pixels whose rays may meet an occupied voxel; the others are background
    if occupancy is None:
        live = torch.ones(cameras.batch_size, height * width, dtype=torch.bool, device=pixels.device)
    else:
        live = footprint(occupancy, cameras).flatten(1)
    values = pixels.new_zeros(cameras.batch_size, height * width, 5)
    values[..., :3] = background
    samples = 0

    def rendered(view: Tensor, where: Tensor) -> Rendered:
        rays = cast(cameras, view, where, bounds, near_far=near_far)
        return render_rays(rays.to(torch.float32))

    for first, last in pairwise(_groups(live.sum(1).tolist())):
        view, chosen = live[first:last].nonzero().unbind(1)
        if not len(view):
            continue
        view += first
        part = rendered(view, pixels[chosen])
        values[view, chosen] = torch.cat([part.colour, part.opacity[:, None], part.depth[:, None]], 1).to(values)
        samples += part.samples
        if not antialias:
            continue
        # colour and opacity of pixels at edges: the mean of five rays
        seen = values[first:last, :, :4].unflatten(1, (height, width))
        view, chosen = pixels_at_edges(seen, edge).flatten(1).nonzero().unbind(1)
        view += first
        offsets = pixels.new_tensor(EDGE_SUBPIXELS[1:])
        places = (pixels[chosen] + offsets[:, None]).flatten(0, 1)
        part = rendered(view.repeat(len(offsets)), places)
        more = torch.cat([part.colour, part.opacity[:, None]], 1).to(values).unflatten(0, (len(offsets), -1)).sum(0)
        values[view, chosen, :4] = (values[view, chosen, :4] + more) / len(EDGE_SUBPIXELS)
        samples += part.samples
    maps = values.reshape(cameras.batch_size, height, width, 5).permute(0, 3, 1, 2)
    return Pictures(maps[:, :3], maps[:, 3:4], maps[:, 4:], samples)


def _groups(rays: Sequence[int]) -> list[int]:
    """Boundaries of groups of successive views with at most RAYS_OF_GROUP rays, or of single views.

    >>> _groups([9000, 7000, 1000, 40000, 5000])
    [0, 2, 3, 4, 5]
    """
    bounds, held = [0], 0
    for view, count in enumerate(rays):
        if held and held + count > RAYS_OF_GROUP:
            bounds.append(view)
            held = 0
        held += count
    return [*bounds, len(rays)]


def pixels_at_edges(
    values: Float[Tensor, "view height width value"], least: float
) -> Bool[Tensor, "view height width"]:
    """The pixels with a value that differs by at least `least` from that of a horizontal or vertical neighbour.

    Args:
        values: of pictures.
        least: difference.
    """
    found = torch.zeros(values.shape[:3], dtype=torch.bool, device=values.device)
    for one, other, differing in (
        (found[:, 1:], found[:, :-1], values.diff(dim=1)),
        (found[:, :, 1:], found[:, :, :-1], values.diff(dim=2)),
    ):
        beside = (differing.abs() >= least).any(-1)
        one |= beside
        other |= beside
    return found
