"""The cache of fields on disk. Source of truth: the stored field, and a key that changes with every input."""

import os
from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.commands.inputs.disk_cache import MAX_ENTRIES, keep_field, kept_folder, recall_field
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.geometry import cameras as camera
from hyperplanes.views import Views

CAMERAS = camera.pinhole(camera.symmetric_intrinsics(16, 16, 0.7), camera.fibonacci_sphere(4, 3.0), 16, 16)


@pytest.fixture(autouse=True)
def _apart(tmp_path, monkeypatch):
    monkeypatch.setenv("HYPERPLANES_CACHE", str(tmp_path))


@pytest.fixture(scope="module")
def views():
    masks = torch.zeros(4, 1, 16, 16)
    masks[..., 4:12, 4:12] = 1
    return Views(torch.rand(4, 3, 16, 16, generator=torch.Generator().manual_seed(0)), CAMERAS, masks)


@pytest.fixture(scope="module")
def model():
    model = HyperPlanes.from_pretrained("small")
    model.config = replace(model.config, hull_resolution=16, symmetric=False, azimuth=0.0, learned_steps=1)
    return model


@pytest.fixture(scope="module")
def field(model, views):
    return model.adapt(views)


def test_a_cached_field_is_read_back(model, views, field):
    folder = kept_folder(model, views, 0, FineTuning())
    assert recall_field(folder, views) is None
    keep_field(model, field, folder)
    again = recall_field(folder, views)
    one = camera.select(CAMERAS, [1])
    assert float(field.render(one).opacity.max()) > 0.1
    torch.testing.assert_close(again.render(one).images, field.render(one).images, atol=1e-5, rtol=0)
    (folder / "model.safetensors").write_bytes(b"damaged")
    assert recall_field(folder, views) is None


def test_the_folder_depends_on_views_steps_and_options(model, views):
    settings = FineTuning()
    folders = [kept_folder(model, each, steps, settings) for each in (views, views[:3]) for steps in (0, 1, "auto")]
    folders.append(kept_folder(model, replace(views, images=views.images.flip(0)), 0, settings))
    folders.append(kept_folder(model, replace(views, masks=None), 0, settings))
    folders.append(kept_folder(model, views, 0, replace(settings, seed=7)))
    assert len(set(folders)) == len(folders)
    assert kept_folder(model, views, 0, settings) == folders[0]


def test_the_oldest_fields_are_removed(model, views, field, tmp_path):
    """The times of the folders are in another order than their names."""
    folder = kept_folder(model, views, 0, FineTuning())
    names = [f"old{number}" for number in range(MAX_ENTRIES)]
    for age, name in enumerate(names[4:] + names[:4]):
        (tmp_path / "adapted" / name).mkdir(parents=True)
        os.utime(tmp_path / "adapted" / name, (1000.0 + age, 1000.0 + age))
    keep_field(model, field, folder)
    assert {path.name for path in (tmp_path / "adapted").iterdir()} == {*names, folder.name} - {"old4"}
