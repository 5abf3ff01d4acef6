"""Source of truth: the help text of `render --representation`."""

from pathlib import Path

import pytest
import torch

from hyperplanes.commands.render import Arguments, Asked, _representation
from hyperplanes.geometry import cameras as camera


@pytest.mark.parametrize(
    ("settings", "animated", "expected"),
    [
        ({}, True, "auto"),
        ({}, False, "field"),  # pictures of query poses are compared with images
        ({"rendered_output_names": ("rgb", "depth")}, True, "field"),
        ({"protocol": "paper"}, True, "field"),
        ({"representation": "voxels"}, False, "voxels"),
        ({"representation": "field"}, True, "field"),
    ],
)
def test_voxels_are_used_only_for_colours_of_animations(settings, animated, expected):
    arguments = Arguments(checkpoint="small", views=Path("views"), out=Path("out"), **settings)
    cameras = camera.pinhole(camera.symmetric_intrinsics(8, 8, 0.8), torch.eye(4)[None], 8, 8)
    asked = Asked(cameras, animation=("turntable", 4.0) if animated else None)
    assert _representation(arguments, asked) == expected
