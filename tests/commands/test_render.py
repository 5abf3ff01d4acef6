"""Source of truth: what `render --help` says of --representation."""

from pathlib import Path

import pytest
import torch

from hyperplanes.commands.render import Arguments, Asked, _representation
from hyperplanes.geometry import cameras as camera


@pytest.mark.parametrize(
    ("settings", "animated", "expected"),
    [
        ({}, True, "auto"),
        ({}, False, "field"),  # query poses, whose pictures are compared
        ({"rendered_output_names": ("rgb", "depth")}, True, "field"),
        ({"protocol": "paper"}, True, "field"),
        ({"representation": "voxels"}, False, "voxels"),
        ({"representation": "field"}, True, "field"),
    ],
)
def test_voxels_may_draw_the_colours_of_animations(settings, animated, expected):
    arguments = Arguments(checkpoint="small", views=Path("views"), out=Path("out"), **settings)
    cameras = camera.pinhole(camera.symmetric_intrinsics(8, 8, 0.8), torch.eye(4)[None], 8, 8)
    asked = Asked(cameras, animation=("turntable", 4.0) if animated else None)
    assert _representation(arguments, asked) == expected
