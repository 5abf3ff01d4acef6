"""Source of truth: the same field with the code concatenated to the inputs of its layers."""

import pytest
import torch
from torch.nn.functional import linear, relu

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.hypernetwork import AutoencoderConfig
from hyperplanes.training import Trainer, TrainingConfig
from tests.reference_rendering import Balls, ball_views, ring, small_model

CONFIG = AutoencoderConfig(views=2, code=8, latent=6)


def make(**changes):
    return small_model(hypernetwork=None, autoencoder=CONFIG, **changes)


@torch.no_grad()
@pytest.mark.parametrize("target", ["nerf", "multiplane", "point_multiplane"])
def test_the_code_is_an_input_of_every_layer_that_reads_a_point(target):
    model = make(target=target).eval()
    prepared = model.prepare(ball_views(ring(4)))
    encoder, theta = model.hypernetwork, model.theta
    chosen = prepared.hyperplanes
    directions = prepared.views.cameras.extrinsics[chosen, 2, :3][None]  # the z axis of each camera, in the world
    code = encoder.encode(prepared.views.images[chosen][None], directions)
    points = torch.rand(7, 3) - 0.5
    read = model.networks.fine.inputs(points, prepared.planes, prepared.occupancy.bounds)
    beside = torch.cat([read, code.expand(7, -1)], 1)
    weights = {
        name: torch.cat([theta[f"fine.{name}.weight"][:, : read.shape[1]], reader.weight], 1)
        for name, reader in zip(("layers.0", "layers.1"), encoder.readers, strict=True)
    }
    hidden = relu(linear(beside, weights["layers.0"], theta["fine.layers.0.bias"]))
    own = theta["fine.layers.1.weight"][:, read.shape[1] :]
    hidden = relu(linear(beside, weights["layers.1"], theta["fine.layers.1.bias"]) + hidden @ own.T)
    torch.testing.assert_close(model.adapt_to(prepared).field.hidden(points), hidden, rtol=1e-4, atol=1e-5)


def test_only_biases_of_layers_that_read_a_point_are_updated():
    model = make(coarse_network=True)
    shifts = model.update(model.prepare(ball_views(ring(4))))
    assert set(shifts) == {f"{part}.layers.{layer}.bias" for part in ("fine", "coarse") for layer in (0, 1)}


def test_it_learns_to_distinguish_objects(tmp_path):
    model = make(target="nerf")
    rates = {"learning_rate": 5e-3, "hypernetwork_learning_rate": 5e-3}  # at 1e-2, some seeds give a constant field
    config = TrainingConfig(steps=25, tasks=3, rays=64, evaluate_every=100, **rates)
    trainer = Trainer(model, Balls(), config, tmp_path)
    losses = [trainer.take_step() for _ in range(25)]
    assert sum(losses[-5:]) < 0.6 * sum(losses[:5])
    data = Balls()
    one, other = (model.adapt(data.task(name).support).render(ring(1)).images for name in ("train0", "train2"))
    assert (one - other)[..., 5:11, 5:11].mean().abs() > 0.03  # inside both balls; outside, the hulls differ
    trainer.save()
    assert HyperPlanes.from_pretrained(tmp_path).config.method == "autoencoder"


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match="encoder: expected one of 'convnet', 'resnet101', got 'vit'"):
        AutoencoderConfig(encoder="vit")
    with pytest.raises(ValueError, match="autoencoder.views: expected at most as many as planes, 4, got 5"):
        small_model(hypernetwork=None, autoencoder=AutoencoderConfig(views=5))
