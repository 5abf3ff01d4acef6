"""Source of truth: closed forms of the opacity of a constant density, and of the share of a ball in half a grid."""

import math
from types import SimpleNamespace

import pytest
import torch

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.geometry import Sphere
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.rendering import RayMarching
from hyperplanes.training.losses import EMPTINESS_WEIGHT, EmptinessLoss

DENSITY = 2.5


@pytest.mark.parametrize(("occupied", "share"), [(0, 1.0), (8, 0.5), (16, 0.0)])
@pytest.mark.parametrize("networks", [1, 2])
@pytest.mark.parametrize("unit", [1.0, 50.0])
def test_only_density_outside_the_hull_counts_in_every_unit(occupied, share, networks, unit):
    bounds = Sphere((3.0 * unit, 0.0, -unit), 2 * unit)
    voxels = torch.zeros(16, 16, 16, dtype=torch.bool)
    voxels[:occupied] = True
    scale = torch.ones((), requires_grad=True)

    def density(points):
        assert ((points - torch.tensor(bounds.centre)).norm(dim=1) <= bounds.radius * 1.001).all()
        return scale * torch.full((len(points),), DENSITY / unit)

    field = AdaptedField(None, Occupancy(voxels, bounds), RayMarching(), densities=(density,) * networks)
    loss = EmptinessLoss(4000)(SimpleNamespace(field=field, generator=torch.Generator().manual_seed(0)))
    expected = networks * share * EMPTINESS_WEIGHT * (1 - math.exp(-DENSITY * 2 / 10))
    assert float(loss.detach()) == pytest.approx(expected, rel=0.05, abs=1e-12)
    if share:
        loss.backward()
        assert float(scale.grad) > 0
