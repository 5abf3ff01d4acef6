"""Source of truth: results on the CPU, with which a GPU, or a device in CPU memory, agrees within rounding."""

import copy
from contextlib import nullcontext
from dataclasses import replace
from functools import cache, partial

import pytest
import torch
from second_device import AVAILABLE, second_device

from hyperplanes.adaptation import CorrectedField, HyperPlanes
from hyperplanes.adaptation.alignment import canonical_frame
from hyperplanes.adaptation.alignment.canonical_frame import Placed
from hyperplanes.adaptation.alignment.rotation import Rotation
from hyperplanes.adaptation.baselines.hull_blend import HullBlend
from hyperplanes.adaptation.correction import held_out
from hyperplanes.adaptation.correction.stacking import StackedField
from hyperplanes.adaptation.symmetry import detection as symmetry
from hyperplanes.adaptation.symmetry import reflections
from hyperplanes.adaptation.symmetry.detection import Fold
from hyperplanes.adaptation.symmetry.judging import SymmetryJudge, carved
from hyperplanes.adaptation.symmetry.reflections import with_reflections
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.configuration.presets import preset
from hyperplanes.data import read_task
from hyperplanes.export.baking import bake
from hyperplanes.geometry import ImagePlanes, carve
from hyperplanes.geometry.symmetry.mirror_symmetry import more_symmetric_plane, most_symmetric_plane
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry
from hyperplanes.rendering import RayMarching
from hyperplanes.training import Trainer
from hyperplanes.views import Task

CPU = torch.device("cpu")
HAS_GPU = torch.cuda.is_available()
pytestmark = pytest.mark.skipif(not (HAS_GPU or AVAILABLE), reason="needs a GPU, or PyTorch with backends in Python")
ALL_SAMPLES = RayMarching(32, 0.0)
"""Rays do not stop, so that all samples have gradients and none are chosen at random."""
PLAIN = {"antialias": False, "mixed_precision": False}
ACROSS = Plane((1.0, 0.0, 0.0), 0.0)


def other_device():
    return nullcontext(torch.device("cuda")) if HAS_GPU else second_device()


def on_both(compute):
    """The results of a function of the device, on the other device and on the CPU."""
    expected = compute(CPU)
    with other_device() as device:
        return compute(device), expected


@cache
def example():
    return read_task("example-car")


def car(device, shown=3, size=16):
    task = example()
    support, query = (
        each.resized(size).to(device) for each in (task.support[:: len(task.support) // shown], task.query[:1])
    )
    return Task(support[:shown], query, task.name)


@cache
def pretrained():
    return HyperPlanes.from_pretrained("small")


def small(device, **changes):
    model = copy.deepcopy(pretrained()).to(device)
    coarse = {"symmetric": False, "hull_resolution": 16, "sampling": ALL_SAMPLES, "learned_steps": 0}
    model.config = replace(model.config, **coarse | changes)
    return model


def test_masked_planes_and_hulls_take_points_and_cameras_from_another_device():
    views = car(CPU).support
    planes = ImagePlanes(views.images, views.cameras, exact=True).mask_views(torch.tensor([0]))
    points = torch.rand(9, 3) - 0.5
    hull = carve(views.masks, views.cameras, views.bounds, 8)
    expected = planes.lookup(points)
    with other_device() as device:
        found, voxels = planes.lookup(points.to(device)), carve(views.masks.to(device), views.cameras, views.bounds, 8)
        assert torch.equal(found.valid.cpu(), expected.valid)
        torch.testing.assert_close(found.colours.cpu(), expected.colours, atol=1e-5, rtol=0)
        assert torch.equal(voxels.occupied.cpu(), hull.occupied)


def test_operands_on_two_devices_are_refused():
    with other_device() as device:
        there = torch.ones(2, 3, device=device)
        assert (there + 1).device.type == device.type
        with pytest.raises(RuntimeError, match="Expected all tensors to be on the same device"):
            there + torch.ones(2, 3)
        with pytest.raises(TypeError, match="to numpy"):
            there.numpy()


def test_lookups_and_their_gradients():
    def pulled(where):
        support = car(where).support
        points = torch.linspace(-0.4, 0.4, 60).reshape(20, 3).to(where).requires_grad_()
        found = ImagePlanes(support.images, support.cameras, exact=True).lookup(points, return_directions=True)
        return torch.cat([found.colours.flatten(), *torch.autograd.grad(found.colours.square().sum(), points)[0]])

    found, expected = on_both(pulled)
    torch.testing.assert_close(found.cpu(), expected, atol=1e-3, rtol=1e-4)


def test_one_forward_pass_gives_the_same_picture():
    def shown(where):
        task = car(where)
        return small(where, learned_steps=1).adapt(task.support).render(task.query.cameras, **PLAIN)

    found, expected = on_both(shown)
    assert found.images.device.type != "cpu"
    assert float((found.images.cpu() - expected.images).square().mean()) < 1e-5
    assert float(expected.opacity.mean()) > 0.05


def test_corrected_pictures_are_the_same(monkeypatch):
    """With stacking, whose weights held-out views decide."""
    monkeypatch.setattr(held_out, "HELD_OUT_PIXELS", 128)

    def shown(where):
        task = car(where, shown=10)
        field = small(where).adapt(task.support)
        assert isinstance(field, CorrectedField)
        assert isinstance(field.uncorrected, StackedField)
        return field.render(task.query.cameras, mixed_precision=False).images

    found, expected = on_both(shown)
    assert float((found.cpu() - expected).square().mean()) < 1e-5


def test_fine_tuned_fields_give_the_same_picture():
    settings = FineTuning(rays=64)

    def tuned(where):
        task = car(where)
        field = small(where, learned_steps=1).fine_tune(task.support, 2, settings)
        return field.render(task.query.cameras, **PLAIN).images

    found, expected = on_both(tuned)
    assert float((found.cpu() - expected).square().mean()) < 1e-4


def test_rays_that_end_when_they_are_opaque_have_the_same_colours():
    """The CPU evaluates samples in rounds until the transmittance is low; other devices evaluate all at once.

    There are no learned steps, because they read gradients of such rays, and their results differ by 1.5 %.
    """

    def shown(where):
        task, finer = car(where, size=24), {"hull_resolution": 24, "sampling": RayMarching(64, 5e-3)}
        field = small(where, **finer).adapt(task.support)
        rays, _ = task.query.sample_rays(150, generator=torch.Generator().manual_seed(0))
        placed = len(field.sampling.place(rays, field.occupancy))
        drawn = torch.Generator().manual_seed(1)
        with torch.enable_grad():
            found = [field.trace(rays, differentiable=False), field.trace(rays, drawn)]
        assert found[0].samples < placed if where == CPU else found[0].samples == placed
        return [each.colour.detach().cpu() for each in found]

    for there, here in zip(*on_both(shown), strict=True):
        assert float((here - there).square().mean()) < 1e-6


def test_symmetry_planes_are_the_same():
    def found(where):
        support = car(where, shown=12, size=32).support
        hull = carve(support.masks, support.cameras, support.bounds, 32)
        planes = [most_symmetric_plane(hull), more_symmetric_plane(hull, ACROSS)]
        return torch.tensor([[*plane.normal, plane.offset] for plane in planes])

    torch.testing.assert_close(*on_both(found), atol=0.02, rtol=0)


def test_errors_of_symmetry_planes_are_the_same(monkeypatch):
    monkeypatch.setattr(symmetry, "PIXELS_PER_FOLD", 256)
    monkeypatch.setattr(symmetry, "carved", partial(carved, side=24))
    for module in (symmetry, reflections):
        monkeypatch.setattr(module, "HULL_SIDE", 24)

    def judged(where):
        support = car(where, shown=4, size=16).support
        return [
            SymmetryJudge.of(support, 16, 24).error(Symmetry(ACROSS)),
            Fold.of(support, [1]).error(Symmetry(ACROSS)),
        ]

    found, expected = on_both(judged)
    assert found == pytest.approx(expected, rel=0.02)


def test_qualities_of_frames_and_pictures_of_rotated_fields_are_the_same():
    def judged(where):
        task, model = car(where, shown=3, size=16), small(where)
        placed = Placed(Rotation(0.5).views(task.support), None, Rotation(0.5))
        field = placed.in_scene(model.adapt_to(model.prepare(placed.views)))
        picture = field.render(task.query.cameras, **PLAIN).images.cpu()
        centres = field.occupancy.centres()
        return canonical_frame._quality(model, placed, 1), float(field.density(centres).detach().mean()), picture

    (quality, density, picture), expected = on_both(judged)
    assert (quality, density) == pytest.approx(expected[:2], rel=0.02)
    assert float((picture - expected[2]).square().mean()) < 1e-4


def test_the_hull_blend_of_views_and_reflections_is_the_same(monkeypatch):
    monkeypatch.setattr(reflections, "HULL_SIDE", 32)

    def shown(where):
        task = car(where)
        return (
            HullBlend(side=32, steps=64)
            .adapt(with_reflections(task.support, Symmetry(ACROSS)))
            .render(task.query.cameras, **PLAIN)
            .images
        )

    found, expected = on_both(shown)
    assert float((found.cpu() - expected).square().mean()) < 1e-4


def test_a_training_step_has_the_same_loss():
    class One:
        def names(self, split):
            return ["car"] if split == "train" else []

        def task(self, name):
            return car(CPU, shown=6)

    def loss(where):
        settings = replace(preset("small").training, prefetch=0, tasks=1, rays=32, precision="single")
        return Trainer(small(where), One(), settings).take_step()

    found, expected = on_both(loss)
    assert found == pytest.approx(expected, rel=1e-3)


def test_baked_voxels_are_as_many():
    found, expected = on_both(lambda where: bake(small(where).adapt(car(where).support), side=16).values)
    assert found.device.type == "cpu"
    assert abs(len(found) - len(expected)) <= 0.02 * len(expected)
