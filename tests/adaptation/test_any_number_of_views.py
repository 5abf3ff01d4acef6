"""Sources of truth: invariances (order of views, other objects in a batch), and which views a gradient step reads."""

import copy
from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes, ModelConfig
from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.fine_tuned import FromScratch
from hyperplanes.adaptation.optimisation.descent import Descent
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.configuration.fine_tuning import FRESH, MANY_VIEWS, FineTuning
from hyperplanes.fields import ImageBasedConfig, TargetConfig
from hyperplanes.geometry.cameras import centres
from hyperplanes.geometry.poses import farthest_first
from hyperplanes.hypernetwork import AutoencoderConfig, ImageHyperNetworkConfig, VolumeHyperNetworkConfig
from hyperplanes.parameters import Parameters
from hyperplanes.rendering import RayMarching
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.utilities.images.metrics import psnr
from tests.reference_rendering import awaken, ball_views, ring

SHAPE = ImageHyperNetworkConfig(
    views=3, normalisation="group", code=8, depth=2, width=16, join="mean", layers=("all",), update="low_rank", rank=1
)
VOLUME = VolumeHyperNetworkConfig()
NETWORK = ImageBasedConfig(depth=2, width=16, planes=4, blended=2, point_frequencies=2, direction_frequencies=1)
PLACED = TargetConfig(depth=2, width=16, planes=4, point_frequencies=2, direction_frequencies=1)
GRID = replace(NETWORK, grid=5)
READERS = {"images": {}, "volume": {"network": GRID, "hypernetwork": VOLUME}}
CONFIG = ModelConfig("image_based", NETWORK, SHAPE, sampling=RayMarching(24), hull_resolution=16)


def model(**changes):
    torch.manual_seed(0)  # `awaken` draws from the global generator
    return awaken(HyperPlanes(replace(CONFIG, **changes))).eval()


def views(count, colour=(0.8, 0.2, 0.1)):
    return ball_views(ring(count), colour=colour)


def picture(adapter, support):
    return adapter.adapt(support).render(ring(2, (10, 13), shift=1)).images


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_any_number_of_views_in_any_order_makes_the_same_picture(count, reader):
    adapter, support = model(**READERS[reader]), views(count)
    expected = picture(adapter, support)
    assert expected.isfinite().all()
    for seed in range(2):
        order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
        torch.testing.assert_close(picture(adapter, support[order]), expected, atol=1e-5, rtol=1e-4)


def test_larger_images_give_a_finer_hull():
    sides = []
    for size in ((16, 16), (20, 40), (300, 200)):
        task = ball_views(ring(4, size))
        sides.append(model().prepare(task).occupancy.occupied.shape[0])
    assert sides == [16, 30, 192]  # the configured side, three quarters of the longer side, and the maximum
    assert model().prepare(replace(task, masks=None)).occupancy.occupied.shape[0] == 16


@pytest.mark.parametrize("normalisation", ["group", "batch", "batch_statistics"])
def test_the_update_of_an_object_does_not_depend_on_what_else_is_in_the_batch(normalisation):
    """Objects of 1, 2 and 5 views, of which the hypernetwork reads at most 3, and of two picture sizes."""
    adapter = model(hypernetwork=replace(SHAPE, resolution=32, normalisation=normalisation))
    supports = [views(1), views(2, (0.1, 0.9, 0.3)), ball_views(ring(5, (20, 24)), colour=(0.2, 0.3, 0.9))]
    with torch.no_grad():
        prepared = [adapter.prepare(each) for each in supports]
        together = adapter.updates(prepared)
        for one, each in zip(together, prepared, strict=True):
            for name, value in adapter.update(each).items():
                torch.testing.assert_close(one[name], value, atol=1e-5, rtol=1e-4)
    assert not torch.allclose(together[0]["fine.density.weight"], together[1]["fine.density.weight"])


@pytest.mark.parametrize("normalisation", ["group", "batch", "batch_statistics"])
@pytest.mark.parametrize("training", [False, True])
@torch.no_grad()
def test_padding_images_do_not_change_batch_statistics(normalisation, training):
    network = model(hypernetwork=replace(SHAPE, normalisation=normalisation)).hypernetwork.train(training)
    generator = torch.Generator().manual_seed(0)
    images, directions = torch.rand(2, 3, 3, 32, 32, generator=generator), torch.rand(2, 3, 3, generator=generator)
    present = torch.tensor([[True, False, False], [True, True, True]])
    before = copy.deepcopy(network)
    codes = network.encode(images, directions, present)
    images[0, 1:] = 0.7
    assert torch.equal(before.encode(images, directions, present), codes)
    for name, value in network.state_dict().items():
        assert torch.equal(before.state_dict()[name], value)


def test_a_model_of_planes_reads_objects_of_several_picture_sizes():
    shape = replace(SHAPE, join="concatenate", choice="first", views=2, resolution=16)
    adapter = model(target="point_multiplane", network=PLACED, hypernetwork=shape, order="file")
    with torch.no_grad():
        prepared = [adapter.prepare(ball_views(ring(4, size))) for size in ((16, 16), (20, 24))]
        for one, each in zip(adapter.updates(prepared), prepared, strict=True):
            torch.testing.assert_close(one["fine.density.weight"], adapter.update(each)["fine.density.weight"])


def test_the_hypernetwork_reads_the_views_that_are_farthest_apart():
    chosen = views(8)[model().prepare(views(8)).hyperplanes]
    standing = torch.nn.functional.normalize(centres(chosen.cameras), dim=1)
    assert len(chosen) == 3
    assert (standing @ standing.T).fill_diagonal_(-1).max() < 0.2  # three of eight, more than 78 degrees apart


def test_directions_that_repeat_others_are_chosen_once_each():
    directions = torch.nn.functional.normalize(torch.randn(6, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    repeated = torch.cat([directions, directions[:2]])
    for first in range(8):
        order = farthest_first(repeated, first, 8)
        assert sorted(order) == list(range(8))
        assert {each % 6 for each in order[:6]} == set(range(6))


@pytest.mark.parametrize("reader", READERS)
def test_a_saved_model_is_loaded_again(tmp_path, reader):
    before = model(**READERS[reader])
    before.save(tmp_path)
    assert torch.equal(picture(HyperPlanes.from_pretrained(tmp_path), views(3)), picture(before, views(3)))


def test_half_precision_halves_the_file_and_hardly_changes_the_pictures(tmp_path):
    before = model(**READERS["volume"])
    before.save(tmp_path / "whole")
    before.save(tmp_path / "half", torch.float16)
    whole, half = ((tmp_path / name / "model.safetensors").stat().st_size for name in ("whole", "half"))
    assert half < 0.52 * whole
    after = HyperPlanes.from_pretrained(tmp_path / "half")
    assert {value.dtype for value in after.parameters()} == {torch.float32}
    torch.testing.assert_close(picture(after, views(3)), picture(before, views(3)), atol=2e-3, rtol=0)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"hypernetwork": replace(SHAPE, join="concatenate")}, "'concatenate'"),
        ({"hypernetwork": None, "autoencoder": AutoencoderConfig(views=2)}, "an autoencoder"),
    ],
)
def test_what_needs_a_fixed_number_of_views_is_refused(changes, found):
    with pytest.raises(ValueError, match=f"join 'mean'.*{found}"):
        HyperPlanes(replace(CONFIG, **changes))


def test_the_grid_of_an_object_is_that_of_its_own_volume():
    adapter = model(**READERS["volume"])
    with torch.no_grad():
        ball, other = (adapter.prepare(views(3, colour)) for colour in ((0.8, 0.2, 0.1), (0.1, 0.9, 0.3)))
        assert not torch.allclose(adapter.update(ball)["fine.grid.weight"], adapter.update(other)["fine.grid.weight"])
        swapped = replace(ball, volume=other.volume)
        torch.testing.assert_close(adapter.update(swapped), adapter.update(other))
    assert torch.equal(adapter.prepare(views(3), carved=False).volume, adapter.prepare(views(3)).volume)


def test_fields_with_fixed_planes_refuse_a_volume_hypernetwork():
    with pytest.raises(ValueError, match="hypernetwork.kind: expected one that reads images"):
        HyperPlanes(replace(CONFIG, target="point_multiplane", network=PLACED, hypernetwork=VOLUME))


HAZE = 5.0
"""Subtracted from the bias of the density, so that the ball is too transparent to occlude anything."""


def test_visibility_is_decided_by_the_surface_of_the_density_not_of_the_hull():
    adapter, support = model(**READERS["volume"]), views(6)
    with torch.no_grad():
        adapter.targets["fine"].density.bias.sub_(HAZE)
    found, context = adapter.adapt(support), adapter.prepare(support)
    by_hull = adapter.field(context, adapter.adapted_weights(context))
    planes = by_hull.field.planes.with_surface(by_hull.refined_occupancy.solid())
    expected = replace(by_hull, field=replace(by_hull.field, planes=planes)).render(ring(2, (10, 13), shift=1)).images
    assert torch.equal(picture(adapter, support), expected)
    assert not torch.allclose(by_hull.render(ring(2, (10, 13), shift=1)).images, expected, atol=1e-4)
    assert torch.equal(found.refined_occupancy.occupied, by_hull.refined_occupancy.occupied)
    for free in ("weights", "hypernetwork"):
        tuned = adapter.fine_tune(support, 0, FineTuning(trainable=free))
        torch.testing.assert_close(tuned.render(ring(2, (10, 13), shift=1)).images, expected)


def test_swapped_updates_use_the_surface_of_their_own_density():
    adapter = model(**READERS["volume"])
    with torch.no_grad():
        adapter.targets["fine"].density.bias.sub_(HAZE)
    objects = [views(6, colour) for colour in ((0.8, 0.2, 0.1), (0.1, 0.9, 0.3))]
    swapped = Swapped(adapter, objects).adapt(objects[0])
    with torch.no_grad():
        prepared = adapter.prepare(objects[0])
        weights = adapter.theta + adapter.update(adapter.prepare(objects[1]))
        expected, by_hull = adapter.rendering_field(prepared, weights), adapter.field(prepared, weights)
    cameras = ring(2, (10, 13), shift=1)
    assert torch.equal(swapped.render(cameras).images, expected.render(cameras).images)
    assert not torch.allclose(swapped.render(cameras).images, by_hull.render(cameras).images, atol=1e-4)


class Recorder:
    """A field with one variable that records which views are masked, and from which views rays come."""

    def __init__(self, support):
        self.value = torch.zeros(3, requires_grad=True)
        self.eyes, self.notes = centres(support.cameras), []

    def descent(self, support, settings, pixels=None):
        return Descent(self, [self.value], Parameters, support, settings, pixels, masks_views=True)

    def __call__(self, hidden):
        def trace(rays, generator=None):
            sources = torch.cdist(rays.origins, self.eyes).argmin(1)
            self.notes.append((None if hidden is None else set(hidden.tolist()), set(sources.tolist())))
            return Rendered(torch.sigmoid(self.value).expand(len(rays), 3), torch.ones(len(rays)), rays.far, len(rays))

        field = AdaptedField(lambda points, directions: (points, points[:, 0]), None, RayMarching())
        object.__setattr__(field, "trace", trace)
        return field


def test_with_two_views_the_view_of_the_rays_is_masked():
    recorder = Recorder(views(2))
    list(recorder.descent(views(2), FineTuning(rays=16)).run(8))
    assert len(recorder.notes) == 8
    assert all(hidden == sources and len(hidden) == 1 for hidden, sources in recorder.notes)


def test_a_single_view_is_not_fine_tuned_on_unless_it_may_be_copied():
    adapter = model(**READERS["volume"])
    for steps in (3, "auto"):
        with pytest.raises(ValueError, match="steps: expected 0 with a single view"):
            adapter.fine_tune(views(1), steps)
    adapter.fine_tune(views(1), 0)
    adapter.fine_tune(views(1), 1, FineTuning(mask_views=False, rays=16))


@pytest.mark.parametrize("draw", ["uniform", "contrast"])
@pytest.mark.parametrize("among", [False, True])
def test_rays_come_from_hidden_views_only(among, draw):
    support = views(12)
    pixels = (support.masks[:, 0] > 0).flatten().nonzero()[:, 0] if among else None
    recorder = Recorder(support)
    settings = FineTuning(rays=64, holdout=4, draw=draw)
    assert list(recorder.descent(support, settings, pixels).run(8))[-1] == 8
    assert all(sources <= hidden and len(hidden) == 3 for hidden, sources in recorder.notes)
    assert len(set.union(*(hidden for hidden, _ in recorder.notes))) > 6  # the masked views differ between steps


@pytest.mark.parametrize(("count", "settings"), [(1, FineTuning(rays=16)), (12, FineTuning(rays=16, mask_views=False))])
def test_no_view_is_masked_with_a_single_view_or_without_mask_views(count, settings):
    recorder = Recorder(views(count))
    list(recorder.descent(views(count), settings).run(3))
    assert [hidden for hidden, _ in recorder.notes] == [None] * 3


STEPS = {
    "weights": (30, FineTuning("weights", rays=128)),
    "hypernetwork": (4, FineTuning("hypernetwork", rays=128, learning_rate=3e-3)),
}


@pytest.mark.parametrize(("free", "gain"), [("weights", 1.0), ("hypernetwork", 0.05)])  # measured: 1.8, 4.6; 1.9, 0.10
@pytest.mark.parametrize("reader", READERS)
def test_fine_tuning_improves_new_views_and_leaves_the_model_as_it_is(reader, free, gain):
    adapter, support, query = model(**READERS[reader]), views(8), ball_views(ring(3, shift=1))
    before = {name: value.clone() for name, value in adapter.state_dict().items()}

    def quality(field):
        return float(psnr(field.render(query.cameras).images, query.images).mean())

    assert quality(adapter.fine_tune(support, *STEPS[free])) > quality(adapter.adapt(support)) + gain
    assert all(torch.equal(value, before[name]) for name, value in adapter.state_dict().items())


def test_steps_with_a_fresh_share_of_1_start_from_random_weights():
    adapter, support = model(**READERS["volume"]), views(4)
    cameras = ring(2, (10, 13), shift=1)
    fresh = adapter.fine_tune(support, 3, FineTuning(fresh=1.0, rays=64)).render(cameras).images
    assert torch.equal(fresh, FromScratch(adapter, 3, FineTuning(rays=64)).adapt(support).render(cameras).images)
    none = adapter.fine_tune(support, 3, FineTuning(fresh=0.0, rays=64)).render(cameras).images
    assert not torch.allclose(fresh, none, atol=1e-3)
    plain = adapter.fine_tune(support, 3, FineTuning(rays=64))
    assert torch.equal(none, plain.render(cameras).images)  # the default for few views
    assert FineTuning().fresh_share(MANY_VIEWS) == FRESH
    with pytest.raises(ValueError, match="fresh: expected a share"):
        FineTuning(fresh=1.5)


@pytest.mark.parametrize(
    ("changed", "expected"), [({"grid": 0}, "network.grid: "), ({"cells": 64}, "network.cells: expected 32")]
)
def test_what_a_hypernetwork_cannot_write_is_refused(changed, expected):
    config = model(**READERS["volume"]).config
    with pytest.raises(ValueError, match=expected):
        HyperPlanes(replace(config, network=replace(config.network, **changed)))


def test_zero_steps_give_the_adapted_field_for_any_fresh_share():
    adapter, support = model(**READERS["volume"]), views(6)
    cameras, done = ring(2, (10, 13), shift=1), []
    tuned = adapter.fine_tune(support, 0, FineTuning(fresh=0.7), on_step=done.append)
    assert torch.equal(tuned.render(cameras).images, adapter.adapt(support).render(cameras).images)
    assert done == [0]


@pytest.mark.parametrize("reader", READERS)
def test_a_model_in_double_precision_makes_the_same_pictures(reader):
    single, support = model(**READERS[reader]), views(4)
    found = picture(copy.deepcopy(single).double(), support)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, picture(single, support), atol=1e-3, rtol=0)


def test_a_model_in_half_precision_is_refused_in_one_line():
    with pytest.raises(ValueError, match="model: expected weights of single or double precision, got torch.float16"):
        model(**READERS["volume"]).half().adapt(views(2))


@pytest.mark.parametrize("free", ["weights", "hypernetwork"])
def test_weights_of_one_object_reproduce_its_field_and_its_surface(free):
    adapter, support = model(**READERS["volume"]), views(6)
    with torch.no_grad():
        adapter.targets["fine"].density.bias.sub_(HAZE - 1)
    tuned = adapter.fine_tune(support, 3, FineTuning(free, rays=64))
    cameras = ring(2, (10, 13), shift=1)
    again = adapter.with_weights_of(tuned).adapt(support).render(cameras).images
    torch.testing.assert_close(again, tuned.render(cameras).images, atol=1e-6, rtol=0)
    before = adapter.adapt(support).field.planes
    assert not torch.equal(before._surface, tuned.field.planes._surface)  # the surface is that of the tuned weights
