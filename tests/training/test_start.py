"""Source of truth: the weights of the checkpoint that a training begins with."""

from dataclasses import replace

import torch

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.checkpoints import find_checkpoint
from hyperplanes.configuration.presets import preset
from hyperplanes.training.start import start_training
from tests.reference_rendering import Balls


def test_a_training_with_its_preset_begins_with_the_packaged_weights(tmp_path):
    """Also the networks of gating, correction and learned steps, which no preset has or training changes."""
    packaged, chosen = find_checkpoint("small"), preset("small")
    training = replace(chosen.training, steps=1, views=(2,), rays=4, tasks=1, volume_loss=0.0)
    trainer = start_training(chosen.model, training, Balls(), tmp_path, reference=packaged)
    weights = HyperPlanes.from_pretrained(packaged).state_dict()
    found = trainer.model.state_dict()
    assert found.keys() == weights.keys()
    assert all(torch.equal(value, weights[name]) for name, value in found.items())
    trainer.take_step()
    changed = {name for name, value in trainer.model.state_dict().items() if not torch.equal(value, weights[name])}
    assert any(name.startswith("hypernetwork.") for name in changed)
    assert not any(name.startswith(("gate.", "learned_step.", "corrector.")) for name in changed)


def test_the_preset_of_the_packaged_model_has_its_settings_of_views():
    model, packaged = preset("small").model, HyperPlanes.from_pretrained("small").config
    assert (model.stacked, model.symmetric) == (packaged.stacked, packaged.symmetric) == (True, True)
