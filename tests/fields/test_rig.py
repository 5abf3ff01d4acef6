"""Source of truth: SciPy's optimal assignment, given the same distances."""

import numpy as np
import pytest
import torch

from hyperplanes.fields.rig import match


@pytest.mark.parametrize("spread", [0.01, 1.0], ids=["nearest views apart", "nearest views shared"])
@pytest.mark.parametrize("views", [5, 12, 20])
def test_views_become_planes_as_near_together_as_can_be(views, spread):
    from scipy.optimize import linear_sum_assignment  # here: it takes 0.3 s of each process that looks for tests

    generator = torch.Generator().manual_seed(views)
    rig, noise = (torch.nn.functional.normalize(torch.randn(12, 3, generator=generator), dim=1) for _ in range(2))
    standing = torch.randn(20, 3, generator=generator)
    standing[:12] = rig + spread * noise
    standing = torch.nn.functional.normalize(standing[:views].flip(0), dim=1)
    cost = np.tile(1 - (rig.double() @ standing.double().T).numpy(), (1, -(-12 // views)))
    places = match(rig, standing)
    assert cost[range(12), places].sum() == pytest.approx(cost[linear_sum_assignment(cost)].sum(), abs=1e-5)
    assert places.bincount().max() <= -(-12 // views)
