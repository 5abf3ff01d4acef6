"""Source of truth: what version 0.1 wrote. The files in former/ are its packaged models and `hyperplanes presets`."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from hyperplanes.adaptation.checkpoints import packaged_folder
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.configuration.presets import preset
from hyperplanes.configuration.settings_file import changed, parse_options, read_experiment
from hyperplanes.configuration.upgrade import upgrade_model
from hyperplanes.fields import ImageBasedConfig
from hyperplanes.hypernetwork import ImageHyperNetworkConfig, VolumeHyperNetworkConfig
from hyperplanes.utilities.checkpoints import CheckpointError
from hyperplanes.utilities.settings import SettingsError

FORMER = Path(__file__).parent / "former"


@pytest.mark.parametrize("name", ["small", "small-paper", "cars-64"])
def test_former_checkpoints_are_those_that_are_packaged(name):
    former = ModelConfig.of_json(json.loads((FORMER / f"{name}.json").read_text()))
    assert former.target == ("image_based" if name == "small" else "point_multiplane")
    assert former.target == ModelConfig.load(packaged_folder(name)).target
    assert ModelConfig.of_json(json.loads(json.dumps(former.as_json()))) == former
    kind = VolumeHyperNetworkConfig if name == "small" else ImageHyperNetworkConfig
    assert type(former.hypernetwork) is kind


@pytest.mark.parametrize("name", ["quick", "small"])
def test_former_files_of_settings_say_what_the_presets_say(name):
    """But for the use of views that presets have learned since."""
    given = read_experiment(FORMER / f"{name}.yaml")
    for base in ("quick", "small"):  # whatever they are laid over
        made, later = changed(preset(base), given), {"stacked": False, "symmetric": False}
        assert replace(made.model, **later) == replace(preset(name).model, **later)
        assert made.training == preset(name).training


def test_an_entry_that_lacks_a_part_is_named():
    entries = json.loads((FORMER / "small.json").read_text())
    with pytest.raises(CheckpointError, match=r"symmetry\.plane: a missing entry"):
        ModelConfig.of_json({**entries, "symmetry": {"normal": [1.0, 0.0, 0.0]}})


def test_another_kind_has_its_own_settings():
    made = changed(preset("small"), parse_options(["--model.hypernetwork.kind", "images"])).model.hypernetwork
    assert made == ImageHyperNetworkConfig()
    wanted = {"target": "point_multiplane", "hypernetwork": {"kind": "images"}}
    assert not isinstance(changed(preset("small"), {"model": wanted}).model.network, ImageBasedConfig)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--model.hypernetwork.gain", "2"],
            r"hypernetwork\.gain: expected 1.0, since this setting was removed, got 2",
        ),
        (["--model.hypernetwork.kind", "grid"], "kind: expected one of images, volume, got 'grid'"),
        (["--model.network.grid", "8"], r"model\.network\.grid: an unknown entry"),
    ],
)
def test_what_there_is_not_is_refused_by_its_name(options, words):
    with pytest.raises(SettingsError, match=words):
        changed(preset("quick"), parse_options(options))


def test_what_is_of_this_version_stays_as_it_is():
    for name in ("quick", "small", "paper-128"):
        entries = preset(name).model.as_json()
        assert upgrade_model(entries) == entries


def test_the_former_name_of_a_field_is_one_of_a_method():
    assert preset("small").by_method("any_order").model == preset("small").by_method("image_based").model
