"""Source of truth: pictures of a rotated scene, which must be those of the scene, and known rotations."""

import json
import math
from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import AdaptedField, HullBlend, HyperPlanes, ModelConfig
from hyperplanes.adaptation.alignment import canonical_frame
from hyperplanes.adaptation.alignment.canonical_frame import (
    GAIN,
    MAX_VIEWS,
    MIN_VIEWS,
    find_rotation,
    to_canonical_frame,
)
from hyperplanes.adaptation.alignment.rotation import RotatedField, Rotation
from hyperplanes.adaptation.correction.stacking import StackedField
from hyperplanes.adaptation.fine_tuning import NoProgressError, ignoring_no_progress
from hyperplanes.adaptation.optimisation.descent import Descent, split_holdout
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.adaptation.symmetry.reflections import reflected
from hyperplanes.commands.inputs.fields import adapt_to
from hyperplanes.commands.output.console import Console
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.export.baking import BakedScene, bake
from hyperplanes.geometry import Sphere
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry
from hyperplanes.methods import WithSampler
from hyperplanes.rendering import Hierarchical, RayMarching
from hyperplanes.rendering.scene import SplitField
from hyperplanes.utilities.images.metrics import psnr
from tests.adaptation.test_stacking import CONFIG
from tests.adaptation.test_symmetry import ACROSS, BODY, SMALL, balls, cameras, model
from tests.reference_rendering import ring

ANGLE = 0.7
BESIDE = Sphere((0.2, -0.1, 0.1), 1.1)


def made(**changes):
    """The field of an object, with a high density in its hull."""
    adapter = model(**changes)
    with torch.no_grad():
        adapter.theta["fine.density.bias"].fill_(1.0)
    return adapter.adapt_to(adapter.prepare(balls(cameras(6, SMALL), BODY, BESIDE), symmetry=adapter.config.symmetry))


@pytest.mark.parametrize("hull_share", [0.0, 0.3, 0.9])
def test_a_rotated_field_looks_the_same_to_rotated_cameras(hull_share):
    field, rotation = made(stacked=False, hull_share=hull_share), Rotation(ANGLE)
    rotated = rotation.field(field)
    assert isinstance(rotated, RotatedField)
    assert isinstance(field, StackedField) == bool(hull_share)
    asked = ring(2, SMALL, shift=1)
    found = rotated.render(camera.moved(asked, rotation.about(BESIDE)))
    expected = field.render(asked)
    for name in ("images", "opacity", "depth"):
        assert (getattr(found, name) - getattr(expected, name)).abs().median() < 1e-4, name
    assert float(psnr(found.images, expected.images).min()) > 40
    # other cameras see something else
    assert float(psnr(rotated.render(asked).images, expected.images).max()) < 30
    # back again
    again = rotation.inverse.field(rotated).render(asked)
    assert float(psnr(again.images, expected.images).min()) > 40


def test_densities_colours_and_rays_of_a_rotated_field_agree_at_rotated_points():
    field, rotation = made(stacked=False), Rotation(ANGLE)
    rotated, motion = rotation.field(field), rotation.about(BESIDE).float()
    points = BESIDE.radius * (torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    along = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    moved, turned = points @ motion[:3, :3].T + motion[:3, 3], along @ motion[:3, :3].T
    with torch.no_grad():
        colour, density = rotated(moved, turned)
        hidden = rotated.field.hidden(moved)
        torch.testing.assert_close(rotated.field.density_of(hidden), density, atol=1e-3, rtol=1e-3)
        torch.testing.assert_close(rotated.field.colour_of(hidden, turned), colour, atol=1e-4, rtol=1e-3)
        # rounding changes the visibility of a few points
        expected = field(points, along)
        assert ((colour - expected[0]).abs().amax(1) < 1e-3).float().mean() > 0.98
        assert ((density - expected[1]).abs() < 1e-2 * (1 + expected[1])).float().mean() > 0.98
        torch.testing.assert_close(rotated.density(moved), density, atol=1e-3, rtol=1e-3)
        views = balls(cameras(1), BODY, BESIDE)
        seen = rotated.trace(rotation.views(views).rays(0), differentiable=False).colour
        truth = field.trace(views.rays(0), differentiable=False).colour
        assert ((seen - truth).abs().amax(1) < 1e-3).float().mean() > 0.98
    assert (rotated.dtype, rotated.thread_safe) == (field.dtype, field.thread_safe)
    # the voxels contain those of the other field, and not many more
    inside = field.occupancy.contains(points)
    assert inside.any()
    assert rotated.occupancy.contains(moved)[inside].all()
    assert rotated.occupancy.occupied.sum() < 4 * field.occupancy.occupied.sum()


def test_voxels_of_a_rotated_field_are_in_the_frame_of_the_scene():
    field, rotation = HullBlend().adapt(balls(cameras(6), BODY, BESIDE)), Rotation(ANGLE)
    asked = ring(2, SMALL, shift=1)
    expected = BakedScene(bake(field, side=64)).render(asked).images
    rotated = BakedScene(bake(rotation.field(field), side=64))
    found = rotated.render(camera.moved(asked, rotation.about(BESIDE))).images
    assert float(psnr(found, expected).min()) > 22
    assert float(psnr(rotated.render(asked).images, expected).max()) < 18


def test_a_rotated_symmetry_is_that_of_the_rotated_views():
    views, rotation = balls(cameras(), BODY, BESIDE), Rotation(ANGLE)
    symmetry = Symmetry(Plane.of_sphere(BESIDE, (0.6, 0.0, 0.8), 0.1))
    found = rotation.symmetry(symmetry, BESIDE)
    one, other = rotation.views(reflected(views, symmetry.plane)), reflected(rotation.views(views), found.plane)
    torch.testing.assert_close(one.cameras.extrinsics, other.cameras.extrinsics, atol=1e-5, rtol=0)
    assert rotation.inverse.symmetry(found, BESIDE).plane.offset == pytest.approx(symmetry.plane.offset)
    several = Symmetry(Plane.of_sphere(BESIDE, (1.0, 0.0, 0.0)), 3, BESIDE.centre)
    moved = Rotation(ANGLE).symmetry(several, Sphere((1.0, 0.0, 2.0)))
    assert moved.order == 3  # the plane contains the axis, or it would be refused


def found_by(monkeypatch, qualities, symmetry=ACROSS, count=4, **changes):
    """The rotation in degrees that is found if held-out views have these PSNR for the rotations, in order of trial."""
    tried = []

    def quality(network, placed, held_out):
        angle = math.degrees(placed.rotation.angle)
        if angle not in tried:
            tried.append(angle)
        found = qualities[tried.index(angle)]
        return found if isinstance(found, float) else found[held_out]

    monkeypatch.setattr(canonical_frame, "_quality", quality)
    with torch.no_grad():
        torch.set_num_threads(1)
        found = find_rotation(model(**changes), balls(cameras(count, SMALL), BODY), symmetry)
    return math.degrees(found.angle)


def turned(angle):
    """The symmetry about x = 0, rotated by an angle."""
    return Symmetry(Plane((math.cos(angle), 0.0, -math.sin(angle))))


@pytest.fixture(autouse=True)
def threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_held_out_views_choose_a_rotation_that_aligns_the_plane_with_an_axis(monkeypatch):
    assert found_by(monkeypatch, [21.0, 22.0, 24.0, 23.0]) == pytest.approx(180)
    assert found_by(monkeypatch, [21.0, 23.0, 22.0, 24.0], turned(0.5)) == pytest.approx(270 - math.degrees(0.5))
    assert found_by(monkeypatch, [21.0, 21.0, 21.0, 21.0], turned(1.2)) == pytest.approx(90 - math.degrees(1.2))
    # below the required gain, an object whose plane is aligned already is not rotated; any other one is
    less, more = 21 + GAIN - 0.01, 21 + GAIN + 0.01
    assert found_by(monkeypatch, [21.0, less, 21.0, 21.0]) == 0
    assert found_by(monkeypatch, [21.0, more, 21.0, 21.0]) == pytest.approx(90)
    assert found_by(monkeypatch, [21.0, less, 21.0, 21.0], turned(0.5)) == pytest.approx(90 - math.degrees(0.5))


def test_psnr_is_averaged_over_held_out_views(monkeypatch):
    """With the sum of squared errors, the second view alone would decide, which no rotation renders well."""
    one, other = (30.0, 10.0), (26.0, 10.5)
    assert found_by(monkeypatch, [one, other, 10.0, 10.0], turned(0.5)) == pytest.approx(-math.degrees(0.5))
    assert found_by(monkeypatch, [other, one, 10.0, 10.0], turned(0.5)) == pytest.approx(90 - math.degrees(0.5))


def test_objects_without_a_suitable_symmetry_or_number_of_views_are_not_rotated(monkeypatch):
    better = [21.0, 24.0, 22.0, 22.0]
    assert found_by(monkeypatch, better) == pytest.approx(90)
    assert found_by(monkeypatch, better, None) == 0
    assert found_by(monkeypatch, better, Symmetry(Plane((0.0, 1.0, 0.0)))) == 0
    assert found_by(monkeypatch, better, replace(ACROSS, order=3)) == 0
    assert found_by(monkeypatch, better, count=MIN_VIEWS - 1) == 0
    assert found_by(monkeypatch, better, count=MAX_VIEWS + 1) == 0
    assert found_by(monkeypatch, better, azimuth=0.0) == 0
    assert found_by(monkeypatch, better, None, azimuth=1.0) == pytest.approx(math.degrees(1.0))


def test_the_quality_of_a_frame_is_that_of_a_held_out_view(monkeypatch):
    adapter, views = model(), balls(cameras(4, SMALL), BODY)
    shown = []
    prepare = adapter.prepare
    monkeypatch.setattr(adapter, "prepare", lambda views, **keys: shown.append(views) or prepare(views, **keys))
    placed = canonical_frame.Placed(views, ACROSS, Rotation())
    found = canonical_frame._quality(adapter, placed, 2)
    assert [torch.equal(a, b) for a, b in zip(shown[0].images, views.images[[0, 1, 3]], strict=True)] == [True] * 3
    assert found == canonical_frame._quality(adapter, placed, 2) != canonical_frame._quality(adapter, placed, 1)
    alone = replace(views, masks=torch.where(torch.arange(4)[:, None, None, None] == 2, views.masks, 0.0))
    assert canonical_frame._quality(adapter, replace(placed, views=alone), 2) == 0


@pytest.mark.parametrize("steps", [0, 2])
def test_a_field_is_saved_with_its_frame_and_rendered_in_that_of_the_scene(steps):
    """A known rotation gives the same pictures as rotating the scene first."""
    views, rotation = balls(cameras(4, SMALL), BODY), Rotation(ANGLE)
    adapter = model(azimuth=ANGLE, symmetry=ACROSS)
    with torch.no_grad():
        adapter.theta["fine.density.bias"].fill_(1.0)
    found = adapter.fine_tune(views, steps, FineTuning(rays=64))
    plain = type(adapter)(replace(adapter.config, azimuth=0.0)).eval()
    plain.load_state_dict(adapter.state_dict())
    turned_views = rotation.views(views)
    plain.config = replace(plain.config, symmetry=rotation.symmetry(ACROSS, views.bounds))
    expected = plain.fine_tune(turned_views, steps, FineTuning(rays=64)).render(turned_views.cameras).images
    pictures = found.render(views.cameras).images
    assert float(psnr(pictures, expected).min()) > 35
    as_it_faces = plain.fine_tune(views, steps, FineTuning(rays=64)).render(views.cameras).images
    assert float(psnr(as_it_faces, pictures).max()) < 30
    alone = adapter.with_weights_of(found)
    assert alone.config.azimuth == pytest.approx(ANGLE)
    assert type(alone.config).of_json(json.loads(json.dumps(alone.config.as_json()))) == alone.config
    again = alone.adapt(views).render(views.cameras).images
    assert float(psnr(again, pictures).min()) > 60


def test_a_placed_object_is_rotated_with_its_symmetry():
    views = balls(cameras(), BODY)
    placed = to_canonical_frame(model(azimuth=ANGLE), views)
    assert placed.rotation == Rotation(ANGLE)
    assert placed.symmetry == Rotation(ANGLE).symmetry(ACROSS, views.bounds)
    torch.testing.assert_close(placed.views.cameras.extrinsics, Rotation(ANGLE).views(views).cameras.extrinsics)
    unrotated = to_canonical_frame(model(azimuth=0.0), views)
    assert unrotated.views is views
    assert unrotated.in_scene(field := made(stacked=False)) is field


def test_a_field_with_a_swapped_update_is_in_the_frame_of_the_scene():
    views, other = balls(cameras(4, SMALL), BODY), balls(cameras(4, SMALL), BODY[:2])
    found = Swapped(model(azimuth=ANGLE, symmetry=ACROSS), [views, other]).adapt(views)
    assert isinstance(found, RotatedField)
    assert found.rotation == Rotation(-ANGLE)


def test_a_field_with_fixed_planes_refuses_an_azimuth():
    with pytest.raises(ValueError, match="azimuth: expected a field that takes any number of views"):
        HyperPlanes(ModelConfig(azimuth=ANGLE))


def test_views_that_auto_holds_out_are_rotated_with_the_others(monkeypatch):
    views, settings, seen = balls(cameras(6, SMALL), BODY), FineTuning(rays=16, max_steps=2), []
    monkeypatch.setattr(Descent, "best_stop", lambda self, holdout, **options: seen.append(holdout) or 1)
    ignoring_no_progress(lambda: model(azimuth=ANGLE, symmetry=ACROSS).fine_tune(views, "auto", settings))
    _, expected = split_holdout(Rotation(ANGLE).views(views), settings)
    torch.testing.assert_close(seen[0].cameras.extrinsics, expected.cameras.extrinsics)


@pytest.mark.parametrize("angle", [0.0, ANGLE])
def test_the_field_of_unsuccessful_steps_is_in_the_frame_of_the_scene(angle, monkeypatch):
    views, settings = balls(cameras(4, SMALL), BODY), FineTuning(rays=16)
    adapter = model(azimuth=angle, symmetry=ACROSS)
    expected = ignoring_no_progress(lambda: adapter.fine_tune(views, 1, settings))
    monkeypatch.setattr(Descent, "errors", lambda self: (0.0, 0.0))
    with pytest.raises(NoProgressError) as caught:
        adapter.fine_tune(views, 1, settings)
    found = caught.value.field
    assert isinstance(found, RotatedField) == bool(angle)
    torch.testing.assert_close(found.render(views.cameras).images, expected.render(views.cameras).images)


@pytest.mark.parametrize("angle", [0.0, ANGLE])
def test_a_protocol_applies_to_a_rotated_field(angle):
    views, sampler = balls(cameras(4, SMALL), BODY), Hierarchical(2, 2)
    adapter = model(azimuth=angle, symmetry=ACROSS, stacked=False)
    found = WithSampler(adapter, sampler).adapt(views).render(views.cameras)
    height, width = SMALL
    assert found.samples == len(views) * height * width * (2 + 4)


def test_finding_a_rotation_leaves_the_mode_and_the_weights_of_a_model(monkeypatch):
    """With two threads: the first one to end must not switch the model back to training mode for the other."""
    monkeypatch.setattr(canonical_frame, "HELD_OUT_PIXELS", 64)
    views = replace(balls(cameras(2, SMALL), BODY), masks=None)  # without a hull
    adapter, before = HyperPlanes(replace(CONFIG, symmetric=True)).train(), torch.get_num_threads()
    kept = {name: value.clone() for name, value in adapter.state_dict().items()}
    torch.set_num_threads(2)
    try:
        for _ in range(3):
            find_rotation(adapter, views, ACROSS)
    finally:
        torch.set_num_threads(before)
    assert all(part.training for part in adapter.modules())
    assert all(torch.equal(value, kept[name]) for name, value in adapter.state_dict().items())


@pytest.mark.parametrize("angle", [math.nan, math.inf])
def test_an_angle_that_is_not_finite_is_refused(angle):
    with pytest.raises(ValueError, match="azimuth: expected a finite angle in radians"):
        model(azimuth=angle)


def test_a_command_prints_that_an_object_was_rotated(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("HYPERPLANES_CACHE", str(tmp_path))
    for angle, said in ((ANGLE, True), (0.0, False)):
        adapt_to(model(azimuth=angle, symmetry=ACROSS), balls(cameras(4, SMALL), BODY), "balls", Console())
        assert ("rotated into its canonical frame" in "".join(capsys.readouterr())) == said


def test_a_field_that_is_a_plain_function_stays_one():
    field = AdaptedField(lambda points, directions: (points, points[:, 0]), full(BESIDE, 4), RayMarching(4))
    rotated, points = Rotation(math.pi / 2).field(field), torch.tensor([[0.2, 0.3, 0.5]])
    assert not isinstance(rotated.field, SplitField)
    # a quarter turn about (0.2, y, 0.1) maps z to x, so that the point comes from x = 0.6
    torch.testing.assert_close(rotated(points, points)[0], torch.tensor([[-0.2, 0.3, 0.1]]))
