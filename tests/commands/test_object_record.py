"""Source of truth: the images that the record was made from."""

from dataclasses import replace

import pytest
import torch

from hyperplanes.commands.inputs.object_record import record_object, warn_of_other_object
from hyperplanes.commands.output.console import Console
from hyperplanes.data import DataError
from hyperplanes.geometry import cameras as camera
from hyperplanes.views import Views

CAMERAS = camera.pinhole(camera.symmetric_intrinsics(8, 8, 0.7), camera.fibonacci_sphere(4, 3.0), 8, 8)


@pytest.fixture
def views():
    return Views(torch.rand(4, 3, 8, 8, generator=torch.Generator().manual_seed(0)), CAMERAS)


def test_only_images_that_are_all_new_are_warned_of(views, tmp_path, capsys):
    record_object(tmp_path, "a car", views)
    for known in (views, views[[2]], views[[3, 1]]):
        warn_of_other_object(tmp_path, known, Console())
    assert not capsys.readouterr().err
    warn_of_other_object(tmp_path, replace(views, images=1 - views.images), Console())
    assert "other images, of a car" in capsys.readouterr().err


def test_weights_without_a_record_fit_all_images(views, tmp_path, capsys):
    weights = tmp_path / "baked.npz"
    weights.touch()
    for path in (tmp_path, tmp_path / "absent", weights):
        warn_of_other_object(path, views, Console())
    record_object(tmp_path, "a car", views)
    record_object(tmp_path, "another car", None)  # as a learned background changes the images
    warn_of_other_object(tmp_path, replace(views, images=1 - views.images), Console())
    record_object(tmp_path, "another car", None)
    assert not capsys.readouterr().err


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"name": "a", "views": 3}', '{"name": "a", "views": [[1]]}'])
def test_damaged_records_are_named(views, tmp_path, content):
    (tmp_path / "object.json").write_text(content)
    with pytest.raises(DataError, match="object.json"):
        warn_of_other_object(tmp_path, views, Console())
