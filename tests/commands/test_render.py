"""Source of truth: what `render --help` says of --representation."""

from pathlib import Path

import pytest
import torch

from hyperplanes.commands.render import Arguments, Asked, _takes_voxels
from hyperplanes.geometry import cameras as camera


@pytest.mark.parametrize(
    ("settings", "frames", "side", "shown", "animated", "expected"),
    [
        ({}, 48, 400, 25, True, True),
        ({}, 48, 64, 25, True, False),  # fewer than two million pixels
        ({}, 48, 400, 15, True, False),  # fewer than 16 views
        ({}, 48, 400, 25, False, False),  # query poses, whose pictures are compared
        ({"rendered_output_names": ("rgb", "depth")}, 48, 400, 25, True, False),
        ({"protocol": "paper"}, 48, 400, 25, True, False),
        ({"representation": "voxels"}, 1, 8, 3, False, True),
        ({"representation": "field"}, 48, 400, 25, True, False),
    ],
)
def test_voxels_draw_long_animations_of_many_views(settings, frames, side, shown, animated, expected):
    arguments = Arguments(checkpoint="small", views=Path("views"), out=Path("out"), **settings)
    poses = torch.eye(4).expand(frames, 4, 4)
    cameras = camera.pinhole(camera.symmetric_intrinsics(side, side, 0.8), poses, side, side)
    asked = Asked(cameras, animation=("turntable", 4.0) if animated else None)
    assert _takes_voxels(arguments, asked, shown) is expected
