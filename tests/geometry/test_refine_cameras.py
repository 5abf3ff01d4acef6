"""Source of truth: cameras with a known perturbation, which the example removes, at a small size."""

import importlib.util
import sys
from pathlib import Path

import torch

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


def test_the_plot_is_written(tmp_path):
    scene, true = example.Blobs.make(2), cameras.fibonacci_sphere(1, 2.7)
    start = example.perturbed(true, 5.0, 0.03, 0)
    result = example.refine(scene, start, true, 8, 2)
    example.plot(scene, true, start, result, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000
