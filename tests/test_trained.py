"""Trained models, not fresh ones: the update depends on the pictures, or these fail.

Source of truth: taking away. Another object's update, white noise in place of the HyperPlanes and an encoder that is
switched off must each move the figure.
"""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from benchmarks.objects import held_out
from hyperplanes.adaptation import HullBlend, HyperPlanes, diagnose, swap_gap
from hyperplanes.fields import TargetConfig
from hyperplanes.hypernetwork import ImageHyperNetworkConfig
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.training.episodes.augmentation import Rotation
from hyperplanes.utilities.metrics import psnr
from tests.reference_rendering import Balls, small_model

SMALL = {"views": 1, "normalisation": "group", "code": 16, "depth": 2, "width": 32}
ALL_LAYERS = ImageHyperNetworkConfig(
    **SMALL, layers=("all",), update="low_rank", weights_seen="all", activation="silu", rank=2
)
LAST_LAYERS = ImageHyperNetworkConfig(**{**SMALL, "normalisation": "batch"})


class ManyBalls(Balls):
    """Eight balls to train on; the held-out ones have colours and sizes between theirs."""

    def __init__(self):
        super().__init__(train=8, test=3, views=4)


@cache
def trained(shape):
    """A field that reads no image, so that all it knows of an object is the update; some seconds of training."""
    network = TargetConfig(depth=2, width=24, planes=1, point_frequencies=2, direction_frequencies=1)
    model = small_model(target="nerf", network=network, hypernetwork=shape)
    config = TrainingConfig(steps=160, tasks=4, rays=48, learning_rate=3e-3, hypernetwork_learning_rate=3e-3)
    trainer = Trainer(model, ManyBalls(), replace(config, held_out=0))
    while trainer.step < config.steps:
        trainer.take_step()
    return trainer


def figures(model, data=None, names=("test0", "test1", "test2")):
    """Spread of the updates, and what swapping them costs in dB."""
    tasks = [(data or ManyBalls()).task(name) for name in names]
    model.eval()
    prepared = [model.prepare(task.support) for task in tasks]
    return diagnose(model, prepared).spread, swap_gap(model, prepared, [task.query for task in tasks])[1]


@pytest.mark.parametrize("shape", [ALL_LAYERS, LAST_LAYERS])
def test_the_update_depends_on_the_object_and_swapping_it_costs_decibels(shape):
    spread, gap = figures(trained(shape).model)
    assert spread > 0.1
    assert gap > 0.5


@pytest.mark.parametrize("shape", [ALL_LAYERS, LAST_LAYERS])
def test_the_encoder_has_a_gradient_at_the_end_of_training(shape):
    trainer = trained(shape)
    trainer.take_step()
    gradients = [value.grad for value in trainer.model.hypernetwork.encoder.parameters()]
    assert all(gradient is not None and gradient.abs().sum() > 0 for gradient in gradients)


@pytest.mark.parametrize("shape", [ALL_LAYERS, LAST_LAYERS])
def test_a_hypernetwork_whose_encoder_is_switched_off_is_found_out(shape):
    model = trained(shape).model
    hook = model.hypernetwork.encoder.register_forward_hook(lambda module, given, codes: torch.zeros_like(codes))
    try:
        spread, gap = figures(model)
    finally:
        hook.remove()
    assert spread < 0.01  # as measured, and as training warns of
    assert abs(gap) < 0.01


def test_the_published_form_is_found_out_when_its_codes_are_dead():
    # Codes that are all zero: the update is the same for every object, whatever the pictures show.
    shape = replace(LAST_LAYERS, code_normalisation="none", centre=False)
    model = small_model(hypernetwork=replace(shape, views=2))
    torch.nn.init.zeros_(model.hypernetwork.encoder.code.weight)
    for output in model.hypernetwork.outputs:
        torch.nn.init.normal_(output.weight)
    data = Balls(test=2)
    prepared = [model.prepare(data.task(name).support) for name in data.names("test")]
    found = diagnose(model, prepared)
    assert found.spread < 1e-6
    assert found.constant


@cache
def cars():
    return held_out(3, 64)


@cache
def lamps():
    return held_out(2, 64, kind="lamp")


@pytest.fixture(params=["cars-64", "small"])
def packaged(request):
    return HyperPlanes.from_pretrained(request.param)


def test_packaged_models_read_the_pictures(packaged):
    prepared = [packaged.prepare(task.support) for task in cars()]
    found = diagnose(packaged, prepared)
    assert found.spread > 0.1
    assert not found.constant
    first = prepared[0]
    noise = torch.rand(first.views.images.shape, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        own = packaged.update(first)
        other = packaged.update(packaged.prepare(replace(cars()[0].support, images=noise)))
    moved = sum(float((own[name] - other[name]).square().sum()) for name in own) ** 0.5
    assert moved > 0.1 * found.norm


def test_swapping_updates_of_cars_costs_decibels():
    model = HyperPlanes.from_pretrained("cars-64")
    prepared = [model.prepare(task.support) for task in cars()]
    assert swap_gap(model, prepared, [task.query[::8] for task in cars()])[1] > 0.1


@pytest.mark.parametrize("count", [3, 25])
def test_swapping_updates_of_cars_costs_decibels_with_few_views_and_with_many(count):
    model = HyperPlanes.from_pretrained("small")
    prepared = [model.prepare(task.support[:: 25 // count][:count]) for task in cars()]
    assert swap_gap(model, prepared, [task.query[::8] for task in cars()])[1] > 1.5  # measured: 2.4 and 1.9


@pytest.mark.parametrize("count", [3, 25])
def test_a_lamp_with_the_update_of_a_car_is_worse(count):
    assert lamp_with_the_update_of_a_car(HyperPlanes.from_pretrained("small"), count) > 4  # measured: 5.0 and 5.3


def test_a_lamp_with_the_update_of_a_car_is_worse_with_25_planes_too():
    assert lamp_with_the_update_of_a_car(HyperPlanes.from_pretrained("small-paper"), 25) > 1  # measured: 1.6


@pytest.mark.parametrize(("count", "most"), [(3, 4.5), (25, 1.0)])
def test_a_car_that_faces_another_way_costs_little(count, most):
    """4.1 and 0.6 dB; weights trained on one heading alone lost 9.5 and 7.7 (`benchmarks views --rotated`)."""
    model, found = HyperPlanes.from_pretrained("small"), {}
    for degrees in (0, 45):
        rotation = Rotation(math.radians(degrees))
        values = []
        for task in cars():
            shown, query = (rotation.views(part) for part in (task.support[:: 25 // count][:count], task.query[::12]))
            values.append(psnr(model.adapt(shown).render(query.cameras).images, query.images).mean())
        found[degrees] = float(torch.stack(values).mean())
    assert min(found.values()) > found[0] - most


@cache
def shapes():
    """Random compositions of a seed that no training has."""
    return held_out(3, 64, kind="random")


def mean_psnr(adapter, tasks, count):
    """In dB, over two views of each object that are not among the `count` that are shown."""
    with torch.no_grad():
        found = [
            psnr(adapter.adapt(task.support[:: 25 // count][:count]).render(task.query[::12][:2].cameras).images,
                 task.query[::12][:2].images).mean()
            for task in tasks
        ]  # fmt: skip
    return float(torch.stack(found).mean())


@pytest.mark.parametrize(("count", "least"), [(5, 1.0), (25, 2.0)])
def test_objects_that_mean_nothing_are_shown_better_than_by_their_hull(count, least):
    """By 2.7 and 4.4 dB on these."""
    model = HyperPlanes.from_pretrained("small")
    assert mean_psnr(model, shapes(), count) > mean_psnr(HullBlend(), shapes(), count) + least


def test_views_that_are_held_out_find_out_what_is_wrong_for_an_object():
    """A car with what the model says of a lamp; without the judge it is what `swap_gap` measures."""
    model = HyperPlanes.from_pretrained("small")
    foreign = model.update(model.prepare(lamps()[0].support[::2]))
    model.update = lambda context: foreign
    found = {}
    for judged in (False, True):
        model.config = replace(model.config, judged=judged)
        found[judged] = mean_psnr(model, cars()[:1], 12)
    assert found[True] > found[False] + 3


@torch.no_grad()
def lamp_with_the_update_of_a_car(model, count):
    """What it costs in dB, mean over lamps, where so many views are shown of both."""
    total = 0.0
    for lamp, car in zip(lamps(), cars(), strict=False):
        shown, other = (model.prepare(task.support[:: 25 // count][:count]) for task in (lamp, car))
        own, foreign = model.updates([shown, other])
        query = lamp.query[::12]
        fields = [model.field(shown, model.theta + update) for update in (own, foreign)]
        right, wrong = (float(psnr(field.render(query.cameras).images, query.images).mean()) for field in fields)
        total += (right - wrong) / len(lamps())
    return total
