"""Sources of truth: theta + delta by hand, brute-force matching of views to planes, and properties (an untrained model
is its target network, permuted views give the same field, a saved model is read back).
"""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from hyperplanes.adaptation import HyperPlanes, InitialisationConfig, ModelConfig, checkpoints
from hyperplanes.adaptation.network import in_use
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.export.baking import bake
from hyperplanes.export.surfaces.mesh import extract_mesh
from hyperplanes.fields import TargetConfig
from hyperplanes.geometry.cameras import camera_from_world, centres, look_at, pinhole, viewing_directions
from hyperplanes.geometry.cameras import intrinsics as calibration
from hyperplanes.geometry.rays import Sphere
from hyperplanes.hypernetwork import AutoencoderConfig, ImageHyperNetworkConfig
from hyperplanes.rendering import Hierarchical, render
from hyperplanes.utilities.files.checkpoints import CheckpointError
from hyperplanes.views import Views
from tests.reference_rendering import awaken, ball_views, ring, small_model

CAMERAS = ring(2, (10, 13), shift=1)


@pytest.fixture
def model():
    return awaken(small_model())


@pytest.fixture
def support():
    return ball_views(ring(4))


def picture(model, support):
    return model.adapt(support).render(CAMERAS).images


def test_an_untrained_model_is_its_target_network(model, support):
    # the hypernetwork outputs zero at first, so that theta + delta = theta
    asleep = small_model()
    plain = small_model(hypernetwork=None)
    plain.networks.load_state_dict(asleep.networks.state_dict())
    assert torch.equal(picture(asleep, support), picture(plain, support))
    assert not torch.equal(picture(model, support), picture(asleep, support))


def test_a_model_in_double_precision_takes_points_of_either_and_is_exported(model, support):
    points, directions = torch.rand(9, 3) - 0.5, torch.nn.functional.normalize(torch.rand(9, 3), dim=1)
    single, double = model.adapt(support), copy.deepcopy(model).double().adapt(support)
    for dtype in (torch.float32, torch.float64):
        colour, density = double(points.to(dtype), directions.to(dtype))
        assert colour.dtype == density.dtype == double.density(points.to(dtype)).dtype == dtype
        torch.testing.assert_close(colour.float(), single(points, directions)[0], atol=1e-3, rtol=0)
    torch.testing.assert_close(render(double, CAMERAS).images, render(single, CAMERAS).images, atol=1e-4, rtol=0)
    assert bake(double, side=16).values.dtype == torch.float32
    level = float(single.density(points).median())
    found = [extract_mesh(field, voxels=12, level=level).vertices for field in (single, double)]
    np.testing.assert_allclose(*found, atol=1e-3)


def test_adapting_binds_theta_plus_delta(model, support):
    with torch.no_grad():
        prepared = model.prepare(support)
        update = model.eval().update(prepared)
        assert set(update) == {f"fine.{layer}.{kind}" for layer in ("colour", "density") for kind in ("weight", "bias")}
        points, directions = torch.rand(9, 3) - 0.5, torch.nn.functional.normalize(torch.rand(9, 3), dim=1)
        expected = model.field(prepared, model.theta + update)(points, directions)
        found = model.adapt(support)(points, directions)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)


def test_the_hypernetwork_reads_images_with_directions_and_theta(model, support):
    """Eq. 7: k images of the support with the viewing directions of the same cameras, and theta."""
    seen = []
    model.hypernetwork.register_forward_pre_hook(lambda module, given: seen.append(given))
    model.adapt(support)
    observed, theta = seen[0]
    (images,), (directions,) = observed.images, observed.directions
    assert images.shape == (2, 3, 16, 16)
    assert set(theta) == set(model.theta)
    for image, direction in zip(images, directions, strict=True):
        view = next(i for i in range(4) if torch.equal(support.images[i], image))
        torch.testing.assert_close(direction, viewing_directions(support.cameras)[view])
        torch.testing.assert_close(direction, -torch.nn.functional.normalize(centres(support.cameras)[view], dim=0))


@pytest.mark.parametrize("order", [[1, 2, 3, 0], [3, 1, 0, 2]])
def test_support_views_in_another_order_make_the_same_field(model, support, order):
    torch.testing.assert_close(picture(model, support[order]), picture(model, support))


def test_a_scene_moved_and_scaled_with_its_cameras_gives_the_same_picture(model, support):
    shift, scale = torch.tensor([1.5, -2.0, 0.7]), 2.5

    def moved(cameras):
        pose = camera_from_world(cameras).clone()
        pose[:, :3, 3] = scale * pose[:, :3, 3] - pose[:, :3, :3] @ shift
        return pinhole(calibration(cameras), pose, int(cameras.height[0]), int(cameras.width[0]))

    there = replace(support, cameras=moved(support.cameras), bounds=Sphere(tuple(shift.tolist()), scale))
    images = model.adapt(there).render(moved(CAMERAS)).images
    # rounding may move a sample into another voxel
    assert ((images - picture(model, support)).abs() < 1e-3).float().mean() > 0.98


@pytest.mark.parametrize("count", [1, 2, 3])
def test_with_fewer_views_than_planes_views_are_repeated(model, support, count):
    arranged = model.arrange(support[:count])
    assert len(arranged) == 4
    sources = [int((support.images == image).flatten(1).all(1).nonzero()[0]) for image in arranged.images]
    assert set(sources) == set(range(count))
    assert max(map(sources.count, sources)) <= -(-4 // count)
    assert torch.isfinite(picture(model, support[:count])).all()


def test_with_more_views_than_planes_those_nearest_to_the_rig_are_used(model, support):
    others = ball_views(ring(5, shift=2))
    many = Views(torch.cat([others.images, support.images]), _joined(others, support))
    arranged = model.arrange(many)
    assert torch.equal(arranged.images, support.images)
    torch.testing.assert_close(centres(arranged.cameras), centres(support.cameras))


def _joined(*parts):
    pose = torch.cat([camera_from_world(part.cameras) for part in parts])
    return pinhole(calibration(parts[0].cameras)[0], pose, *parts[0].size)


def test_views_from_farther_away_are_matched_by_direction(model, support):
    far = pinhole(calibration(support.cameras)[0], look_at(centres(support.cameras)[[2, 0, 3, 1]] * 2), 16, 16)
    arranged = model.arrange(replace(support, cameras=far))
    torch.testing.assert_close(centres(arranged.cameras), 2 * centres(support.cameras))


def test_hyperplanes_are_farthest_apart():
    wide = small_model(network=TargetConfig(depth=1, width=8, planes=6))
    # six cameras on the axes; the farthest one from the first is opposite
    eyes = 3 * torch.tensor([[0, 0, 1.0], [1, 0, 0], [0, 1, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0]])
    cameras = pinhole(torch.tensor([[20.0, 0, 7.5], [0, 20, 7.5], [0, 0, 1]]), look_at(eyes), 16, 16)
    wide.set_rig(ball_views(cameras))
    assert wide.prepare(ball_views(cameras)).hyperplanes.tolist() == [0, 3]


@pytest.mark.parametrize("count", [1, 3, 4])
def test_hyperplanes_are_k_different_planes(count):
    shape = ImageHyperNetworkConfig(views=count, normalisation="group", code=4, depth=1, width=8)
    chosen = small_model(hypernetwork=shape).prepare(ball_views(ring(4))).hyperplanes.tolist()
    assert len(set(chosen)) == len(chosen) == count


def test_the_first_views_are_hyperplanes_with_choice_first(support):
    config = ImageHyperNetworkConfig(views=3, choice="first", normalisation="group", code=8, depth=2, width=16)
    first, farthest = small_model(hypernetwork=config), small_model(hypernetwork=replace(config, choice="farthest"))
    assert first.prepare(support).hyperplanes.tolist() == [0, 1, 2]
    assert all(torch.equal(value, farthest.state_dict()[name]) for name, value in first.state_dict().items())
    for model, chosen in ((first, [0, 1, 2]), (farthest, farthest.prepare(support).hyperplanes.tolist())):
        seen = []
        model.hypernetwork.register_forward_pre_hook(lambda module, given, seen=seen: seen.append(given[0]))
        model.update(model.prepare(support))
        assert torch.equal(seen[0].images[0], support.images[chosen])


@pytest.mark.parametrize(("count", "expected"), [(4, [3, 1, 0, 2]), (6, [3, 1, 0, 2]), (3, [3, 1, 0, 3])])
def test_planes_in_the_order_of_their_file_are_the_first_views(count, expected):
    whole = ball_views(ring(6))
    views = whole[[3, 1, 0, 2, 5, 4][:count]]
    first = ImageHyperNetworkConfig(views=3, choice="first", normalisation="group", code=8, depth=2, width=16)
    filed, matched = small_model(order="file", hypernetwork=first).prepare(views), small_model().prepare(views)
    assert torch.equal(filed.views.images, whole.images[expected])
    assert filed.hyperplanes.tolist() == [0, 1, 2]
    assert not torch.equal(matched.views.images, filed.views.images)
    assert torch.equal(filed.occupancy.occupied, matched.occupancy.occupied)
    with pytest.raises(ValueError, match="order: expected one of 'matched', 'file', got 'random'"):
        ModelConfig(order="random")


def test_no_views_are_refused(model, support):
    with pytest.raises(ValueError, match="support: expected at least one view, got none"):
        model.adapt(support[:0])
    with pytest.raises(ValueError, match="support: expected at least 4 views, one a plane, got 3"):
        model.set_rig(support[:3])


@pytest.mark.parametrize("target", ["nerf", "multiplane", "point_multiplane"])
def test_every_field_adapts_and_renders_with_and_without_masks(target, support):
    whole = awaken(small_model(target=target))
    for views in (support, replace(support, masks=None)):
        images = picture(whole, views)
        assert images.shape == (2, 3, 10, 13)
        assert torch.isfinite(images).all()
        assert images.std() > 0


def test_an_unknown_target_is_refused():
    with pytest.raises(ValueError, match="target: expected one of .*, got 'voxels'"):
        small_model(target="voxels")


def test_a_coarse_network_proposes_and_is_updated_too(support):
    both = awaken(small_model(coarse_network=True, sampling=Hierarchical(6, 6)))
    assert {name.split(".")[0] for name in both.theta} == {"fine", "coarse"}
    prepared = both.prepare(support)
    assert {name.split(".")[0] for name in both.update(prepared)} == {"fine", "coarse"}
    seen = both.adapt(support).trace(support.rays(0, near_far="constant"))
    assert (seen.coarse.colour - seen.colour).abs().max() > 1e-3


def test_a_saved_model_is_the_same_model(model, support, tmp_path):
    model.save(tmp_path)
    again = HyperPlanes.from_pretrained(tmp_path)
    assert not again.training
    assert again.config == model.config
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in model.state_dict().items())
    assert torch.equal(picture(again, support), picture(model, support))


@pytest.mark.parametrize(
    "config",
    [
        ModelConfig(),
        ModelConfig(hypernetwork=None, sampling=Hierarchical(3, 4), coarse_network=True),
        ModelConfig(target="nerf", hypernetwork=ImageHyperNetworkConfig(layers=("0", "colour")), hull_resolution=7),
        ModelConfig(hypernetwork=None, autoencoder=AutoencoderConfig(views=3, latent=9), order="file"),
        ModelConfig(hypernetwork=None, initialisation=InitialisationConfig("maml", inner_steps=2)),
    ],
)
def test_a_configuration_survives_json(config):
    assert ModelConfig.of_json(json.loads(json.dumps(config.as_json()))) == config


@pytest.mark.parametrize(
    "change",
    [
        {"surprise": 1},
        {"protocol": "guessed"},
        {"network": {"depth": 2, "breadth": 3}},
        {"network": None},
        {"hypernetwork": "large"},
        {"sampling": {"coarse": 3}},
    ],
)
def test_a_configuration_that_does_not_fit_is_a_checkpoint_error(change):
    value = {**ModelConfig().as_json(), **change}
    with pytest.raises(CheckpointError, match="expected the entries of this version's models") as caught:
        ModelConfig.of_json(value)
    assert "\n" not in str(caught.value)


def test_the_error_for_an_unknown_field_names_a_missing_package():
    value = {**ModelConfig().as_json(), "target": "of_a_plugin"}
    with pytest.raises(CheckpointError, match="got 'of_a_plugin'; install the package that adds it"):
        ModelConfig.of_json(value)


@pytest.mark.parametrize("missing", ["network", "sampling", "protocol", "hypernetwork"])
def test_a_missing_entry_of_a_configuration_is_a_checkpoint_error(missing):
    value = ModelConfig().as_json()
    del value[missing]
    with pytest.raises(CheckpointError, match=missing):
        ModelConfig.of_json(value)


@pytest.mark.parametrize(
    "change",
    [
        {"network": {"depth": 3, "width": 24, "planes": 4, "point_frequencies": 3, "direction_frequencies": 1}},
        {"network": {"depth": 2, "width": 20, "planes": 4, "point_frequencies": 3, "direction_frequencies": 1}},
        {"hypernetwork": None},
        {"coarse_network": True},
    ],
)
def test_weights_of_another_architecture_are_a_checkpoint_error(model, tmp_path, change):
    model.save(tmp_path)
    written = json.loads((tmp_path / "model.json").read_text())
    (tmp_path / "model.json").write_text(json.dumps({**written, **change}))
    with pytest.raises(CheckpointError, match="model.safetensors: expected .* found .* of another model"):
        HyperPlanes.from_pretrained(tmp_path)


@pytest.mark.parametrize("missing", ["model.json", "model.safetensors"])
def test_a_missing_part_of_a_checkpoint_is_named(model, tmp_path, missing):
    model.save(tmp_path)
    (tmp_path / missing).unlink()
    with pytest.raises(CheckpointError, match=f"{missing}: expected"):
        HyperPlanes.from_pretrained(tmp_path)


def config_of(model):
    return json.loads(json.dumps(model.config.as_json()))


@pytest.mark.parametrize(
    ("part", "change", "words"),
    [
        ("network", {"width": "16"}, "network.width: expected a whole number from 2 to 8192, got '16'"),
        ("network", {"depth": True}, "network.depth: expected a whole number from 1 to 256, got True"),
        ("network", {"width": 10**12}, "width: expected a whole number from 2 to 8192, got 1000000000000"),
        ("network", {"planes": 0}, "planes: expected a whole number from 1 to 1024, got 0"),
        ("network", {"density_scale": float("inf")}, "network.density_scale: expected finite numbers, got inf"),
        ("hypernetwork", {"layers": "colour"}, "hypernetwork.layers: expected a tuple of str, got 'colour'"),
        ("hypernetwork", {"encoder": "vgg"}, "encoder: expected one of .*, got 'vgg'"),
        ("hypernetwork", {"views": 5}, "hypernetwork.views: expected at most as many as planes, 4, got 5"),
        (None, {"target": "voxels"}, "target: expected one of .*, got 'voxels'"),
        (None, {"target": 3}, "target: expected str, got 3"),
        (None, {"hull_resolution": 10**6}, "hull_resolution: expected a whole number from 1 to 512, got 1000000"),
        ("sampling", {"steps": 0}, "sampling.steps: expected a whole number from 1 to 16384, got 0"),
    ],
)
def test_a_checkpoint_of_wrong_types_or_absurd_sizes_names_its_file(model, tmp_path, part, change, words):
    model.save(tmp_path)
    value = config_of(model)
    value = {**value, part: {**value[part], **change}} if part else {**value, **change}
    (tmp_path / "model.json").write_text(json.dumps(value))
    with pytest.raises(CheckpointError, match=words) as caught:
        HyperPlanes.from_pretrained(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / "model.json"))
    assert "\n" not in str(caught.value)
    assert "; " in str(caught.value)


def test_entries_that_a_newer_version_added_may_be_missing(model):
    value = config_of(model)
    del value["network"]["density_scale"], value["hull_resolution"]
    assert ModelConfig.of_json(value) == replace(model.config, hull_resolution=64)


def test_differences_of_configurations_are_named():
    one = ModelConfig()
    other = replace(one, sampling=replace(one.sampling, steps=7), hypernetwork=replace(one.hypernetwork, rank=2))
    assert one.differences(one) == []
    assert one.differences(other) == ["hypernetwork.rank", "sampling.steps"]
    assert "hypernetwork" in one.differences(replace(one, hypernetwork=None))
    assert "protocol" in one.differences(replace(one, sampling=Hierarchical()))


def test_a_packaged_model_is_found_by_its_name(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(checkpoints, "PACKAGED", tmp_path / "package")
    model.save(tmp_path / "package" / "cars-8")
    found = HyperPlanes.from_pretrained("cars-8")
    assert all(torch.equal(value, found.state_dict()[name]) for name, value in model.state_dict().items())
    with pytest.raises(CheckpointError, match=r"boats: expected .* packaged model \(cars-8\), found neither; `hyper"):
        HyperPlanes.from_pretrained("boats")
    with pytest.raises(CheckpointError, match=r"car-8: expected .*, found neither; did you mean cars-8\?"):
        HyperPlanes.from_pretrained("car-8")
    with pytest.raises(CheckpointError, match="runs/boats-8: expected a checkpoint's folder, found no such folder"):
        HyperPlanes.from_pretrained("runs/boats-8")  # a path is not looked up among the packaged models


def test_a_loaded_model_can_be_trained_further(model, tmp_path):
    model.save(tmp_path)
    again = HyperPlanes.from_pretrained(tmp_path)
    assert all(value.requires_grad and value.device.type == "cpu" for value in again.parameters())


def test_the_weights_depend_on_the_seed_and_not_on_the_global_generator():
    config = small_model().config
    before = torch.random.get_rng_state()
    first, second, third = HyperPlanes(config, 1), HyperPlanes(config, 1), HyperPlanes(config, 2)
    assert torch.equal(before, torch.random.get_rng_state())
    weights = [each.networks["fine"].layers[0].weight for each in (first, second, third)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_a_model_without_a_rig_is_refused(support):
    fresh = HyperPlanes(small_model().config)
    for call in (fresh.prepare, fresh.arrange, fresh.adapt):
        with pytest.raises(ValueError, match="rig: expected the camera directions of the training views, got none"):
            call(support)


def test_a_hypernetwork_and_an_autoencoder_together_are_refused():
    with pytest.raises(ValueError, match="expected at most one way to find weights, got hypernetwork and autoencoder"):
        ModelConfig(autoencoder=AutoencoderConfig())


def test_more_hyperplanes_than_planes_are_refused():
    with pytest.raises(ValueError, match="hypernetwork.views: expected at most as many as planes, 4, got 5"):
        small_model(hypernetwork=ImageHyperNetworkConfig(views=5))


def test_adapting_and_fine_tuning_leave_the_model_in_its_mode(support):
    batch = awaken(small_model(hypernetwork=ImageHyperNetworkConfig(views=2, code=8, depth=2, width=16)))
    batch.train()
    batch.hypernetwork.encoder.eval()
    before = {name: part.training for name, part in batch.named_modules()}
    statistics = {name: value.clone() for name, value in batch.named_buffers()}
    batch.adapt(support)
    batch.fine_tune(support, 1, FineTuning(rays=8))
    assert {name: part.training for name, part in batch.named_modules()} == before
    assert all(torch.equal(value, statistics[name]) for name, value in batch.named_buffers())
    assert torch.equal(picture(batch, support), picture(batch.eval(), support))


def test_views_in_double_precision_are_converted_to_the_type_of_the_weights(model, support):
    double = support.to(dtype=torch.float64)
    torch.testing.assert_close(picture(model, double), picture(model, support), atol=1e-4, rtol=0)
    model.fine_tune(double, 1, FineTuning(rays=8))


def test_without_carving_the_hull_is_one_occupied_voxel(model, support):
    prepared = model.prepare(support, carved=False)
    assert prepared.occupancy.occupied.shape == (1, 1, 1)
    assert prepared.occupancy.occupied.all()
    assert prepared.occupancy.bounds == support.bounds


def test_a_new_model_leaves_the_generators_of_all_devices_alone(monkeypatch):
    monkeypatch.setattr(torch.cuda, "manual_seed_all", lambda seed: pytest.fail("seeds the GPUs"))
    before = torch.random.get_rng_state()
    one, other = HyperPlanes(ModelConfig()), HyperPlanes(ModelConfig())
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(value, other.state_dict()[name]) for name, value in one.state_dict().items())


def test_shared_parts_are_in_evaluation_mode_until_the_last_model_ends():
    model = small_model().train()
    other = model.without_residuals()
    first, second = in_use(model), in_use(other)
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert not any(part.training for part in other.modules())
    second.__exit__(None, None, None)
    assert all(part.training for part in [*model.modules(), *other.modules()])


def test_a_module_is_in_evaluation_mode_until_its_last_user_ends():
    model = small_model().train()
    model.networks.eval()
    first, second = in_use(model), in_use(model)
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert not any(part.training for part in model.modules())
    second.__exit__(None, None, None)
    assert model.training
    assert not model.networks.training
