"""Source of truth: cameras with a known perturbation, which the example removes, at a small size."""

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image

from hyperplanes.geometry import cameras

PATH = Path(__file__).resolve().parents[2] / "examples" / "refine_cameras.py"
SPECIFICATION = importlib.util.spec_from_file_location("refine_cameras", PATH)
example = importlib.util.module_from_spec(SPECIFICATION)
sys.modules["refine_cameras"] = example  # dataclasses look up their module
SPECIFICATION.loader.exec_module(example)


def test_perturbations_have_the_stated_size():
    """Closed form: rotations of 5 to 10 degrees, translations of 2.5 to 5 % of the distance."""
    true = cameras.fibonacci_sphere(20, 2.7)
    degrees, percent = example.errors(example.perturbed(true, 10.0, 0.05, 0), true)
    assert ((degrees > 4.99) & (degrees < 10.01)).all()
    assert ((percent > 2.49) & (percent < 5.01)).all()


def test_perturbed_cameras_are_corrected():
    scene, true = example.Blobs.make(), cameras.fibonacci_sphere(2, 2.7, -0.5, 0.8)
    start = example.perturbed(true, 5.0, 0.03, 1)
    result = example.refine(scene, start, true, 24, 160)
    degrees, percent = example.errors(result.pose, true)
    assert degrees.max() < 0.5
    assert percent.max() < 1
    assert torch.tensor(result.degrees)[0] > 2


def test_the_plot_is_written(tmp_path, monkeypatch):
    """Another implementation: the pictures of the example's cameras, and the errors that it reports."""
    figures, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *file, **how: figures.append(self) or save(self, *file, **how))
    scene, true = example.Blobs.make(2), cameras.fibonacci_sphere(1, 2.7)
    start = example.perturbed(true, 5.0, 0.03, 0)
    result = example.refine(scene, start, true, 8, 2)
    example.plot(scene, true, start, result, tmp_path / "plot.png")
    with Image.open(tmp_path / "plot.png") as picture:
        assert picture.size == (900, 650)
    *shown, curves = figures[0].axes
    assert [axes.get_ylabel() for axes in shown] == ["start", "found", "truth"]
    intrinsics = cameras.symmetric_intrinsics(96, 96, math.radians(50))
    for axes, pose in zip(shown, (start, result.pose, true), strict=True):
        with torch.no_grad():
            expected = example.render_pixels(scene, cameras.pinhole(intrinsics, pose, 96, 96)).reshape(96, 96, 3)
        np.testing.assert_allclose(axes.get_images()[0].get_array(), expected.clamp(0, 1), atol=1e-6)
    assert [list(line.get_ydata()) for line in curves.get_lines()[:2]] == [result.degrees, result.percent]
