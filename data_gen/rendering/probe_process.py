"""Program to probe one renderer: `python -m data_gen.rendering.probe_process NAME` renders and checks a picture.

It runs in its own process, since a broken renderer may crash it.
"""

from __future__ import annotations

import sys

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals

from data_gen.rendering.mesh_renderer import MeshRenderer
from data_gen.rendering.renderers import RendererError
from data_gen.rigs import Rig, look_at_origin

__all__ = ["draw_test_image"]


def draw_test_image(name: str) -> str:
    """Render a picture whose left half is red, and check it.

    Returns:
        A description of the renderer, one line.

    Raises:
        RendererError: if the picture is wrong.
    """
    corners = [[-9.0, -9.0, 0.0], [0.0, -9.0, 0.0], [0.0, 9.0, 0.0], [-9.0, 9.0, 0.0]]
    sheet = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    sheet.visual = ColorVisuals(sheet, vertex_colors=[[255, 0, 0, 255]] * 4)
    intrinsics = np.array([[16.0, 0.0, 7.5], [0.0, 16.0, 7.5], [0.0, 0.0, 1.0]])
    rig = Rig(look_at_origin([[0.0, 0.0, 2.0]]), intrinsics, 16, 16, 1.0, 3.0)
    renderer = MeshRenderer(name)
    picture = np.asarray(renderer.render([sheet], rig).rgba)[0].astype(int)
    left, right = picture[:, :8], picture[:, 8:]
    red = (left[..., 3] == 255) & (left[..., 0] > 40) & (left[..., 0] > 2 * left[..., 1])
    if not red.all() or right[..., 3].any():
        raise RendererError(
            f"expected a red left half, got {left[8, 4].tolist()} there, and alpha {right[..., 3].max()} outside"
        )
    return renderer.detail


if __name__ == "__main__":
    sys.stdout.write(draw_test_image(sys.argv[1]) + "\n")
