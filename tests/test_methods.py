"""Sources of truth: the documented names, query views filled with NaN, and updates of objects swapped by hand."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from hyperplanes import methods
from hyperplanes.adaptation import (
    Adapter,
    FineTuned,
    FineTuning,
    FromScratch,
    HullBlend,
    InitialisationConfig,
    NearestView,
    Swapped,
)
from hyperplanes.adaptation.checkpoints import find_checkpoint, find_checkpoints
from hyperplanes.adaptation.symmetry import judging as judging_symmetry
from hyperplanes.configuration.initialisation import LEARNED
from hyperplanes.configuration.presets import PRESETS
from hyperplanes.evaluation import evaluate
from hyperplanes.hypernetwork import AutoencoderConfig
from hyperplanes.methods import METHODS, Request, at_steps, describe_method, make_method
from tests.reference_rendering import Balls, awaken, ring, small_model


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("checkpoints")
    full, plain = tmp_path / "full", tmp_path / "plain"
    awaken(small_model()).save(full)
    small_model(hypernetwork=None).save(plain)
    autoencoder = AutoencoderConfig(views=2, code=8, latent=8)
    small_model(hypernetwork=None, autoencoder=autoencoder).save(tmp_path / "autoencoder")
    for name in LEARNED:
        initialisation = InitialisationConfig(name, inner_steps=1, steps=2)
        small_model(hypernetwork=None, initialisation=initialisation).save(tmp_path / name)
    found = find_checkpoints([full, tmp_path / "autoencoder", *(tmp_path / name for name in LEARNED)])
    return found | dict.fromkeys(("nerf", "multiplane", "point_multiplane"), plain)


def test_methods_by_name(folders):
    data = Balls(test=2)
    objects = [data.task(name).support for name in data.names("test")]
    made = {
        name: make_method(Request(name, folders, objects=objects))
        for name in (*METHODS, "hyperplanes_swapped")
        if not name.endswith("scratch")
    }
    assert all(isinstance(each, Adapter) for each in made.values())
    assert {name: made[name].steps for name in (*LEARNED, "standard", "mv_shuffled")} == dict.fromkeys(
        (*LEARNED, "standard", "mv_shuffled"), 2
    )
    assert isinstance(made["nearest_view"], NearestView)
    assert isinstance(made["hyperplanes_swapped"], Swapped)
    assert made["point_multiplane"].hypernetwork is None
    assert made["hyperplanes"].hypernetwork is not None


def test_methods_use_no_reflections_if_they_are_off():
    packaged = {"hyperplanes": find_checkpoint(Path("small"))}
    for reflections in (True, False):
        made = make_method(Request("hyperplanes", packaged, reflections=reflections))
        tuned = make_method(Request("scratch_2", packaged, reflections=reflections))
        assert made.config.symmetric == tuned.model.config.symmetric == reflections


@pytest.mark.parametrize("name", ["hyperplanes", "point_multiplane", "nerf", "scratch"])
@pytest.mark.parametrize("steps", [1, 37, "auto"])
def test_any_number_of_fine_tuning_steps(folders, name, steps):
    settings = FineTuning(rays=7)
    made = make_method(Request(f"{name}_{steps}", folders, settings=settings))
    assert isinstance(made, FromScratch if name == "scratch" else FineTuned)
    assert (made.steps, made.settings) == (steps, settings)


@pytest.mark.parametrize("name", ["magic", "scratch", "nearest_view_10", "hyperplanes_swapped_3", "hyperplanes_", ""])
def test_unknown_methods_are_refused(name):
    with pytest.raises(ValueError, match=f"method: expected one of nearest_view, .*, got '{name}'"):
        make_method(Request(name))


@pytest.mark.parametrize(
    ("name", "family"),
    [("hyperplanes_10", "hyperplanes"), ("point_multiplane", "point_multiplane"), ("scratch_1", "hyperplanes")],
)
def test_missing_checkpoints_are_named(name, family):
    with pytest.raises(ValueError, match=f"method {name}: expected a checkpoint of {family}, got none"):
        make_method(Request(name))


@pytest.mark.parametrize("name", ["mv_meta_2", "maml", "standard", "mv_shuffled"])
def test_learned_initialisations_optimise_only_the_weights(folders, name):
    with pytest.raises(ValueError, match=f"fine_tune: expected weights for {name}, .*, got hypernetwork"):
        make_method(Request(name, folders, settings=FineTuning(trainable="hypernetwork")))


def test_every_method_has_its_own_description():
    names = [f"{name}_100" if name.endswith("scratch") else name for name in METHODS]
    names += ["hyperplanes_100", "hyperplanes_auto", "point_multiplane_10", "mv_meta_10"]
    words = {name: describe_method(name) for name in names}
    assert len(set(words.values())) == len(words)
    assert words["scratch_100"] == "the same field from random weights, 100 steps"
    assert words["hyperplanes_auto"] == "HyperPlanes after a number of fine-tuning steps chosen by held-out views"


def test_names_of_methods_at_several_numbers_of_steps():
    assert at_steps("scratch", [0, 10, 100]) == ["scratch_10", "scratch_100"]
    assert at_steps("nearest_view", [0, 10]) == ["nearest_view"]
    assert at_steps("hyperplanes_5", [0, 10]) == ["hyperplanes_5"]
    assert at_steps("hyperplanes", []) == ["hyperplanes"]
    assert at_steps("nerf_scratch", [0, 10]) == ["nerf_scratch_10"]
    assert at_steps("mv_meta", [0, 10]) == ["mv_meta_0", "mv_meta_10"]


def test_a_swapped_object_has_only_the_update_of_the_next_one():
    data, model = Balls(test=3), awaken(small_model()).eval()
    supports = [data.task(name).support for name in data.names("test")]
    swapped = Swapped(model, supports)
    with torch.no_grad():
        for own, other in zip(supports, [*supports[1:], supports[0]], strict=True):
            prepared = model.prepare(own)
            expected = model.field(prepared, model.theta + model.update(model.prepare(other)))
            found, right, unswapped = (
                each.render(ring(1, (8, 8))).images for each in (swapped.adapt(own), expected, model.adapt(own))
            )
            assert torch.equal(found, right)
            assert not torch.equal(found, unswapped)


def test_training_does_not_change_a_swapped_field():
    data, model = Balls(test=2), awaken(small_model())
    supports = [data.task(name).support for name in data.names("test")]
    values = Swapped(model, supports).adapt(supports[0]).field.parameters
    before = {name: value.clone() for name, value in values.items()}
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1.0)
    assert all(torch.equal(value, before[name]) and not value.requires_grad for name, value in values.items())


def test_swapping_works_for_an_object_in_another_precision():
    data, model = Balls(test=2), awaken(small_model()).eval()
    supports = [data.task(name).support for name in data.names("test")]
    swapped, precise = Swapped(model, supports), supports[0].to(dtype=torch.float64)
    cameras = ring(1, (8, 8))
    expected = swapped.adapt(supports[0]).render(cameras).images
    torch.testing.assert_close(swapped.adapt(precise).render(cameras).images, expected, atol=1e-3, rtol=0)


def test_swapping_takes_two_objects_and_a_hypernetwork():
    support = Balls().task("test0").support
    with pytest.raises(ValueError, match="swapped: expected at least 2 objects to swap updates of, got 1"):
        Swapped(small_model(), [support])
    with pytest.raises(ValueError, match="swapped: expected a model with a hypernetwork, got one without"):
        Swapped(small_model(hypernetwork=None), [support])


def test_no_method_reads_a_pixel_of_the_query_views(folders, monkeypatch):
    # NaN in the query images would be in the pictures of a method that reads them.
    quick = PRESETS["quick"]
    monkeypatch.setitem(PRESETS, "quick", replace(quick, model=small_model(hypernetwork=None).config))
    monkeypatch.setattr(methods, "HullBlend", partial(HullBlend, side=8, steps=16))
    enough = 2 * 4 * 12 * 12  # for the reflections about one plane
    monkeypatch.setattr(judging_symmetry, "MAX_REFLECTED_PIXELS", enough)
    clean, data = Balls(test=2, size=(12, 12)), Balls(test=2, size=(12, 12))
    original, read = data.task, []

    def poisoned(name):
        task = original(name)
        query = replace(task.query[:1], images=torch.zeros(1, 3, 12, 12))
        query.images.fill_(torch.nan)  # after the check of Views
        return replace(task, query=query)

    data.task = poisoned
    objects = [data.task(name).support for name in data.names("test")]
    for name in (f"{name}_1" if name.endswith("scratch") else name for name in METHODS):
        adapter = make_method(Request(name, folders, objects=objects, settings=FineTuning(rays=16)))
        evaluate(name, adapter, data, ["test0"], lambda score, task, pictures, field: read.append(pictures.images))
        again = make_method(Request(name, folders, objects=objects, settings=FineTuning(rays=16)))
        shown = again.adapt(clean.task("test0").support).render(clean.task("test0").query[:1].cameras).images
        assert torch.equal(read[-1], shown), name
