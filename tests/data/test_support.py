"""Source of truth: the views of the original task."""

from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.data.devices import TasksOnDevice
from hyperplanes.data.support import (
    FarthestSupport,
    FewerQueries,
    SingleView,
    SupportByPosition,
    WithBounds,
    WithSupport,
)
from hyperplanes.evaluation import evaluate
from hyperplanes.fields import TargetConfig
from hyperplanes.geometry.cameras import centres
from hyperplanes.geometry.rays import Sphere
from hyperplanes.hypernetwork import ImageHyperNetworkConfig
from hyperplanes.training import TrainingConfig, train
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import class_of
from tests.reference_rendering import Balls, small_model


@pytest.mark.parametrize("count", [1, 3, 4, 6, 8])
def test_the_support_is_its_first_views_and_then_those_of_the_query(count):
    data = Balls()
    before, after = data.task("train1"), WithSupport(data, count).task("train1")
    images = torch.cat([before.support.images, before.query.images])
    standing = torch.cat([centres(before.support.cameras), centres(before.query.cameras)])
    masks = torch.cat([before.support.masks, before.query.masks])
    assert torch.equal(after.support.images, images[:count])
    assert torch.equal(centres(after.support.cameras), standing[:count])
    assert torch.equal(after.support.masks, masks[:count])
    assert torch.equal(after.query.images, before.query.images)
    assert WithSupport(data, count).names("train") == data.names("train")


def test_a_sphere_of_radius_2_seen_from_4_is_near_2_and_far_6():
    # near and far of learnit and of the authors' code, for every ray and any masks
    data = WithBounds(Balls(), Sphere((0.0, 0.0, 0.0), 2.0))
    for views in (data.task("train1").support, data.task("train1").query):
        distance = centres(views.cameras).norm(dim=1)
        rays = views.rays(0, near_far="constant")
        torch.testing.assert_close(rays.near, (distance[0] - 2).expand_as(rays.near))
        torch.testing.assert_close(rays.far, (distance[0] + 2).expand_as(rays.far))


def test_too_many_views_and_none_are_refused():
    with pytest.raises(ValueError, match="train0: expected 9 views for the support, got 8; --support 8 takes all"):
        WithSupport(Balls(), 9).task("train0")
    with pytest.raises(ValueError, match="support: expected at least 1 view, got 0"):
        WithSupport(Balls(), 0)


def test_fifty_planes_are_trained_and_evaluated_with_support_and_query_unified():
    data = WithSupport(Balls(train=1, views=25), 50)
    network = TargetConfig(depth=2, width=16, planes=50, point_frequencies=2, direction_frequencies=1)
    hypernetwork = ImageHyperNetworkConfig(views=50, normalisation="group", code=2, depth=1, width=8)
    model = HyperPlanes(small_model(network=network, hypernetwork=hypernetwork).config)  # without a rig
    trainer = train(model, data, TrainingConfig(steps=1, tasks=1, rays=16, held_out=0))
    assert trainer.model.rig.shape == (50, 3)
    task = data.task("test0")
    assert torch.equal(model.prepare(task.support).views.images, task.support.images)
    found = evaluate("hyperplanes", model.eval(), data, ["test0"]).mean("psnr")
    images = model.adapt(task.support).render(task.query.cameras).images
    assert found == pytest.approx(float(psnr(images, task.query.images).mean()), abs=1e-3)
    with pytest.raises(ValueError, match="support: expected at least 50 views, one a plane, got 25"):
        model.set_rig(Balls(views=25).task("test0").support)


def test_the_single_view_of_an_object_is_always_the_same():
    data = SingleView(Balls(train=3))
    for name in data.names("train"):
        first, again = data.task(name).support, data.task(name).support
        assert len(first) == 1
        assert torch.equal(first.images, again.images)
        assert torch.equal(data.task(name).query.images, Balls().task(name).query.images)


@pytest.mark.parametrize("named", [True, False])
def test_inputs_are_numbered_in_the_order_of_their_names(named):
    """As pixelNeRF does with SRN's pictures. Without names, the support comes before the query."""

    class Alternating(Balls):
        def task(self, name):
            task = super().task(name)
            if not named:
                return task
            names = [tuple(f"{2 * index + half:03d}" for index in range(4)) for half in (0, 1)]
            return replace(
                task, support=replace(task.support, names=names[0]), query=replace(task.query, names=names[1])
            )

    before = Alternating().task("test0")
    expected = (before.support, 0), (before.query, 1 if named else 3)
    after = SupportByPosition(Alternating(), (0, 3 if named else 7)).task("test0")
    for got, (views, place) in zip(after.support.images, expected, strict=True):
        assert torch.equal(got, views.images[place])
    assert len(after.query) == 6
    with pytest.raises(ValueError, match="test0: expected inputs from 0 to 7, got 8; name other views"):
        SupportByPosition(Alternating(), (8,)).task("test0")
    for wrong in ((), (1, 1), (-1,)):
        with pytest.raises(ValueError, match="inputs: expected different positions of views, from 0, got"):
            SupportByPosition(Alternating(), wrong)


def test_inputs_are_numbered_by_the_numbers_in_their_names():
    """As Blender writes them: r_0 to r_11 without zeros in front, where r_10 comes after r_9."""

    class Counted(Balls):
        def task(self, name):
            task = super().task(name)
            halves = [tuple(f"test/r_{3 * index + 7 * half}.png" for index in range(4)) for half in (0, 1)]
            return replace(
                task, support=replace(task.support, names=halves[0]), query=replace(task.query, names=halves[1])
            )

    task = SupportByPosition(Counted(), (0, 1, 2)).task("test0")
    assert task.support.names == ("test/r_0.png", "test/r_3.png", "test/r_6.png")
    assert task.query.names == tuple(f"test/r_{number}.png" for number in (7, 9, 10, 13, 16))


def test_the_support_can_be_the_views_that_are_farthest_apart():
    data = Balls(views=12)
    directions = data.task("test0").support.camera_directions
    chosen = WithSupport(data, 2, "farthest").task("test0").support.camera_directions
    assert torch.equal(chosen[0], directions[0])
    assert torch.equal(chosen[1], directions[(directions @ directions[0]).argmin()])


def test_random_support_views_are_distinct_and_depend_on_the_seed_and_the_object():
    data = Balls(views=12)

    def drawn(name, seed):
        support = WithSupport(data, 4, "random", seed).task(name).support
        every = centres(data.task(name).support.cameras)
        return [int((every == centre).all(1).nonzero()) for centre in centres(support.cameras)]

    assert drawn("test0", 0) == drawn("test0", 0)
    draws = [drawn("test0", seed) for seed in range(40)]
    assert all(len(set(draw)) == 4 for draw in draws)
    assert {index for draw in draws for index in draw} == set(range(12)), "40 draws of 4 in 12 miss one by 12 (2/3)^40"
    assert drawn("test0", 0) != drawn("test1", 0)
    with pytest.raises(ValueError, match="test0: expected at least 14 support views to choose from, got 12"):
        WithSupport(data, 14, "random").task("test0")
    with pytest.raises(ValueError, match="choose: expected one of first, farthest, random, got 'furthest'"):
        WithSupport(data, 3, "furthest")


def test_query_views_are_left_out_evenly():
    data = Balls(views=9)
    before, after = data.task("test0"), FewerQueries(data, 3).task("test0")
    assert torch.equal(after.query.images, before.query.images[[0, 4, 8]])
    assert torch.equal(after.support.images, before.support.images)
    assert len(FewerQueries(data, 20).task("test0").query) == 9
    with pytest.raises(ValueError, match="query: expected at least 1 view, got 0"):
        FewerQueries(data, 0)


def test_every_wrapper_keeps_splits_and_classes():
    class Kinds(Balls):
        def class_of(self, name):
            return f"class of {name}"

    data = Kinds()
    for wrapped in (
        WithSupport(data, 2),
        SingleView(data),
        FarthestSupport(data, 2, 1),
        SupportByPosition(data, (0,)),
        FewerQueries(data, 1),
        TasksOnDevice(data, torch.device("cpu")),
    ):
        assert wrapped.names("train") == data.names("train")
        assert class_of(wrapped, "train1") == "class of train1"
        assert class_of(SingleView(wrapped), "train1") == "class of train1"
