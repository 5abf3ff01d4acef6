"""Pictures and their cameras as HTML, for the output cells of notebooks."""

from __future__ import annotations

import base64
from html import escape

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.encoding import encode_png

__all__ = ["show_views"]

MAX_IMAGES = 12  # pictures that are shown
IMAGE_HEIGHT = 96  # of each, in pixels
DIAGRAM_SIZE = 120  # of the drawing of the cameras, in pixels


def show_views(
    title: str, images: Float[Tensor, "view channel height width"], cameras: PinholeCamera, bounds: Sphere | None = None
) -> str:
    """HTML of some pictures, at most MAX_IMAGES of them, beside the cameras as they stand seen from above (along y).

    Args:
        title: a line above them.
        images: in [0, 1]; channels beyond the third are not shown, nor are images without channels.
        cameras: one an image.
        bounds: the sphere of the scene, drawn as a circle.
    """
    shown = "".join(_picture(image) for image in images[:MAX_IMAGES].detach().float().cpu() if len(image))
    more = f" and {len(images) - MAX_IMAGES} more" if len(images) > MAX_IMAGES else ""
    return f"<div><code>{escape(title)}</code><br>{_drawn(cameras, bounds or Sphere())}{shown}{more}</div>"


def _picture(image: Float[Tensor, "channel height width"]) -> str:
    """One image, reduced to IMAGE_HEIGHT, as a PNG within the page."""
    image = image[:3] if len(image) >= 3 else image[:1].expand(3, -1, -1)
    height, width = image.shape[1:]
    if height > IMAGE_HEIGHT:
        size = (IMAGE_HEIGHT, max(1, round(width * IMAGE_HEIGHT / height)))
        image = torch.nn.functional.interpolate(image[None], size, mode="area")[0]
    pixels = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
    data = base64.b64encode(encode_png(pixels)).decode()
    return f'<img src="data:image/png;base64,{data}" height="{IMAGE_HEIGHT}" style="margin:2px">'


def _drawn(cameras: PinholeCamera, bounds: Sphere) -> str:
    """The cameras from above: a dot where each stands, a line along which it looks."""
    parts = camera.centres(cameras), camera.viewing_directions(cameras)
    eyes, along = (part.detach().float().cpu()[:, [0, 2]] for part in parts)
    middle = torch.tensor([bounds.centre[0], bounds.centre[2]])
    reach = max(bounds.radius, float((eyes - middle).norm(dim=1).max()) if len(eyes) else 0.0) * 1.15
    points = ((eyes - middle) / reach + 1) * DIAGRAM_SIZE / 2
    ends = points + along * DIAGRAM_SIZE / 12
    lines = "".join(
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}" stroke="gray"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2"/>'
        for (x, y), (u, v) in zip(points.tolist(), ends.tolist(), strict=True)
    )
    half = DIAGRAM_SIZE / 2
    sphere = f'<circle cx="{half}" cy="{half}" r="{bounds.radius / reach * DIAGRAM_SIZE / 2:.1f}" fill="#e0e0e0"/>'
    return f'<svg width="{DIAGRAM_SIZE}" height="{DIAGRAM_SIZE}" style="vertical-align:middle">{sphere}{lines}</svg>'
