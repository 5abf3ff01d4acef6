"""Tests of pose refinement.

Source of truth: the poses from which the images of example-car were rendered, perturbed here by known motions.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.capture import pose_refinement
from hyperplanes.capture.pose_refinement import refine_poses
from hyperplanes.commands.inputs import background
from hyperplanes.commands.inputs import poses as command
from hyperplanes.commands.inputs.scene import prepare_task
from hyperplanes.commands.output.console import Console
from hyperplanes.data import read_task
from hyperplanes.data.inspection.matches import sampson
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import distorted
from hyperplanes.views import Task, join_views

DEGREES = 2.0


@pytest.fixture(scope="module")
def views():
    task = read_task("example-car")
    return join_views(task.support, task.query)[list(range(0, 50, 3))]


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setattr(pose_refinement, "LEVELS", ((32, 16, 60), (64, 24, 60)))
    monkeypatch.setattr(pose_refinement, "RAYS_PER_STEP", 256)
    monkeypatch.setattr(pose_refinement, "FIXED", 0)


def perturbed(views):
    """Views whose cameras are rotated by two degrees and moved by 0.035 of their distance, in random directions."""
    generator = torch.Generator().manual_seed(0)
    draw = torch.nn.functional.normalize(torch.randn(2, len(views), 3, generator=generator), dim=-1)
    turn, shift = draw * math.radians(DEGREES)
    twist = torch.zeros(len(views), 4, 4)
    twist[:, [2, 0, 1], [1, 2, 0]], twist[:, [1, 2, 0], [2, 0, 1]] = turn, -turn
    twist[:, :3, 3] = shift * camera.centres(views.cameras).norm(dim=1, keepdim=True)
    pose = torch.linalg.matrix_exp(twist) @ camera.camera_from_world(views.cameras)
    return replace(views, cameras=camera.with_poses(views.cameras, pose))


def epipolar_error(cameras, views):
    """The median Sampson error in pixels of points on the object. A common motion of all cameras does not change it."""
    points = torch.randn(60, 3, generator=torch.Generator().manual_seed(1)) * 0.3
    pixels = views.cameras.project(points.expand(len(views), -1, 3)).double()
    pose, matrix = camera.camera_from_world(cameras).double(), camera.intrinsics(cameras).double()
    errors = []
    for step in (1, 3):
        other = torch.arange(len(views)).roll(step)
        pairs = torch.stack([pixels, pixels[other]], 2).flatten(0, 1)
        motion = (pose[other] @ torch.linalg.inv(pose)).repeat_interleave(60, 0)
        calibrations = [each.repeat_interleave(60, 0) for each in (matrix, matrix[other])]
        errors.append(sampson(pairs, *calibrations, motion))
    return float(torch.cat(errors).median())


def test_perturbed_poses_are_recovered(views):
    wrong, told = perturbed(views), []
    before = epipolar_error(wrong.cameras, views)
    found = refine_poses(wrong, on_step=lambda done, total: told.append((done, total)))
    assert before > 1
    assert epipolar_error(found.views.cameras, views) < 0.25 * before
    assert told[0] == (1, 120)
    assert told[-1] == (120, 120)
    assert torch.equal(found.views.images, wrong.images)
    assert found.turned.shape == (len(views),)


def test_a_common_motion_of_all_cameras_is_removed(views):
    moving = pose_refinement._MovedCameras(views.cameras, views.bounds)
    with torch.no_grad():
        moving.twist[:] = torch.tensor([0.3, -0.2, 0.1, 0.2, 0.4, -0.1])
    torch.testing.assert_close(moving().extrinsics, views.cameras.extrinsics, atol=1e-5, rtol=0)


def test_refined_poses_are_the_same_without_gradients_and_under_autocast(views, monkeypatch):
    monkeypatch.setattr(pose_refinement, "LEVELS", ((16, 8, 3),))
    expected = refine_poses(views).views.cameras.extrinsics
    for mode in (torch.no_grad(), torch.autocast("cpu", torch.bfloat16)):
        with mode:
            assert torch.equal(refine_poses(views).views.cameras.extrinsics, expected)
    with (
        torch.inference_mode(),
        pytest.raises(RuntimeError, match=r"refine_poses: expected gradients, got torch\.inference_mode"),
    ):
        refine_poses(views)


def test_few_views_and_lens_distortion_are_refused(views):
    with pytest.raises(ValueError, match="views: expected at least 5 without lens distortion to refine poses, got 4"):
        refine_poses(views[:4])
    bent = replace(views, cameras=distorted(views.cameras, torch.full((5,), 1e-3)))
    with pytest.raises(ValueError, match="got 17 with lens distortion"):
        refine_poses(bent)


@pytest.mark.parametrize(("better", "said"), [(True, "poses: refined, turned by "), (False, "poses: as given, ")])
def test_held_out_views_decide_and_the_result_is_cached(views, capsys, monkeypatch, tmp_path, better, said):
    """The PSNR of held-out views is given here; the poses of support and query views are the given or the refined ones.

    A second call gives the same result from the cache, without another refinement.
    """
    from hyperplanes.evaluation import suitability

    figures = iter([(20.0, 0.0), (21.0 if better else 20.4, 0.0)])
    monkeypatch.setattr(suitability, "held_out_psnr", lambda *_: next(figures))
    monkeypatch.setattr(pose_refinement, "LEVELS", ((16, 8, 2),))
    monkeypatch.setenv("HYPERPLANES_CACHE", str(tmp_path))
    task, source = Task(views[:9], views[9:], "car"), HyperPlanes.from_pretrained("cars-64")
    found = command.refine_task(source, task, Console())
    assert said in capsys.readouterr().out
    for old, new in ((task.support, found.support), (task.query, found.query)):
        assert (new is not old) == better
        assert torch.equal(new.images, old.images)
        assert torch.equal(new.cameras.extrinsics, old.cameras.extrinsics) != better
    monkeypatch.setattr(pose_refinement, "refine_poses", None)
    again = command.refine_task(source, task, Console())
    assert said in (told := capsys.readouterr().out)
    assert f"kept in {tmp_path}" in told
    assert torch.equal(again.query.cameras.extrinsics, found.query.cameras.extrinsics)


def test_too_few_support_views_to_compare_poses_are_refused_before_poses_are_refined(views, monkeypatch):
    monkeypatch.setattr(pose_refinement, "refine_poses", None)
    task = Task(views[:3], views[3:], "car")
    with pytest.raises(ValueError, match="--refine-poses: expected at least 4 support views .*, got 3"):
        command.refine_task(HyperPlanes.from_pretrained("cars-64"), task, Console())
    monkeypatch.setattr(background, "cut_out_task", None)  # which takes minutes, is not begun
    both = SimpleNamespace(refine_poses=True, learn_background=True)
    with pytest.raises(ValueError, match="--refine-poses: expected at least 4 support views"):
        prepare_task(both, task, HyperPlanes.from_pretrained("cars-64"), Console(), all_views=False)
