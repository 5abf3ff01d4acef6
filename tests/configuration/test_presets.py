"""Source of truth: the numbers of Appendix B of the paper."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from hyperplanes.adaptation import HyperPlanes, ModelConfig
from hyperplanes.configuration.compatibility import check_model, check_training
from hyperplanes.configuration.presets import PRESETS, preset
from hyperplanes.fields import find_targets
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry
from hyperplanes.hypernetwork import ConvNet, ResNet101
from hyperplanes.rendering import Hierarchical, RayMarching
from hyperplanes.training import Trainer
from tests.reference_rendering import Balls, ring


def shapes(name):
    """The model of a preset on the meta device, without memory for its weights."""
    with torch.device("meta"):
        return HyperPlanes(preset(name).model)


@pytest.mark.parametrize("name", ["paper-128", "paper-200"])
def test_the_target_network_of_the_paper(name):
    # Appendix B: 8 layers of 256, 25 ImagePlanes; inputs are 5 per plane and 3 (1 + 2 * 10) of the encoded point
    model = shapes(name)
    for network in model.networks.values():
        assert [layer.out_features for layer in network.layers] == [256] * 8
        assert network.layers[0].in_features == 25 * 5 + 63
    assert set(model.networks) == {"fine", "coarse"}
    assert len(model.rig) == 25


@pytest.mark.parametrize("method", ["nerf", "multiplane", "point_multiplane", "image_based", "mv_meta", "maml"])
@pytest.mark.parametrize("name", ["small", "quick"])
def test_a_preset_fits_every_method_that_has_no_hypernetwork(name, method):
    made = preset(name).by_method(method)
    assert check_model(made.model) is find_targets()[made.model.target]
    check_training(made.training, made.model)


@pytest.mark.parametrize(("name", "depth", "views"), [("paper-128", 3, 5), ("paper-200", 10, 25)])
def test_the_hypernetwork_of_the_paper(name, depth, views):
    hypernetwork = shapes(name).hypernetwork
    assert [layer.out_features for layer in hypernetwork.head] == [256] * depth
    assert hypernetwork.config.views == views
    assert hypernetwork.config.see_weights
    assert hypernetwork.config.see_directions
    # the colour and opacity layers of both networks, 128 x 3 + 3 and 256 + 1 numbers
    assert sorted(layer.out_features for layer in hypernetwork.outputs) == sorted([384, 3, 256, 1] * 2)


def test_the_encoders_of_the_paper():
    small, large = (shapes(name).hypernetwork.encoder for name in ("paper-128", "paper-200"))
    assert isinstance(small, ConvNet)
    assert any(isinstance(layer, nn.BatchNorm2d) for layer in small.modules())
    assert isinstance(large, ResNet101)
    assert sum(value.numel() for name, value in large.named_parameters() if "code" not in name) == 42_500_160


@pytest.mark.parametrize("name", ["paper-128", "paper-200"])
def test_the_protocol_and_the_training_of_the_paper(name):
    chosen = preset(name)
    assert chosen.model.sampling == Hierarchical(64, 128)  # Appendix B: samples 64, importance 128
    assert chosen.model.coarse_network
    assert chosen.by_protocol("ray_marching").model == replace(chosen.model, sampling=RayMarching())
    assert chosen.by_protocol("ray_marching").by_protocol("paper") == chosen
    training = chosen.training
    assert (training.tasks, training.rays, training.learning_rate) == (1, 512, 1e-4)
    assert training.hypernetwork_learning_rate == 1e-4
    assert (training.warmup, training.final_rate_factor) == (0, 1.0)
    assert str(chosen.resolution) in name


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_survives_json_and_fits_its_own_parts(name):
    chosen = preset(name)
    assert ModelConfig.of_json(chosen.model.as_json()) == chosen.model
    assert check_model(chosen.model) is find_targets()[chosen.model.target]
    assert chosen.without_hypernetwork().model == replace(chosen.model, hypernetwork=None)
    assert chosen.without_hypernetwork().training == replace(chosen.training, volume_loss=0.0)
    assert "\n" not in chosen.about


@pytest.mark.parametrize("name", ["paper-128", "quick"])
def test_a_preset_trains_and_renders_at_toy_resolution(name):
    """With the whole architecture, but 25 images of 12 x 12 pixels and few rays and samples."""
    chosen = preset(name)
    sampling = Hierarchical(4, 4) if isinstance(chosen.model.sampling, Hierarchical) else chosen.model.sampling
    torch.manual_seed(0)
    model = HyperPlanes(replace(chosen.model, sampling=sampling, hull_resolution=12))
    data = Balls(train=4, views=25, size=(12, 12))
    trainer = Trainer(model, data, replace(chosen.training, rays=8))
    before = {key: value.clone() for key, value in model.named_parameters()}
    assert all(0 < trainer.take_step() < 10 for _ in range(2))
    moved = {
        key.split(".")[0] + "." + key.split(".")[1] for key, v in model.named_parameters() if (v != before[key]).any()
    }
    # the outputs change once there are two objects to compare, and the encoder one step later
    assert {f"networks.{part}" for part in model.networks} | {"hypernetwork.outputs"} <= moved
    pictures = model.adapt(data.task("train0").support).render(ring(1, (6, 6)))
    assert torch.isfinite(pictures.images).all()
    assert ((pictures.images >= 0) & (pictures.images <= 1.0001)).all()


def test_ray_marching_does_not_change_a_preset_with_ray_marching():
    for name in ("quick", "small", "paper-128-brief"):
        assert preset(name).by_protocol("ray_marching") == preset(name)
    assert isinstance(
        preset("paper-128-brief").model.sampling, RayMarching
    )  # the weights of the benchmarks were trained with it


@pytest.mark.parametrize("method", ["image_based", "mv_meta", "maml"])
def test_methods_without_a_hypernetwork_drop_its_training_settings(method):
    made = preset("small").by_method(method, None if method == "image_based" else "image_based")
    Trainer(HyperPlanes(made.model), Balls(), replace(made.training, held_out=0))  # raises otherwise


def test_an_unknown_preset_is_refused():
    with pytest.raises(ValueError, match="preset: expected one of quick, .*, got 'huge'"):
        preset("huge")


@pytest.mark.parametrize("first", ["mv_meta", "maml", "autoencoder", "hyperplanes"])
@pytest.mark.parametrize("second", ["nerf", "point_multiplane", "autoencoder", "mv_meta", "image_based"])
def test_choosing_another_method_removes_the_settings_of_the_first(first, second):
    made = preset("quick").by_method(first).by_method(second)
    assert made.model.method == preset("quick").by_method(second).model.method
    check_model(made.model)
    check_training(made.training, made.model)


def test_a_field_with_fixed_planes_drops_settings_of_fields_for_any_views():
    small = preset("small")
    model = replace(
        small.model, gated=True, stacked=False, hull_share=0.2, azimuth=0.3, symmetry=Symmetry(Plane((1.0, 0.0, 0.0)))
    )
    check_model(replace(small, model=model).by_method("point_multiplane").model)


def test_another_field_for_the_same_method_keeps_the_settings_of_the_method():
    chosen = preset("quick").by_method("mv_meta")
    initialisation = replace(chosen.model.initialisation, inner_steps=7, inner_rate=0.1)
    training = replace(chosen.training, learning_rate=0.01, rays=256, tasks=2)
    changed = replace(chosen, model=replace(chosen.model, initialisation=initialisation), training=training)
    made = changed.by_method("mv_meta", "point_multiplane")
    assert made.model.target == "point_multiplane"
    assert made.model.initialisation == initialisation
    assert made.training == training
