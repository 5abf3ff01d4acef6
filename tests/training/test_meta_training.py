"""Source of truth: autograd and a separate loop, bitwise equality of resumed trainings, and pixels that are NaN."""

from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import FineTuned, HyperPlanes, InitialisationConfig
from hyperplanes.adaptation.fine_tuned import shuffled
from hyperplanes.adaptation.optimisation.descent import ray_loss
from hyperplanes.data.support import SingleView, WithSupport
from hyperplanes.evaluation import evaluate
from hyperplanes.hypernetwork import AutoencoderConfig
from hyperplanes.parameters import Parameters
from hyperplanes.rendering import Hierarchical, RayMarching
from hyperplanes.training import Trainer, TrainingConfig, start_training
from hyperplanes.training.episodes.drawing import object_generator
from hyperplanes.training.initialisation import initialisation_trainer
from hyperplanes.views import Task
from tests.reference_rendering import Balls, small_model
from tests.training.test_volume_loss import MODEL

FAST = TrainingConfig(steps=4, tasks=2, rays=24, evaluate_every=100, checkpoint_every=100, learning_rate=1e-3)


def model_of(method, **changes):
    parts = {"inner_steps": 2, "steps": 3, "test_rays": 16, **changes}
    return small_model(hypernetwork=None, target="nerf", initialisation=InitialisationConfig(method, **parts))


def gradients_of(trainer):
    """The gradient of the first step, before the step of the optimiser."""
    for optimiser in trainer.optimisation.optimisers:
        optimiser.step = lambda: None
    trainer.take_step()
    return Parameters((name, value.grad) for name, value in trainer.model.networks.named_parameters())


@pytest.mark.parametrize("method", ["mv_meta", "sv_meta", "maml", "mv_matched"])
def test_an_interrupted_training_ends_where_an_uninterrupted_one_does(tmp_path, method):
    data, config = Balls(), model_of(method).config
    model_of("mv_meta").save(tmp_path / "reference")

    def run(folder, steps):
        training = replace(FAST, steps=steps)
        trainer = start_training(config, training, data, folder, reference=tmp_path / "reference")
        started = trainer.step
        for _ in trainer.run():
            pass
        return trainer, started

    whole, _ = run(tmp_path / "whole", 2)
    _, none = run(tmp_path / "parts", 1)
    parts, started = run(tmp_path / "parts", 2)
    assert (none, started) == (0, 1)
    assert parts.curve[-1] == whole.curve[-1]
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, parts.model.state_dict()[name]), name
    assert HyperPlanes.from_pretrained(tmp_path / "parts").config == config


def test_one_inner_step_of_reptile_is_a_gradient_step_on_support_rays():
    model = model_of("mv_meta", inner_steps=1, inner_rate=0.3)
    found = gradients_of(initialisation_trainer(model, Balls(train=1), replace(FAST, tasks=1), None))
    generator = object_generator(0, 0, 0)
    rays_generator = torch.Generator().manual_seed(int(torch.randint(2**31, (), generator=generator)))
    trainer = Trainer(model_of("mv_meta"), Balls(train=1), FAST)
    episode = trainer.loader.get("train0")
    views = episode.prepared.views
    rays, truth = views.sample_rays(FAST.rays, generator=rays_generator, among=episode.support_live)
    field = trainer.model.field(episode.prepared, trainer.model.theta)
    ray_loss(field.trace(rays, rays_generator), truth).backward()
    for name, value in trainer.model.networks.named_parameters():
        torch.testing.assert_close(found[name], 0.3 * value.grad, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("coarse", [False, True])
def test_inner_steps_of_rate_zero_change_nothing(coarse):
    changes = {"sampling": RayMarching(12, stop=0.0)}  # all gradients are exact, as in maml
    if coarse:
        changes = {"coarse_network": True, "sampling": Hierarchical(6, 6)}

    def found(method):
        model = small_model(
            hypernetwork=None,
            target="nerf",
            initialisation=InitialisationConfig(method, inner_steps=2, inner_rate=0.0),
            **changes,
        )
        return gradients_of(initialisation_trainer(model, Balls(), FAST, None))

    assert all((value == 0).all() for value in found("mv_meta").values())
    second, first = found("maml"), found("maml_first_order")
    for name in second:
        torch.testing.assert_close(second[name], first[name])
    assert any((value != 0).any() for value in second.values())


@pytest.mark.parametrize("method", ["maml", "mv_meta"])
def test_an_object_drawn_twice_has_the_gradient_and_the_loss_of_one(method):
    """The gradient of a step is the mean over its objects, so that rates do not depend on their number."""
    trainer = initialisation_trainer(model_of(method), Balls(), FAST, None)
    batch = trainer.loader.batch(0)

    def gradient(times):
        drawn = [replace(batch.rendered[0], generator=torch.Generator().manual_seed(3)) for _ in range(times)]
        loss = trainer.objective.gradients(replace(batch, rendered=drawn))
        return loss, {name: value.grad.clone() for name, value in trainer.model.networks.named_parameters()}

    (loss, once), (same, twice) = gradient(1), gradient(2)
    assert same == pytest.approx(loss)
    assert any((value != 0).any() for value in once.values())
    for name, value in once.items():
        torch.testing.assert_close(twice[name], value)


def test_sv_meta_uses_a_single_view_per_object():
    data, poisoned = Balls(), Balls()
    clean = data.task

    def poison(name):
        task = clean(name)
        kept = SingleView(data).task(name).support
        images = torch.full_like(task.support.images, 0.77)
        same = (task.support.images == kept.images).flatten(1).all(1)
        assert same.sum() == 1
        images[same] = kept.images
        masks = torch.ones_like(task.support.masks)
        masks[same] = kept.masks
        return Task(replace(task.support, images=images, masks=masks), task.query, name)

    poisoned.task = poison
    config = replace(FAST, steps=2)
    one, other = (initialisation_trainer(model_of("sv_meta"), each, config, None) for each in (data, poisoned))
    assert [one.take_step(), one.take_step()] == [other.take_step(), other.take_step()]


def test_matching_learns_the_outputs_of_the_reference(tmp_path):
    model_of("mv_meta").save(tmp_path)
    config = replace(FAST, steps=80, tasks=1, rays=128, learning_rate=1e-2)
    trainer = start_training(model_of("mv_matched").config, config, Balls(), tmp_path / "out", reference=tmp_path)
    assert not torch.equal(trainer.model.networks.fine.colour.weight, model_of("mv_meta").networks.fine.colour.weight)
    losses = [trainer.take_step() for _ in range(80)]
    assert sum(losses[-5:]) < 0.1 * sum(losses[:5])


def test_a_reference_of_another_architecture_is_refused(tmp_path):
    model = model_of("mv_matched")
    with pytest.raises(ValueError, match="mv_matched: expected a checkpoint of mv_meta to match, got none"):
        initialisation_trainer(model, Balls(), FAST, None)
    with pytest.raises(ValueError, match="reference: expected mv_meta .*, got a checkpoint of maml"):
        initialisation_trainer(model, Balls(), FAST, None, model_of("maml"))
    other = small_model(hypernetwork=None, initialisation=InitialisationConfig())
    with pytest.raises(ValueError, match="reference: expected mv_meta .*, got other target"):
        initialisation_trainer(model, Balls(), FAST, None, other)


def test_matching_is_resumed_with_its_reference(tmp_path):
    model_of("mv_meta").save(tmp_path / "one")
    other = model_of("mv_meta")
    with torch.no_grad():
        other.networks["fine"].colour.bias.add_(1)
    other.save(tmp_path / "other")
    config, begin = replace(FAST, steps=2), model_of("mv_matched").config
    list(start_training(begin, config, Balls(), tmp_path / "out", reference=tmp_path / "one").run())
    longer = replace(config, steps=3)
    assert start_training(begin, longer, Balls(), tmp_path / "out", reference=tmp_path / "one").step == 2
    with pytest.raises(
        ValueError, match=r"checkpoint: expected what the training in .* began with, .*one, got .*other"
    ):
        start_training(begin, longer, Balls(), tmp_path / "out", reference=tmp_path / "other")


def test_learned_initialisations_refuse_plane_dropout():
    model = model_of("mv_meta")
    model.config = replace(model.config, plane_dropout=0.5)
    with pytest.raises(ValueError, match="model.plane_dropout: expected 0 for mv_meta"):
        initialisation_trainer(model, Balls(), FAST, None)


@pytest.mark.parametrize(("name", "value"), [("random_background", True), ("empty_points", 64), ("antialias", True)])
def test_settings_that_inner_steps_do_not_support_are_refused(name, value):
    with pytest.raises(ValueError, match=f"training.{name}: expected .* for mv_meta"):
        initialisation_trainer(model_of("mv_meta"), Balls(), replace(FAST, **{name: value}), None)


def test_a_field_of_any_number_of_views_is_not_trained_on_one_view_per_object():
    model = HyperPlanes(replace(MODEL, hypernetwork=None, initialisation=InitialisationConfig("sv_meta")))
    with pytest.raises(ValueError, match="sv_meta: expected a field with a fixed number of views, got image_based"):
        initialisation_trainer(model, Balls(), FAST, None)


def test_results_do_not_depend_on_the_order_of_objects_and_the_initialisation_is_unchanged():
    model, data = model_of("mv_meta"), Balls(test=2)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    settings = model.config.initialisation.descent()
    rows = [
        evaluate("mv_meta", FineTuned(model, 3, settings), data, order).objects
        for order in (["test0", "test1"], ["test1", "test0"])
    ]
    one, other = ({each.name: (each.psnr, each.ssim) for each in row} for row in rows)
    assert one == other
    assert len(set(one.values())) == 2
    assert all(torch.equal(value, model.state_dict()[name]) for name, value in before.items())


@pytest.mark.parametrize(("method", "rate", "steps"), [("mv_meta", 0.02, 15), ("maml", 0.01, 20)])
def test_a_learned_initialisation_helps_on_a_new_object(method, rate, steps):
    # Ablation: the same weights in random order, and those before the training, after equally many steps on the object.
    data, untrained, model = Balls(), model_of(method, inner_rate=0.1), model_of(method, inner_rate=0.1)
    trainer = initialisation_trainer(model, data, replace(FAST, steps=steps, learning_rate=rate), None)
    for _ in range(steps):
        trainer.take_step()
    settings, names = model.config.initialisation.descent(), data.names("test")

    def quality(start):
        return evaluate("any", FineTuned(start.eval(), 3, settings), data, names).mean("psnr")

    reached = quality(model)
    assert reached > quality(shuffled(model)) + 1
    assert reached > quality(untrained) + 1


def test_with_too_few_support_views_the_error_states_the_possible_number(tmp_path):
    def model(planes, views=2):
        return HyperPlanes(replace(config, network=replace(config.network, planes=planes), hypernetwork=reading(views)))

    def reading(views):
        return replace(config.hypernetwork, views=views)

    def start(planes, views=2, data=None):
        chosen = model(planes, views).config
        return start_training(chosen, FAST, data or Balls(), tmp_path / f"{planes}-{views}")

    config = small_model().config
    both = "^train0: expected a support view for each of {} planes, got 4; `train --support {}` takes query views too{}"
    with pytest.raises(ValueError, match=both.format(6, 6, "")):
        start(6)
    with pytest.raises(ValueError, match=both.format(25, 8, ", and as many planes")):
        start(25)
    with pytest.raises(ValueError, match=both.format(25, "8 --model.hypernetwork.views 8", ", and as many planes")):
        start(25, 9)
    with pytest.raises(ValueError, match="^train0: expected 25 views .*, got 8; --support 8 takes all of them$"):
        start(25, data=WithSupport(Balls(), 25))
    assert start(8, 8, WithSupport(Balls(), 8)).model.rig.shape == (8, 3)


def test_a_field_without_planes_takes_any_number_of_support_views(tmp_path):
    """Except where an autoencoder reads views by their positions. A checkpoint with 25 planes also loads."""
    network = replace(small_model().config.network, planes=25)
    earlier = HyperPlanes(replace(model_of("mv_meta").config, network=network))
    earlier.rig.fill_(1.0)
    earlier.save(tmp_path / "earlier")
    new = start_training(earlier.config, FAST, Balls(), tmp_path / "new").model
    for model in (new, HyperPlanes.from_pretrained(tmp_path / "earlier")):
        for count in (4, 30):
            support = Balls(views=count).task("train0").support
            assert torch.equal(model.prepare(support).views.images, support.images)
    read = replace(earlier.config, initialisation=None, autoencoder=AutoencoderConfig(views=2, code=8, latent=8))
    with pytest.raises(ValueError, match="^train0: expected a support view for each of 25 planes, got 4"):
        start_training(read, FAST, Balls(), tmp_path / "read")


def test_a_training_begins_with_the_weights_of_a_checkpoint_or_names_those_that_do_not_fit(tmp_path):
    given = small_model()
    torch.nn.init.normal_(given.networks.fine.colour.weight)
    given.save(tmp_path / "given")
    trainer = start_training(given.config, FAST, Balls(), tmp_path / "out", reference=tmp_path / "given")
    for name, value in given.networks.state_dict().items():
        assert torch.equal(trainer.model.networks.state_dict()[name], value), name
    elsewhere = Balls(views=5)  # its first views have other poses, but the weights depend on the poses of the planes
    kept = start_training(given.config, FAST, elsewhere, tmp_path / "kept", reference=tmp_path / "given")
    assert torch.equal(kept.model.rig, given.rig)
    assert not torch.equal(start_training(given.config, FAST, elsewhere, tmp_path / "new").model.rig, given.rig)
    trainer.take_step()
    trainer.save()
    resumed = start_training(given.config, FAST, Balls(), tmp_path / "out", reference=tmp_path / "given")
    assert resumed.step == 1  # an interrupted training is resumed; it does not begin anew
    small_model().save(tmp_path / "others")
    with pytest.raises(
        ValueError, match="checkpoint: expected what the training in .* began with, .*given, got .*others"
    ):
        start_training(given.config, FAST, Balls(), tmp_path / "out", reference=tmp_path / "others")
    for name, value in trainer.model.state_dict().items():
        assert torch.equal(resumed.model.state_dict()[name], value), name

    wider = replace(given.config, network=replace(given.config.network, width=32))
    wider = replace(wider, hull_resolution=32, sampling=Hierarchical(4, 4))  # neither changes the shapes of weights
    expected = "expected weights of the configured model, .* got .*given, hyperplanes of .* differs in {}; give {}$"
    remedy = "the --preset or --config that it was trained by"
    with pytest.raises(ValueError, match=expected.format("network.width", remedy)):
        start_training(wider, FAST, Balls(), tmp_path / "other", reference=tmp_path / "given")
    (tmp_path / "given" / "config.yaml").touch()
    plain = replace(given.config, hypernetwork=None)
    with pytest.raises(ValueError, match=expected.format("hypernetwork", "--config .*given/config.yaml")):
        start_training(plain, FAST, Balls(), tmp_path / "other", reference=tmp_path / "given")


def test_a_validation_without_a_decreasing_loss_does_not_end_the_training():
    model = model_of("mv_meta")
    with torch.no_grad():
        model.networks["fine"].density.weight.zero_()
        model.networks["fine"].density.bias.fill_(-60.0)  # an empty field without a gradient
    trainer = initialisation_trainer(model, Balls(), replace(FAST, steps=1), None)
    assert [row.psnr for row in trainer.run()][-1] is not None


def test_maml_refuses_estimated_gradients_and_first_order_maml_takes_them():
    """Second derivatives of estimated gradients are biased. `stop` chooses the samples that have a gradient."""

    def found(method, stop):
        model = model_of(method)
        model.config = replace(model.config, sampling=RayMarching(24, stop))
        return gradients_of(initialisation_trainer(model, Balls(), FAST, None))

    for method, exact in (("maml", True), ("maml_first_order", False)):
        estimated, whole = (found(method, stop) for stop in (5e-3, 0.0))
        assert all(torch.equal(estimated[name], whole[name]) for name in whole) == exact
