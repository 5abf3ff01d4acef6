"""Source of truth: the weights of the checkpoint that a training begins with."""

import torch

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.checkpoints import find_checkpoint
from hyperplanes.configuration.presets import preset
from hyperplanes.training.start import start_training
from tests.reference_rendering import Balls


def test_a_training_with_its_preset_begins_with_the_packaged_weights(tmp_path):
    """The gating network and the learned steps are left out, since they are trained after the model."""
    packaged, chosen = find_checkpoint("small"), preset("small")
    trainer = start_training(chosen.model, chosen.training, Balls(), tmp_path, reference=packaged)
    weights = HyperPlanes.from_pretrained(packaged).state_dict()
    found = trainer.model.state_dict()
    later = [name for name in weights if name.startswith(("gate.", "learned_step."))]
    assert [name for name in weights if name not in found] == later
    assert all(torch.equal(value, weights[name]) for name, value in found.items() if name in weights)
    assert found.keys() <= weights.keys()


def test_the_preset_of_the_packaged_model_has_its_settings_of_views():
    model, packaged = preset("small").model, HyperPlanes.from_pretrained("small").config
    assert (model.stacked, model.symmetric) == (packaged.stacked, packaged.symmetric) == (True, True)
