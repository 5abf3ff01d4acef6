"""Baked voxels as an HTML file, or part of a page: a viewer to turn the object by mouse or touch."""

from __future__ import annotations

import base64
import html
import json
import math
import zlib
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.export.baking import BakedScene
from hyperplanes.export.images import encode_animation, orbit_cameras, to_pixels, upward
from hyperplanes.fields.baked import HARMONICS, BakedField
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.views import Views

__all__ = ["MAX_PAGE_BYTES", "PAGE_FRAME_BYTES", "address_of", "page_of", "save_page", "turning_picture"]

MAX_PAGE_BYTES = 8_000_000
"""Most bytes of a page. Beyond it, coefficients get fewer bits, those of second order first."""

PAGE_FRAME_BYTES = 4096
"""Of these, bytes for the frame of `save_page`: some 500, and twice the escaped title of at most 255."""

BITS = ((8, 8, 8), (8, 7, 6), (8, 6, 5), (8, 6, 4), (7, 5, 3), (7, 5, 0))
"""Bits of the mean colour, the first and the second order; 0 omits an order. Tried in turn until the page fits."""

TURNTABLE_FRAMES, TURNTABLE_SIZE = 24, 256  # of a turntable; pixels along the longer side
OWN = 8.0  # weight of a voxel's own colour, beside 1 of each neighbour, when colours are prepared for the page
CLAMP = 1e-3  # share of a coefficient's values clamped at either end of its range
STYLE = """<style>
.voxels { position: relative; aspect-ratio: 1; width: 100%; overflow: hidden; background: #fff; }
.voxels canvas, .voxels img { position: absolute; inset: 0; width: 100%; height: 100%; object-fit: contain; }
.voxels canvas { touch-action: none; cursor: grab; outline-offset: -2px; }
.voxels canvas:active { cursor: grabbing; }
</style>"""
PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
html, body {{ margin: 0; height: 100%; background: #fff; font: 14px/1.4 system-ui, sans-serif; color: #555; }}
body {{ display: flex; flex-direction: column; }}
body > .voxels {{ flex: 1; min-height: 0; aspect-ratio: auto; }}
body > p {{ margin: .3em 1em; }}
</style>
</head>
<body>
{fragment}
<p>{title}: drag to turn, wheel or two fingers to zoom, double click to begin again</p>
</body>
</html>
"""


def page_of(
    baked: BakedField, views: Views, *, picture: bytes = b"", largest: int = MAX_PAGE_BYTES - PAGE_FRAME_BYTES
) -> str:
    """An HTML fragment that renders baked voxels by WebGL2; a page may hold any number of them.

    Args:
        baked: the voxels to show.
        views: give up, distance and lens of the initial camera.
        picture: a WebP file, animated or not, shown until the voxels are, or if they cannot be.
        largest: most bytes of the result, in UTF-8.

    Returns:
        A self-contained `<div class="voxels">`, as wide as its parent and square unless styled otherwise. `address_of`
        gives the URL fragment for a camera.

    Raises:
        ValueError: voxels that do not fit.
    """
    # the initial camera
    start = orbit_cameras(views, 1)
    intrinsics, (height, width) = camera.intrinsics(start)[0], camera.image_size(start)
    scene = {
        "side": baked.side,
        "rows": len(baked.values),
        "centre": baked.bounds.centre,
        "radius": baked.bounds.radius,
        "steps": BakedScene.steps,
        "up": upward(views.cameras),
        "eye": camera.centres(start)[0].tolist(),
        "focal": (float(intrinsics[0, 0]) / width, float(intrinsics[1, 1]) / height),
    }
    still = f'<img alt="" src="data:image/webp;base64,{base64.b64encode(picture).decode()}">' if picture else ""
    viewer = resources.files("hyperplanes.export").joinpath("viewer.js").read_text("utf-8")
    size = 0
    # as many bits per number as the size allows
    for bits in BITS:
        low, span, text = _encoded(baked, bits)
        described = json.dumps({**scene, "low": low, "range": span})
        part = (
            f'{STYLE}\n<div class="voxels">{still}<script type="application/json">{described}</script>'
            f'<script type="text/plain">{text}</script></div>\n'
            f"<script>\n{viewer}showVoxels(document.currentScript.previousElementSibling);\n</script>"
        )
        size = len(part.encode())
        if size <= largest:
            return part
    raise ValueError(
        f"page: expected at most {largest / 1e6:.3g} MB, got {size / 1e6:.3g} MB of {len(baked.values):,} voxels and a "
        f"picture of {len(picture) / 1e6:.3g} MB; bake fewer voxels than {baked.side} along an axis"
    )


def save_page(fragment: str, path: str | Path, title: str) -> Path:
    """Write a fragment as a self-contained HTML file.

    Args:
        fragment: of `page_of`.
        path: of the file.
        title: of the page.

    Returns:
        The file.
    """
    path = Path(path)
    write_whole(path, PAGE.format(fragment=fragment, title=html.escape(title)).encode())
    return path


def address_of(cameras: PinholeCamera) -> str:
    """The URL fragment by which a page shows one camera's view, at its size in the upper left corner.

    Args:
        cameras: a batch of one.

    Returns:
        `#camera=` and 18 numbers: camera_from_world row by row without its last row, fx, fy, cx and cy with integer
        pixel centres, width and height.

    >>> address_of(camera.pinhole(torch.eye(3), torch.eye(4)[None], 4, 6))
    '#camera=1,0,0,0,0,1,0,0,0,0,1,0,1,1,0,0,6,4'
    """
    matrix = camera.intrinsics(cameras)[0]
    height, width = camera.image_size(cameras)
    numbers = camera.camera_from_world(cameras)[0, :3].flatten().tolist()
    numbers += [matrix[0, 0].item(), matrix[1, 1].item(), matrix[0, 2].item(), matrix[1, 2].item(), width, height]
    return "#camera=" + ",".join(f"{number:.9g}" for number in numbers)


def turning_picture(baked: BakedField, views: Views) -> bytes:
    """A turntable as an animated WebP, for `page_of` to fall back to.

    Args:
        baked: the voxels to render.
        views: give lens, distance and up.
    """
    images = BakedScene(baked).render(orbit_cameras(views, TURNTABLE_FRAMES, size=TURNTABLE_SIZE)).images
    return encode_animation(to_pixels(images), "webp")


def _encoded(baked: BakedField, bits: tuple[int, int, int]) -> tuple[list[float], list[float], str]:
    """Lowest value and range of every coefficient, and the voxels in base 64.

    The voxels are an occupancy bit each, the upper and lower bytes of the optical depths in half precision, and a byte
    per coefficient, one coefficient after the other, compressed by deflate.
    """
    filled = baked.index.flatten() >= 0
    order = baked.index.flatten()[filled].long()
    packed = np.packbits(filled.numpy(), bitorder="little").tobytes()
    voxel = 2 * baked.bounds.radius / baked.side
    halves = (baked.values[order, 0] * voxel).clamp(0, 100).half().view(torch.int16).int()
    depth = torch.stack([halves >> 8 & 255, halves & 255]).byte()
    values = _smoothed(baked)[order]
    edges = torch.stack([_quantile(values, CLAMP), _quantile(values, 1 - CLAMP)])
    low, span = edges[0], (edges[1] - edges[0]).clamp_min(1e-6)
    orders = torch.tensor([bits[0], *[bits[1]] * 3, *[bits[2]] * 5] * 3)
    levels = (2.0**orders - 1).clamp_min(1)
    low, span = torch.where(orders > 0, low, 0.0), torch.where(orders > 0, span, 0.0)
    scaled = ((values - low) / span.clamp_min(1e-6)).clamp(0, 1)
    coefficients = ((scaled * levels).round() / levels * 255).round().byte().T * (orders > 0)[:, None]
    content = packed + b"".join(part.contiguous().numpy().tobytes() for part in (depth, coefficients))
    return low.tolist(), span.tolist(), base64.b64encode(zlib.compress(content, 9)).decode()


def _quantile(values: Float[Tensor, "row number"], share: float) -> Float[Tensor, " number"]:
    place = min(len(values), max(1, math.ceil(share * len(values))))
    return values.kthvalue(place, dim=0).values


def _smoothed(baked: BakedField) -> Float[Tensor, "row 27"]:
    """Colours to be interpolated without density weights: voxels of low density take those of denser neighbours."""
    padded = torch.nn.functional.pad(baked.index, (1,) * 6, value=-1)
    place = (baked.index >= 0).nonzero() + 1
    row = baked.index[baked.index >= 0].long()
    density = baked.values[:, :1]
    colour = torch.cat([density * baked.values[:, 1:], density], 1)
    total = OWN * colour
    for axis in range(3):
        for step in (-1, 1):
            there = place.clone()
            there[:, axis] += step
            beside = padded[there[:, 0], there[:, 1], there[:, 2]].long()
            found = beside >= 0
            total[row[found]] += colour[beside[found]]
    return torch.where(total[:, -1:] > 0, total[:, :-1] / total[:, -1:].clamp_min(1e-20), baked.values[:, 1:])


assert HARMONICS == 9  # as in the viewer's shader
