"""Source of truth: the same models, made one after the other."""

from concurrent.futures import ThreadPoolExecutor

import torch

from hyperplanes.adaptation import HyperPlanes, ModelConfig
from hyperplanes.fields.base import TargetConfig

CONFIG = ModelConfig(hypernetwork=None, network=TargetConfig(planes=3, width=64, depth=4))


def test_models_made_by_several_threads_at_once_have_the_weights_of_their_seeds():
    before = torch.random.get_rng_state()
    expected = [HyperPlanes(CONFIG, seed).theta for seed in range(4)]
    with ThreadPoolExecutor(4) as threads:
        found = [each.theta for each in threads.map(lambda seed: HyperPlanes(CONFIG, seed), [0, 1, 2, 3] * 4)]
    for place, weights in enumerate(found):
        assert all(torch.equal(value, expected[place % 4][name]) for name, value in weights.items())
    assert torch.equal(torch.random.get_rng_state(), before)
