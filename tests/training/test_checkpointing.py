"""Source of truth: the exact weights that a training had when it wrote a file."""

import shutil
from dataclasses import replace

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.utilities.files.checkpoints import load_tensors
from tests.reference_rendering import Balls, awaken, small_model

CONFIG = TrainingConfig(steps=5, tasks=1, rays=8, evaluate_every=100, checkpoint_every=1, held_out=0)


def weights_of(model):
    return {name: value.clone() for name, value in model.state_dict().items()}


def same(one, other):
    return set(one) == set(other) and all((one[name] == other[name]).all() for name in one)


def test_the_last_states_are_kept_and_any_can_be_resumed(tmp_path):
    states = {}

    class Noted(Trainer):
        def take_step(self):
            loss = super().take_step()
            states[self.step] = weights_of(self.model)
            return loss

    config = replace(CONFIG, keep_last=3)
    whole = Noted(small_model(), Balls(), config, tmp_path)
    list(whole.run())
    kept = sorted(path.name for path in tmp_path.glob("training-*"))
    assert kept == [f"training-{step:08d}.{kind}" for step in (3, 4, 5) for kind in ("json", "safetensors")]
    for step in (3, 4, 5):
        found = load_tensors(tmp_path / f"training-{step:08d}.safetensors")
        assert same({k.removeprefix("model."): v for k, v in found.items() if k.startswith("model.")}, states[step])

    shutil.copy(tmp_path / "training-00000003.json", tmp_path / "training.json")
    again = Trainer(small_model(), Balls(), replace(config, keep_last=1), tmp_path)
    assert again.step == 3
    assert same(again.model.state_dict(), states[3])
    again.take_step()
    again.save()
    assert [path.name for path in tmp_path.glob("training-*")] == ["training-00000004.safetensors"]
    list(again.run())
    assert same(again.model.state_dict(), states[5])


def test_the_best_model_is_that_of_the_validation_with_the_highest_quality(tmp_path):
    qualities, weights = [3.0, 7.0, 5.0, 7.0, 6.0], []

    class Judged(Trainer):
        def validate(self):
            weights.append(weights_of(self.model))
            return replace(super().validate(), psnr=qualities[self.step - 1])

    def judged(steps, folder):
        config = replace(CONFIG, evaluate_every=1, steps=steps, held_out=1)
        trainer = Judged(awaken(small_model()), Balls(), config, folder)
        list(trainer.run())

    judged(5, tmp_path / "whole")
    best = HyperPlanes.from_pretrained(tmp_path / "whole" / "best").state_dict()
    assert same(best, weights[1])  # the first of two that are equal
    assert not same(best, weights[3])

    for steps in (3, 5):  # resumed after the best validation
        judged(steps, tmp_path / "parts")
    assert same(HyperPlanes.from_pretrained(tmp_path / "parts" / "best").state_dict(), best)
