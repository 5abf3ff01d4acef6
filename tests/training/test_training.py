"""Sources of truth: uninterrupted trainings, which resumed ones equal exactly, steps of the optimisers by hand, and
properties of what is drawn.
"""

import csv
import json
import shutil
import signal
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.adaptation import Diagnostics, HyperPlanes, base, diagnose
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.train import follow
from hyperplanes.fields.base import Field
from hyperplanes.geometry import cameras, occupancy
from hyperplanes.hypernetwork import ImageHyperNetworkConfig
from hyperplanes.parameters import Parameters
from hyperplanes.rendering import Hierarchical, RayMarching
from hyperplanes.training import Trainer, TrainingConfig, checkpointing, objective, train
from hyperplanes.training.forward import forward
from hyperplanes.training.losses import losses_of
from hyperplanes.training.monitoring import TensorBoard
from hyperplanes.utilities.files import checkpoints, writing
from hyperplanes.utilities.files.checkpoints import CheckpointError, read_json
from hyperplanes.utilities.files.settings import SettingsError, structure
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.utilities.machine.interrupts import HungUp, Terminated
from tests.reference_rendering import Balls, awaken, small_model
from tests.training.test_volume_loss import MODEL

FAST = TrainingConfig(
    steps=6, tasks=2, rays=32, evaluate_every=100, checkpoint_every=100, learning_rate=1e-3, precision="single"
)


def with_(config=FAST, **changes):
    return TrainingConfig(**{**config.__dict__, **changes})


def losses(model, config, steps=None):
    trainer = Trainer(model, Balls(), config)
    return [trainer.take_step() for _ in range(steps or config.steps)]


def state_of(model):
    return {name: value.clone() for name, value in model.state_dict().items()}


def same(one, other):
    return set(one) == set(other) and all(torch.equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def trained_once(tmp_path_factory):
    """The folder of a training of one step."""
    folder = tmp_path_factory.mktemp("trained") / "once"
    train(small_model(), Balls(), with_(steps=1), folder)
    return folder


@pytest.fixture
def trained(trained_once, tmp_path):
    """A copy of that folder."""
    return Path(shutil.copytree(trained_once, tmp_path / "copy"))


@pytest.mark.parametrize(
    "parts", [{}, {"hypernetwork": None}, {"coarse_network": True, "sampling": Hierarchical(8, 8)}], ids=str
)
def test_the_loss_falls(parts):
    found = losses(small_model(**parts), with_(steps=12, learning_rate=2e-2, hypernetwork_learning_rate=5e-3))
    assert sum(found[-3:]) < 0.5 * sum(found[:3])


@pytest.mark.parametrize(
    ("make", "training"),
    [
        (lambda: awaken(small_model()), {}),
        (lambda: small_model(hypernetwork=None), {}),
        (lambda: awaken(HyperPlanes(MODEL)), {"tasks": 4, "views": (1, 3), "volume_loss": 0.1}),
        (lambda: awaken(HyperPlanes(MODEL)), {"reference_objects": 2}),
    ],
    ids=["hypernetwork", "target alone", "volumes", "volumes that are not rendered"],
)
def test_gradients_computed_per_object_are_those_of_one_loss_of_all_objects(make, training):
    config = with_(empty_points=50, **training)

    def begun():
        torch.manual_seed(0)  # awaken draws random numbers
        return Trainer(make(), Balls(), config)

    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            trainer = begun()
            trainer.model.train()
            loss = trainer.objective.gradients(trainer.loader.batch(0))
            found.append((loss, {name: value.grad for name, value in trainer.model.named_parameters()}))
    finally:
        torch.set_num_threads(before)
    # the mean over the objects of the sums of their losses, in one backward pass
    trainer = begun()
    model, batch = trainer.model.train(), trainer.loader.batch(0)
    updates = model.updates([each.episode.prepared for each in (*batch.rendered, *batch.reference)])
    outputs = [forward(model, draw, update, config) for draw, update in zip(batch.rendered, updates, strict=False)]
    expected = torch.stack([each(output) for output in outputs for each in losses_of(config)]).sum() / config.tasks
    expected.backward()
    for loss, gradients in found:
        assert loss == pytest.approx(float(expected.detach()))
        for name, value in model.named_parameters():
            torch.testing.assert_close(gradients[name], value.grad)


@pytest.mark.parametrize("threads", [1, 2])
def test_bfloat16_changes_updates_and_gradients_little_and_keeps_their_dtype(threads):
    found, before = {}, torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for precision in ("single", "bfloat16"):
            torch.manual_seed(0)
            trainer = Trainer(awaken(HyperPlanes(MODEL)), Balls(), with_(precision=precision, tasks=2 * threads))
            trainer.model.train()
            trainer.objective.gradients(trainer.loader.batch(0))
            named = trainer.model.named_parameters()
            gradients = torch.cat([value.grad.flatten() for _, value in named if value.grad is not None])
            updates = [value for update in trainer.objective.updates for value in update.values()]
            found[precision] = [*updates, gradients]
    finally:
        torch.set_num_threads(before)
    for single, half in zip(found["single"], found["bfloat16"], strict=True):
        assert half.dtype == torch.float32
        assert 0 < (half - single).norm() < 0.03 * single.norm()


def test_the_dtypes_of_updates_without_mixed_precision_with_it_and_under_autocast():
    model = awaken(HyperPlanes(MODEL)).eval()
    context = model.prepare(Balls().task("train0").support)
    (single,), (half,) = ([u["fine.grid.weight"] for u in model.updates([context], mixed_precision=m)] for m in (0, 1))
    with torch.autocast("cpu", torch.bfloat16):  # the caller's autocast decides the dtype
        (own,) = model.updates([context])
    assert (single.dtype, half.dtype, own["fine.grid.weight"].dtype) == (*2 * (torch.float32,), torch.bfloat16)
    assert torch.equal(half, own["fine.grid.weight"].float())


@pytest.mark.parametrize(
    ("precision", "fast", "volumes", "expected"),
    [
        ("automatic", True, True, "bfloat16"),
        ("automatic", True, False, "single"),
        ("automatic", False, True, "single"),
        ("single", True, True, "single"),
        ("bfloat16", False, False, "bfloat16"),
    ],
)
def test_bfloat16_is_used_where_it_is_fast_and_exact_enough_or_requested(
    monkeypatch, precision, fast, volumes, expected
):
    monkeypatch.setattr(checkpointing, "has_fast_bfloat16", lambda: fast)
    model, asked = HyperPlanes(MODEL) if volumes else small_model(), []
    trainer, updates = Trainer(model, Balls(), with_(precision=precision)), model.updates
    assert trainer.config.precision == expected
    model.updates = lambda *given, **named: asked.append(named) or updates(*given, **named)
    trainer.take_step()
    assert asked == [{"mixed_precision": expected == "bfloat16"}]


@pytest.mark.parametrize("begun", ["single", "bfloat16"])
def test_a_resumed_training_keeps_its_precision(monkeypatch, tmp_path, begun):
    """The precision does not depend on the processor that resumes the training."""
    Trainer(awaken(HyperPlanes(MODEL)), Balls(), with_(precision=begun), tmp_path).save()
    for fast in (True, False):
        monkeypatch.setattr(checkpointing, "has_fast_bfloat16", lambda fast=fast: fast)
        again = Trainer(HyperPlanes(MODEL), Balls(), with_(precision="automatic"), tmp_path)
        assert again.config.precision == begun
    other = "single" if begun == "bfloat16" else "bfloat16"
    with pytest.raises(CheckpointError, match="found other precision"):
        Trainer(HyperPlanes(MODEL), Balls(), with_(precision=other), tmp_path)
    document = json.loads((tmp_path / "training.json").read_text())
    document["config"]["precision"] = 5
    (tmp_path / "training.json").write_text(json.dumps(document))
    with pytest.raises(CheckpointError, match=r"training\.json: (?!.*something else).* found other precision"):
        Trainer(HyperPlanes(MODEL), Balls(), with_(precision="automatic"), tmp_path)


def test_an_unknown_precision_is_refused_in_code_and_in_settings():
    expected = "expected one of 'automatic', 'single', 'bfloat16', got 'half'"
    with pytest.raises(ValueError, match=f"precision: {expected}"):
        with_(precision="half")
    with pytest.raises(SettingsError, match=expected):
        structure(TrainingConfig, {"precision": "half"})


@pytest.mark.parametrize("safe", [True, False])
def test_objects_have_separate_threads_if_the_field_is_thread_safe(safe, monkeypatch):
    trainer, callers = Trainer(small_model(hypernetwork=None), Balls(), with_(rays=1)), set()

    def noting(*given):
        callers.add(threading.get_ident())
        return forward(*given)

    monkeypatch.setattr(Field, "thread_safe", safe)
    monkeypatch.setattr(objective, "forward", noting)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        trainer.take_step()
    finally:
        torch.set_num_threads(before)
    here = threading.get_ident()
    assert here not in callers if safe else callers == {here}


@pytest.mark.parametrize(
    ("volumes", "threads", "tasks", "expected"),
    [
        (True, 1, 4, [4]),
        (True, 2, 4, [2, 2]),
        (True, 2, 5, [3, 2]),
        (True, 2, 3, [3]),
        (True, 3, 4, [4]),
        (True, 3, 7, [3, 2, 2]),
        (True, 4, 9, [3, 2, 2, 2]),
        (False, 2, 4, [4]),
    ],
)
def test_independent_objects_pass_the_hypernetwork_in_groups_of_at_least_two(volumes, threads, tasks, expected):
    model, sizes = HyperPlanes(MODEL) if volumes else small_model(), []
    trainer = Trainer(model, Balls(), with_(tasks=tasks, rays=1))
    model.updates = lambda objects, **named: sizes.append(len(objects)) or [Parameters()] * len(objects)  # no updates
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        trainer.take_step()
    finally:
        torch.set_num_threads(before)
    assert sorted(sizes, reverse=True) == expected


def test_the_same_seed_gives_the_same_curve_and_weights():
    first, second, third = small_model(), small_model(), small_model()
    curve = losses(first, FAST, 2)
    before = torch.random.get_rng_state()
    assert losses(second, FAST, 2) == curve
    assert torch.equal(before, torch.random.get_rng_state())
    assert same(first.state_dict(), second.state_dict())
    assert losses(third, with_(seed=1), 2) != curve


def test_every_step_draws_other_rays():
    still = with_(learning_rate=0.0, hypernetwork_learning_rate=0.0)
    assert len(set(losses(small_model(), still, 3))) == 3


ALL_LAYERS = {"layers": ("all",), "update": "low_rank", "weights_seen": "all"}


@pytest.mark.parametrize(
    ("optimiser", "parts", "changes"),
    [
        ("adam", {"normalisation": "batch"}, {"clip": 0.05}),
        ("muon", {"normalisation": "group"}, {"balanced": True}),
        ("muon", ALL_LAYERS, {}),
    ],
    ids=str,
)
def test_an_interrupted_training_ends_where_an_uninterrupted_one_does(tmp_path, optimiser, parts, changes):
    shape = ImageHyperNetworkConfig(**{"views": 2, "code": 8, "depth": 2, "width": 16, **parts})
    config = with_(steps=4, rays=16, warmup=2, final_rate_factor=0.1, optimiser=optimiser, **changes)
    whole = train(small_model(hypernetwork=shape), Balls(), config, tmp_path / "whole")

    first = Trainer(small_model(hypernetwork=shape), Balls(), config, tmp_path / "parts")
    for _ in range(2):
        first.take_step()
    first.save()
    first.take_step()  # lost, since no checkpoint follows
    resumed = Trainer(small_model(hypernetwork=shape), Balls(), config, tmp_path / "parts")
    assert resumed.step == 2
    list(resumed.run())
    assert resumed.step == 4
    assert resumed.curve == whole.curve
    assert same(resumed.model.state_dict(), whole.model.state_dict())
    for one, other in zip(resumed.optimisation.optimisers, whole.optimisation.optimisers, strict=True):
        states = one.state_dict()["state"], other.state_dict()["state"]
        for place in states[0]:
            assert same(states[0][place], states[1][place])


@pytest.mark.parametrize("reference_objects", [0, 3])
def test_reference_objects_remove_the_mean_of_the_gradients_of_codes(reference_objects):
    # Property: with batch normalisation over the objects of a step, the gradient sums to zero over the objects.
    shape = ImageHyperNetworkConfig(views=2, code=8, depth=2, width=16, normalisation="group", **ALL_LAYERS)
    model = awaken(small_model(hypernetwork=shape))
    trainer = Trainer(model, Balls(), with_(tasks=1, reference_objects=reference_objects))
    trainer.take_step()  # sets the running statistics
    gradients = []
    model.hypernetwork.code_normalisation.register_full_backward_hook(lambda _, given, __: gradients.append(given[0]))
    trainer.take_step()
    (gradient,) = gradients
    assert len(gradient) == 1 + reference_objects
    shared = gradient.sum(0).abs().max() / gradient.abs().max()
    assert shared < 1e-4 if reference_objects else shared == 1


def test_only_the_objects_of_a_step_are_rendered():
    trainer = Trainer(small_model(), Balls(), with_(tasks=1, reference_objects=2))
    drawn = trainer.loader.names_of(0)
    assert len(set(drawn)) == len(drawn) == 3
    for name in drawn[1:]:
        trainer.loader.get(name).query.images.fill_(float("nan"))
    assert np.isfinite(trainer.take_step())


def test_a_finished_training_is_not_repeated(tmp_path):
    done = train(small_model(), Balls(), with_(steps=2), tmp_path)
    weights = state_of(done.model)
    again = train(small_model(), Balls(), with_(steps=2), tmp_path)
    assert again.step == 2
    assert same(again.model.state_dict(), weights)


def test_a_training_with_other_settings_is_not_resumed(trained):
    with pytest.raises(CheckpointError) as caught:
        Trainer(small_model(), Balls(), with_(steps=1, rays=64, seed=3), trained)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in ("training.json", "expected the same training", "rays", "seed", "--out"))
    Trainer(small_model(), Balls(), with_(steps=9), trained)  # more steps of the same training are allowed


def test_a_checkpoint_of_another_model_is_not_resumed(trained):
    with pytest.raises(
        CheckpointError, match="model.json: expected the model that is to be trained, found other hyper"
    ):
        Trainer(small_model(hypernetwork=None), Balls(), with_(steps=1), trained)


def test_theta_and_the_hypernetwork_have_separate_optimisers():
    model = small_model()
    trainer = Trainer(model, Balls(), with_(learning_rate=3e-3, hypernetwork_learning_rate=1e-4))
    groups = [
        {id(value) for group in o.param_groups for value in group["params"]} for o in trainer.optimisation.optimisers
    ]
    assert groups == [{id(value) for value in part.parameters()} for part in (model.networks, model.hypernetwork)]
    trainer.take_step()
    assert [optimiser.param_groups[0]["lr"] for optimiser in trainer.optimisation.optimisers] == [3e-3, 1e-4]


@pytest.mark.parametrize("frozen", ["theta", "hypernetwork"])
def test_a_rate_of_zero_freezes_only_its_part(frozen):
    rates = {"learning_rate": 1e-2, "hypernetwork_learning_rate": 1e-2}
    rates["learning_rate" if frozen == "theta" else "hypernetwork_learning_rate"] = 0.0
    model = small_model()
    before = state_of(model)
    losses(model, with_(**rates), 2)
    moved = {name.split(".")[0] for name, value in model.named_parameters() if not torch.equal(value, before[name])}
    assert moved == ({"hypernetwork"} if frozen == "theta" else {"networks"})


def test_with_antialias_each_pixel_of_a_training_has_three_rays(monkeypatch):
    """Closed form: the loss is the mean square of their mean colours minus the colours of the pixels."""
    traced, outputs, trace = [], [], base.AdaptedField.trace

    def noting_rays(self, rays, generator=None):
        traced.append((rays, trace(self, rays, generator)))
        return traced[-1][1]

    def noting_outputs(*given):
        outputs.append(forward(*given))
        return outputs[-1]

    monkeypatch.setattr(base.AdaptedField, "trace", noting_rays)
    monkeypatch.setattr(objective, "forward", noting_outputs)
    for antialias, times in ((False, 1), (True, 3)):
        traced.clear()
        loss = losses(small_model(), with_(antialias=antialias, tasks=1), 1)[0]
        ((rays, rendered),) = traced
        directions = rays.directions.reshape(times, FAST.rays, 3)
        assert (directions[1:] != directions[0]).any(-1).all()
        mean = rendered.colour.reshape(times, FAST.rays, 3).mean(0)
        assert loss == pytest.approx(float((mean - outputs[-1].truth).square().mean().detach()))


def test_muon_changes_the_hidden_matrices_at_its_own_rate():
    model = small_model()
    before = state_of(model)
    config = with_(optimiser="muon", learning_rate=0.0, hypernetwork_learning_rate=0.0, muon_learning_rate=0.01)
    losses(model, config, 2)
    moved = {name for name, value in model.named_parameters() if not torch.equal(value, before[name])}
    assert moved == {f"networks.fine.{name}.weight" for name in ("layers.0", "layers.1", "feature")}


def test_without_a_hypernetwork_only_theta_is_trained():
    trainer = Trainer(small_model(hypernetwork=None), Balls(), FAST)
    assert len(trainer.optimisation.optimisers) == 1


def test_rates_rise_in_the_warm_up_and_fall_along_half_a_cosine():
    # 2 steps of warm-up have 1/2 and 1; then half a cosine over 4 steps goes from 1 to 0.2, at 0, 1/4, 1/2 and 3/4
    config = with_(steps=6, rays=1, warmup=2, final_rate_factor=0.2, learning_rate=1.0)
    trainer = Trainer(small_model(hypernetwork=None), Balls(), config)
    rates = []
    for _ in range(6):
        trainer.take_step()
        rates.append(trainer.optimisation.optimisers[0].param_groups[0]["lr"])
    half = 2**-0.5
    expected = [0.5, 1.0, 1.0, 0.2 + 0.4 * (1 + half), 0.6, 0.2 + 0.4 * (1 - half)]
    assert rates == pytest.approx(expected)


def test_the_rate_is_constant_by_default_as_in_the_paper():
    trainer = Trainer(small_model(), Balls(), with_(steps=3))
    for _ in range(3):
        trainer.take_step()
        assert trainer.optimisation.optimisers[0].param_groups[0]["lr"] == 1e-3


def test_the_gradients_of_several_objects_of_a_step_are_averaged():
    found = []
    for tasks in (1, 3):  # draws of the only object differ in their rays only
        trainer = Trainer(small_model(hypernetwork=None), Balls(train=1), with_(tasks=tasks, rays=4096))
        found.append((trainer.take_step(), trainer.norms()["gradient_theta"]))
    assert found[1] == pytest.approx(found[0], rel=0.1)


def test_objects_that_are_evicted_from_memory_change_nothing():
    assert losses(small_model(), with_(memory=1), 3) == losses(small_model(), FAST, 3)


def test_only_training_objects_are_trained_on():
    data = Balls()
    asked = []
    task = data.task
    data.task = lambda name: asked.append(name) or task(name)
    trainer = Trainer(small_model(hypernetwork=None), data, with_(rays=1))
    for _ in range(6):
        trainer.take_step()
    assert set(asked) <= set(data.names("train"))
    trainer.validate()
    assert asked[-1] in data.names("test")


def test_progress_is_reported_with_the_held_out_quality(tmp_path):
    reports = []
    config = with_(steps=27, tasks=1, rays=8, evaluate_every=26, checkpoint_every=26)
    trainer = train(small_model(hypernetwork=None), Balls(), config, tmp_path, reports.append)
    assert [report.step for report in reports] == [25, 26, 27]
    assert reports[0].psnr is None
    assert all(0 < report.psnr < 60 for report in reports[1:])
    assert all(report.loss > 0 and report.rays_per_second > 0 and report.seconds_left >= 0 for report in reports)
    assert reports[-1].seconds_left == 0
    assert [entry["step"] for entry in trainer.curve] == [25, 26, 27]
    assert json.loads((tmp_path / "training.json").read_text())["curve"] == trainer.curve


def test_without_held_out_objects_there_is_no_quality():
    assert Trainer(small_model(), Balls(test=0), FAST).validate() is None


def test_no_training_object_is_refused():
    with pytest.raises(ValueError, match="data: expected at least one training object, got none"):
        Trainer(small_model(), Balls(train=0), FAST)


class Killed(BaseException):
    """Stands for the end of the process."""


@pytest.mark.parametrize("memory", [1, 2**30], ids=["nothing kept", "all kept"])
def test_preparing_objects_in_a_thread_changes_nothing(memory):
    """The curve is exactly the same, and every object that is not cached is prepared in the thread."""
    threads, runs = set(), []
    for prefetch in (0, 2):
        data = Balls(train=5)
        task = data.task
        data.task = lambda name, task=task: threads.add(threading.current_thread().name) or task(name)
        config = with_(steps=4, tasks=2, rays=8, memory=memory, prefetch=prefetch)
        trainer = train(small_model(hypernetwork=None), data, config)
        runs.append((trainer.curve, state_of(trainer.model)))
        assert any("prefetch" in name for name in threads) == (prefetch > 0)
    for curve, weights in runs[1:]:
        assert curve == runs[0][0]
        assert same(weights, runs[0][1])


def test_an_error_of_the_thread_is_raised_in_the_step_that_needs_the_object():
    data = Balls(train=1)
    task = data.task
    trainer = Trainer(small_model(), data, with_(steps=3, memory=1))
    data.task = lambda name: task("no such object")
    with pytest.raises(ValueError, match="invalid literal"):
        list(trainer.run())
    assert trainer.step == 0


def test_the_number_of_epochs_is_how_often_each_object_is_drawn():
    # 5 objects, 2 per step, for 4 epochs are 20 draws in 10 steps
    assert Trainer(small_model(), Balls(train=5), with_(epochs=4, tasks=2)).config.steps == 10
    assert Trainer(small_model(), Balls(train=5), with_(epochs=1, tasks=2)).config.steps == 3
    assert train(small_model(), Balls(train=2), with_(epochs=2, tasks=2, rays=4)).step == 2


def test_norms_are_those_of_gradients_and_updates():
    model, made = awaken(small_model()), []
    updates = model.updates
    model.updates = lambda *given, **named: made.extend(updates(*given, **named)) or list(made)
    trainer = Trainer(model, Balls(), with_(tasks=2))
    trainer.take_step()
    found = trainer.norms()
    for name, part in (("theta", model.networks), ("hypernetwork", model.hypernetwork)):
        squares = [each.grad.square().sum() for each in part.parameters() if each.grad is not None]
        assert found[f"gradient_{name}"] == pytest.approx(float(sum(squares)) ** 0.5, rel=1e-5)
    squares = [float(value.detach().square().sum()) for update in made for value in update.values()]
    assert found["update"] == pytest.approx((sum(squares) / 2) ** 0.5, rel=1e-5)
    assert found["update"] > 0.1


def test_a_curve_and_pictures_are_saved_with_the_weights(tmp_path):
    trainer = train(small_model(), Balls(test=2), with_(steps=1), tmp_path)
    with (tmp_path / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [{name: float(value) for name, value in row.items()} for row in rows] == trainer.curve
    assert {"step", "loss", "psnr", "ssim", "spread", "swap_gap", "gradient_theta", "update"} <= set(rows[0])
    assert sorted(path.name for path in (tmp_path / "samples").iterdir()) == ["00000001.png"]
    with Image.open(tmp_path / "samples" / "00000001.png") as sheet:  # two views of two objects, next to the truth
        pixels = np.asarray(sheet)
    assert pixels.shape == (4 * 16, 2 * 16, 3)
    for index, (name, view) in enumerate((name, view) for name in ("test0", "test1") for view in (0, 2)):
        truth = Balls(test=2).task(name).query.images[view].permute(1, 2, 0).numpy()
        assert abs(pixels[16 * index : 16 * index + 16, 16:] / 255 - truth).max() <= 0.5 / 255 + 1e-6
        task = Balls(test=2).task(name)
        seen = trainer.model.eval().adapt(task.support).render(task.query[[view]].cameras).images[0].permute(1, 2, 0)
        assert abs(pixels[16 * index : 16 * index + 16, :16] / 255 - seen.clamp(0, 1).numpy()).max() <= 1 / 255


def test_a_resumed_training_writes_its_curve_in_the_same_columns(tmp_path):
    config = with_(evaluate_every=1)
    for folder, counts in (("whole", [2]), ("parts", [1, 2])):
        for steps in counts:
            train(small_model(), Balls(), replace(config, steps=steps), tmp_path / folder)
    whole, parts = ((tmp_path / folder / "curve.csv").read_text() for folder in ("whole", "parts"))
    assert whole == parts
    assert whole.startswith("step,loss,")


def test_tensorboard_shows_the_curve_and_the_pictures(tmp_path):
    """Source of truth: TensorBoard's reader of event files."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    trainer = Trainer(small_model(), Balls(test=2), with_(steps=2, evaluate_every=1))
    board = TensorBoard(tmp_path)
    with Console().bar("training") as bar:
        follow(trainer, bar, board)
    board.close()
    found = EventAccumulator(str(tmp_path)).Reload()
    for name in set(trainer.curve[-1]) - {"step"}:
        expected = [(row["step"], pytest.approx(row[name], rel=1e-6)) for row in trainer.curve]
        assert [(event.step, event.value) for event in found.Scalars(name)] == expected
    assert [event.step for event in found.Images(found.Tags()["images"][0])] == [1, 2]


def test_a_training_that_is_killed_while_it_saves_has_one_complete_state(tmp_path, monkeypatch):
    """Killed before any write of the second checkpoint, it leaves the first or the second, and never a mixture."""
    trainer = Trainer(small_model(), Balls(), FAST, tmp_path)
    states = {}
    for step in (1, 2):
        trainer.take_step()
        states[step] = state_of(trainer.model)
        if step == 1:
            trainer.save()
    write, found = writing.write_whole, []
    for survived in range(5):
        left = iter(range(survived))

        def write_some(path, content, left=left):
            if next(left, None) is None:
                raise Killed
            write(path, content)

        with monkeypatch.context() as patch:
            patch.setattr(writing, "write_whole", write_some)
            if survived < 4:
                with pytest.raises(Killed):
                    trainer.save()
            else:
                trainer.save()
        loaded = HyperPlanes.from_pretrained(tmp_path)
        assert any(same(loaded.state_dict(), state) for state in states.values())
        resumed = Trainer(small_model(), Balls(), FAST, tmp_path)
        found.append(resumed.step)
        assert same(resumed.model.state_dict(), states[resumed.step])
        assert {int(o.state_dict()["state"][0]["step"]) for o in resumed.optimisation.optimisers} == {resumed.step}
    assert found == [1, 1, 1, 1, 2]
    names = {"model.json", "model.safetensors", "training-00000002.safetensors", "training.json"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_checkpoints_are_written_at_their_interval_and_not_only_with_a_report(tmp_path, monkeypatch):
    saved = []
    config = with_(steps=30, tasks=1, rays=1, checkpoint_every=7)
    trainer = Trainer(small_model(hypernetwork=None), Balls(test=0), config, tmp_path)
    monkeypatch.setattr(trainer, "save", lambda: saved.append(trainer.step))
    reported = [progress.step for progress in trainer.run()]
    assert saved == [7, 14, 21, 28, 30]
    assert reported == [25, 30]


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"sampling": RayMarching(25)}, "sampling.steps"),
        ({"sampling": Hierarchical(4, 4)}, "protocol"),
        ({"hull_resolution": 17}, "hull_resolution"),
        ({"network": replace(small_model().config.network, density_scale=3.0)}, "network.density_scale"),
        ({"hypernetwork": replace(small_model().config.hypernetwork, rank=5)}, "hypernetwork.rank"),
    ],
)
def test_a_model_with_other_settings_but_the_same_weights_is_another(trained, change, name):
    with pytest.raises(CheckpointError, match=f"model.json: .*found other .*{name}.*; give another --out"):
        Trainer(small_model(**change), Balls(), with_(steps=1), trained)


@pytest.mark.parametrize("name", ["step", "curve", "config", "data", "state"])
@pytest.mark.parametrize("value", [None, "missing", "../../elsewhere"])
def test_a_training_file_without_a_value_is_a_checkpoint_error(trained, name, value):
    saved = json.loads((trained / "training.json").read_text())
    saved = (
        {key: entry for key, entry in saved.items() if key != name} if value == "missing" else {**saved, name: value}
    )
    (trained / "training.json").write_text(json.dumps(saved))
    with pytest.raises(CheckpointError, match="training.json: expected ") as caught:
        Trainer(small_model(), Balls(), with_(steps=1), trained)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("row", [1, {"loss": 0.5}, {"step": 1, "psnr": "high"}], ids=str)
def test_an_invalid_curve_is_a_checkpoint_error(trained, row):
    saved = json.loads((trained / "training.json").read_text())
    (trained / "training.json").write_text(json.dumps({**saved, "curve": [*saved["curve"], row]}))
    with pytest.raises(CheckpointError, match=r"training.json: expected a curve of numbers by name, .* found "):
        Trainer(small_model(), Balls(), with_(steps=1), trained)


def test_a_state_of_another_shape_is_a_checkpoint_error(trained):
    (path,) = trained.glob("training-*.safetensors")
    tensors = checkpoints.load_tensors(path)
    for change in ({"0.0.exp_avg": torch.zeros(3)}, {"0.99.step": torch.zeros(())}, {"model.rig": torch.zeros(1, 3)}):
        checkpoints.save_tensors(path, {**tensors, **change})
        with pytest.raises(CheckpointError, match="training-00000001.safetensors: expected"):
            Trainer(small_model(), Balls(), with_(steps=1), trained)


def test_memory_is_bounded_in_bytes():
    whole = Trainer(small_model(), Balls(), FAST)
    whole.loader.get("train0")
    one = whole.loader.cache.nbytes
    # 4 support and 4 query views of 16 x 16 pixels with 4 floats each, the colours of the support views once more for
    # lookups with 4 bytes per pixel, a hull of 16^3 bytes, and 8 bytes for each pixel that shows the hull
    least = 8 * 16 * 16 * 4 * 4 + 4 * 16 * 16 * 4 + 16**3
    assert least < one <= least + 4 * 16 * 16 * 8
    tight = Trainer(small_model(), Balls(), with_(memory=int(2.5 * one)))
    for name in ("train0", "train1", "train2", "train1"):
        tight.loader.get(name)
        assert tight.loader.cache.nbytes <= 2.5 * one
    assert tight.loader.cache.get("train0") is None
    assert tight.loader.cache.get("train1") is not None
    assert tight.loader.cache.get("train2") is not None


def test_the_protocol_of_the_paper_carves_no_hull_unless_empty_space_is_skipped(monkeypatch):
    carved = []
    monkeypatch.setattr(base, "carve", lambda *given, **more: carved.append(given) or occupancy.carve(*given, **more))
    dense = {"coarse_network": True, "sampling": Hierarchical(4, 4)}
    trainer = Trainer(small_model(**dense), Balls(), FAST)
    trainer.take_step()
    trainer.validate()
    assert not carved
    Trainer(small_model(**dense), Balls(), with_(empty_points=8)).take_step()
    assert carved


def test_held_out_objects_come_from_the_validation_split_if_there_is_one():
    data, asked = Balls(test=2), []
    task = data.task
    data.task = lambda name: asked.append(name) or task(name)
    data.splits["val"] = ["test1"]
    trainer = Trainer(small_model(), data, FAST)
    asked.clear()
    first = trainer.validate().psnr
    assert trainer.validate().psnr == first
    assert asked == ["test1"]  # its planes and hull are kept between validations


def test_a_validation_is_the_quality_of_adapted_and_rendered_objects():
    data = Balls()
    trainer = Trainer(small_model(), data, FAST)
    trainer.take_step()
    task = data.task("test0")
    views = task.query[[0, 2]]
    expected = psnr(trainer.model.adapt(task.support).render(views.cameras).images, views.images).mean()
    assert trainer.validate().psnr == pytest.approx(expected.item())
    assert trainer.model.training


def test_an_object_that_cannot_be_trained_on_is_named():
    class Blank(Balls):
        def task(self, name):
            task = super().task(name)
            return replace(task, support=replace(task.support, masks=torch.zeros_like(task.support.masks)))

    with pytest.raises(ValueError, match="train[0-2]: masks of the support views: expected an object"):
        Trainer(small_model(), Blank(), FAST).take_step()


def test_an_unusable_held_out_object_is_named_before_the_first_step():
    class Blank(Balls):
        def task(self, name):
            task = super().task(name)
            masks = task.support.masks * name.startswith("train")
            return replace(task, support=replace(task.support, masks=masks))

    trainer = Trainer(small_model(), Blank(), FAST)
    with pytest.raises(ValueError, match="test0: masks of the support views: expected an object"):
        list(trainer.run())
    assert trainer.step == 0


def test_a_validation_reports_the_common_part_of_the_updates(tmp_path):
    """The diagnostics of the held-out objects are saved in the curve and with the weights."""
    model = awaken(small_model())
    trainer = Trainer(model, Balls(test=3), with_(steps=2, evaluate_every=2), tmp_path)
    (progress,) = list(trainer.run())
    found = progress.diagnostics
    prepared = [model.prepare(Balls(test=3).task(name).support) for name in ("test0", "test1", "test2")]
    assert found.spread == pytest.approx(diagnose(model, prepared).spread, rel=1e-4)
    assert trainer.curve[-1]["spread"] == found.spread
    assert trainer.curve[-1]["swap_gap"] == found.swap_gap
    assert Diagnostics.of_json(read_json(tmp_path / "diagnostics.json")) == found


def test_training_warns_once_when_every_object_gets_the_same_update(capsys):
    model = awaken(small_model())
    model.hypernetwork.encoder.register_forward_hook(lambda module, given, codes: torch.zeros_like(codes))
    trainer = Trainer(model, Balls(test=2), with_(steps=2, evaluate_every=1))
    with Console().bar("training") as bar:
        follow(trainer, bar)
    assert capsys.readouterr().err.count("the hypernetwork predicts the same update for every object") == 1


def test_training_ends_at_a_loss_that_is_not_finite_and_keeps_the_last_checkpoint(tmp_path):
    class Poisoned(Balls):
        broken = False

        def task(self, name):
            task = super().task(name)
            if not self.broken:
                return task
            query = replace(task.query, images=task.query.images.clone())
            query.images.fill_(float("nan"))  # after the checks of Views
            return replace(task, query=query)

    data = Poisoned(test=0)
    trainer = Trainer(small_model(), data, with_(steps=4, checkpoint_every=2, memory=0), tmp_path)
    trainer.take_step()
    trainer.take_step()
    trainer.save()
    before = (tmp_path / "model.safetensors").read_bytes()
    data.broken = True
    with pytest.raises(ValueError, match=r"step 3, on train[0-2].*: expected a finite loss, got nan; the last"):
        trainer.take_step()
    assert (tmp_path / "model.safetensors").read_bytes() == before
    assert all(value.isfinite().all() for value in trainer.model.parameters())


@pytest.mark.parametrize(("number", "error"), [(signal.SIGTERM, Terminated), (signal.SIGHUP, HungUp)])
def test_a_signal_ends_a_training_after_its_step_with_a_checkpoint(tmp_path, number, error):
    """When a terminal is closed, SIGHUP comes from the terminal and from the shell, so more than once."""

    class Signalled(Trainer):
        def take_step(self):
            loss = super().take_step()
            if self.step == 2:
                signal.raise_signal(number)
                if number == signal.SIGHUP:
                    signal.raise_signal(number)
            return loss

    before = signal.getsignal(number)
    trainer = Signalled(small_model(), Balls(test=0), with_(steps=9, checkpoint_every=9), tmp_path)
    with Console().bar("training") as bar, pytest.raises(error, match="step 2 is saved; run the same command"):
        follow(trainer, bar)
    assert json.loads((tmp_path / "training.json").read_text())["step"] == 2
    assert signal.getsignal(number) is before


def test_a_training_under_nohup_continues_when_its_terminal_is_closed(tmp_path):
    class Signalled(Trainer):
        def take_step(self):
            signal.raise_signal(signal.SIGHUP)
            return super().take_step()

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Console().bar("training") as bar:
            follow(Signalled(small_model(), Balls(test=0), with_(steps=2), tmp_path), bar)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert json.loads((tmp_path / "training.json").read_text())["step"] == 2


def test_a_training_is_not_resumed_with_other_data(tmp_path):
    """One more object, and other pictures with the same names."""
    Trainer(small_model(), Balls(test=0), with_(steps=2), tmp_path).save()

    class Darker(Balls):
        def task(self, name):
            task = super().task(name)
            return replace(task, support=replace(task.support, images=task.support.images / 2))

    class Shifted(Balls):
        """As --legacy reads them, with the principal point moved by half a pixel."""

        def task(self, name):
            task = super().task(name)
            matrix = cameras.intrinsics(task.support.cameras).clone()
            matrix[:, :2, 2] += 0.5
            shifted = cameras.pinhole(matrix, cameras.camera_from_world(task.support.cameras), *task.support.size)
            return replace(task, support=replace(task.support, cameras=shifted))

    assert Trainer(small_model(), Balls(test=0), with_(steps=2), tmp_path).step == 0
    with pytest.raises(ValueError, match="with other calibration; give --legacy as before"):
        Trainer(small_model(), Shifted(test=0), with_(steps=2), tmp_path)
    for data, found in ((Balls(train=4, test=0), "4 with other objects and names"), (Darker(test=0), "other pictures")):
        with pytest.raises(ValueError, match=f"objects that the training began with, found .*{found}.*--checkpoint"):
            Trainer(small_model(), data, with_(steps=2), tmp_path)


def test_weights_without_their_training_json_are_not_overwritten(tmp_path):
    trainer = Trainer(small_model(), Balls(test=0), with_(steps=2, keep_last=2), tmp_path)
    trainer.take_step()
    trainer.save()
    (tmp_path / "training.json").unlink()
    with pytest.raises(
        ValueError, match=r"training.json: expected .* beside its weights, .*copy training-00000001.json"
    ):
        Trainer(small_model(), Balls(test=0), with_(steps=2, keep_last=2), tmp_path)
    (tmp_path / "training-00000001.json").rename(tmp_path / "training.json")
    assert Trainer(small_model(), Balls(test=0), with_(steps=2, keep_last=2), tmp_path).step == 1


def test_a_first_checkpoint_without_its_model_is_completed(tmp_path):
    trainer = Trainer(small_model(), Balls(test=0), with_(steps=2), tmp_path)
    trainer.take_step()
    trainer.save()
    model = (tmp_path / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").unlink()
    Trainer(small_model(), Balls(test=0), with_(steps=2), tmp_path)
    assert (tmp_path / "model.safetensors").read_bytes() == model


def test_weights_that_are_not_finite_are_not_saved(tmp_path):
    trainer = Trainer(small_model(), Balls(test=0), with_(steps=4), tmp_path)
    trainer.take_step()
    trainer.save()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with torch.no_grad():
        next(iter(trainer.model.networks.parameters()))[0] = float("nan")
    trainer.step = 2
    with pytest.raises(ValueError, match=r"training-00000002.*expected finite numbers to save, found NaN .* model\."):
        trainer.save()
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_views_in_double_precision_are_trained_on_as_in_single(tmp_path):
    class Double(Balls):
        def task(self, name):
            task = super().task(name)
            return replace(task, support=task.support.to(dtype=torch.float64), query=task.query.to(dtype=torch.float64))

    losses = [Trainer(awaken(small_model()), data, replace(FAST, steps=1)).take_step() for data in (Balls(), Double())]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)


def test_the_validation_at_the_last_step_of_a_stopped_training_is_reported():
    trainer = Trainer(small_model(), Balls(), with_(steps=6, evaluate_every=2))
    trainer.stopping = True
    trainer.take_step()
    assert [progress.step for progress in trainer.run()] == [2]
