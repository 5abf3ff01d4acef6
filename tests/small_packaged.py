"""A very small packaged model, for tests of commands and pages that work with any packaged model."""

import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.checkpoints import packaged_folder
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.rendering import RayMarching
from tests.reference_rendering import awaken


@contextmanager
def small_packaged(**changes):
    """While active, `small` has few weights, voxels and samples, and does not search for symmetries and rotations.

    Args:
        changes: further changes of its configuration.
    """
    config = ModelConfig.load(packaged_folder("small"))
    network = replace(config.network, depth=1, width=16, point_frequencies=1)
    few = {"network": network, "hull_resolution": 16, "sampling": RayMarching(16)}
    model = awaken(HyperPlanes(replace(config, **few, symmetric=False, azimuth=0.0, **changes)))
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        model.save(Path(folder) / "small")
        patch.setattr("hyperplanes.adaptation.checkpoints.PACKAGED", Path(folder))
        yield
