import json

import pytest
import torch

from hyperplanes.checkpoints import CheckpointError
from hyperplanes.hypernetwork import HyperNetworkConfig
from hyperplanes.rendering import Hierarchical
from hyperplanes.training import Trainer, TrainingConfig, train
from tests.reference_rendering import Balls, small_model

FAST = TrainingConfig(steps=6, rays=32, evaluate_every=100, checkpoint_every=100, learning_rate=1e-3)


def with_(config=FAST, **changes):
    return TrainingConfig(**{**config.__dict__, **changes})


def losses(model, config, steps=None):
    trainer = Trainer(model, Balls(), config)
    return [trainer.take_step() for _ in range(steps or config.steps)]


def state_of(model):
    return {name: value.clone() for name, value in model.state_dict().items()}


def same(one, other):
    return set(one) == set(other) and all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize(
    "parts", [{}, {"hypernetwork": None}, {"coarse_network": True, "sampling": Hierarchical(8, 8)}], ids=str
)
def test_the_loss_falls(parts):
    found = losses(small_model(**parts), with_(steps=40, learning_rate=5e-3, hypernetwork_learning_rate=2e-3))
    assert sum(found[-5:]) < 0.5 * sum(found[:5])


def test_the_same_seed_makes_the_same_curve_and_the_same_weights():
    first, second, third = small_model(), small_model(), small_model()
    curve = losses(first, FAST, 4)
    before = torch.random.get_rng_state()
    assert losses(second, FAST, 4) == curve
    assert torch.equal(before, torch.random.get_rng_state())
    assert same(first.state_dict(), second.state_dict())
    assert losses(third, with_(seed=1), 4) != curve


def test_every_step_draws_anew():
    still = with_(learning_rate=0.0, hypernetwork_learning_rate=0.0)
    assert len(set(losses(small_model(), still, 6))) == 6


@pytest.mark.parametrize("normalisation", ["batch", "group"])
def test_an_interrupted_training_ends_where_an_uninterrupted_one_does(tmp_path, normalisation):
    shape = HyperNetworkConfig(views=2, normalisation=normalisation, code=8, depth=2, width=16)
    config = with_(steps=5, warmup=2, final=0.1)
    whole = train(small_model(hypernetwork=shape), Balls(), config, tmp_path / "whole")

    first = Trainer(small_model(hypernetwork=shape), Balls(), config, tmp_path / "parts")
    for _ in range(3):
        first.take_step()
    first.save()
    first.take_step()  # lost: the training was stopped before the next checkpoint
    resumed = Trainer(small_model(hypernetwork=shape), Balls(), config, tmp_path / "parts")
    assert resumed.step == 3
    list(resumed.run())
    assert resumed.step == 5
    assert resumed.curve == whole.curve
    assert same(resumed.model.state_dict(), whole.model.state_dict())
    for one, other in zip(resumed.optimisers, whole.optimisers, strict=True):
        states = one.state_dict()["state"], other.state_dict()["state"]
        for place in states[0]:
            assert same(states[0][place], states[1][place])


def test_a_finished_training_is_not_repeated(tmp_path):
    done = train(small_model(), Balls(), with_(steps=2), tmp_path)
    weights = state_of(done.model)
    again = train(small_model(), Balls(), with_(steps=2), tmp_path)
    assert again.step == 2
    assert same(again.model.state_dict(), weights)


def test_a_training_with_other_options_is_not_resumed(tmp_path):
    train(small_model(), Balls(), with_(steps=1), tmp_path)
    with pytest.raises(CheckpointError) as caught:
        Trainer(small_model(), Balls(), with_(steps=1, rays=64, seed=3), tmp_path)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in ("training.json", "expected the same training", "rays", "seed", "--out"))
    Trainer(small_model(), Balls(), with_(steps=9), tmp_path)  # more steps of the same training are fine


def test_a_checkpoint_of_another_model_is_not_resumed(tmp_path):
    train(small_model(), Balls(), with_(steps=1), tmp_path)
    with pytest.raises(CheckpointError, match="of another model"):
        Trainer(small_model(hypernetwork=None), Balls(), with_(steps=1), tmp_path)


def test_theta_and_the_hypernetwork_have_optimisers_of_their_own():
    model = small_model()
    trainer = Trainer(model, Balls(), with_(learning_rate=3e-3, hypernetwork_learning_rate=1e-4))
    groups = [{id(value) for group in o.param_groups for value in group["params"]} for o in trainer.optimisers]
    assert groups == [{id(value) for value in part.parameters()} for part in (model.networks, model.hypernetwork)]
    trainer.take_step()
    assert [optimiser.param_groups[0]["lr"] for optimiser in trainer.optimisers] == [3e-3, 1e-4]


@pytest.mark.parametrize("frozen", ["theta", "hypernetwork"])
def test_a_rate_of_zero_freezes_its_part_alone(frozen):
    rates = {"learning_rate": 1e-2, "hypernetwork_learning_rate": 1e-2}
    rates["learning_rate" if frozen == "theta" else "hypernetwork_learning_rate"] = 0.0
    model = small_model()
    before = state_of(model)
    losses(model, with_(**rates), 2)
    moved = {name.split(".")[0] for name, value in model.named_parameters() if not torch.equal(value, before[name])}
    assert moved == ({"hypernetwork"} if frozen == "theta" else {"networks"})


def test_without_a_hypernetwork_theta_alone_is_trained():
    trainer = Trainer(small_model(hypernetwork=None), Balls(), FAST)
    assert len(trainer.optimisers) == 1


def test_rates_rise_in_the_warm_up_and_fall_along_half_a_cosine():
    # 2 steps of warm-up: 1/2, 1; then half a cosine over 4 steps from 1 towards 0.2: at 0, 1/4, 1/2, 3/4 of it
    trainer = Trainer(small_model(), Balls(), with_(steps=6, warmup=2, final=0.2, learning_rate=1.0))
    rates = []
    for _ in range(6):
        trainer.take_step()
        rates.append(trainer.optimisers[0].param_groups[0]["lr"])
    half = 2**-0.5
    expected = [0.5, 1.0, 1.0, 0.2 + 0.4 * (1 + half), 0.6, 0.2 + 0.4 * (1 - half)]
    assert rates == pytest.approx(expected)


def test_the_paper_keeps_its_rate():
    trainer = Trainer(small_model(), Balls(), with_(steps=3))
    for _ in range(3):
        trainer.take_step()
        assert trainer.optimisers[0].param_groups[0]["lr"] == 1e-3


def test_several_objects_a_step_are_averaged():
    assert all(0 < loss < 1 for loss in losses(small_model(), with_(tasks=3), 2))


def test_objects_that_fall_out_of_memory_change_nothing():
    assert losses(small_model(), with_(cached=1), 5) == losses(small_model(), FAST, 5)


def test_only_training_objects_are_trained_on():
    data = Balls()
    asked = []
    task = data.task
    data.task = lambda name: asked.append(name) or task(name)
    trainer = Trainer(small_model(), data, FAST)
    for _ in range(6):
        trainer.take_step()
    assert set(asked) <= set(data.names("train"))
    trainer.held_out_psnr()
    assert asked[-1] in data.names("test")


def test_progress_is_reported_with_the_held_out_quality(tmp_path):
    reports = []
    config = with_(steps=27, rays=8, evaluate_every=26, checkpoint_every=26)
    trainer = train(small_model(), Balls(), config, tmp_path, reports.append)
    assert [report.step for report in reports] == [25, 26, 27]
    assert reports[0].psnr is None
    assert all(0 < report.psnr < 60 for report in reports[1:])
    assert all(report.loss > 0 and report.rays_per_second > 0 and report.seconds_left >= 0 for report in reports)
    assert reports[-1].seconds_left == 0
    assert [entry["step"] for entry in trainer.curve] == [25, 26, 27]
    assert json.loads((tmp_path / "training.json").read_text())["curve"] == trainer.curve


def test_no_held_out_objects_have_no_quality():
    assert Trainer(small_model(), Balls(test=0), FAST).held_out_psnr() is None


def test_no_training_object_is_refused():
    with pytest.raises(ValueError, match="data: expected at least one training object, got none"):
        Trainer(small_model(), Balls(train=0), FAST)
