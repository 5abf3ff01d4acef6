"""Settings from files and options. Sources of truth: the dataclasses themselves, and files written by hand."""

import json
import re
import warnings
from dataclasses import asdict, dataclass, replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest
import yaml
from small_demo import demo_folder

from hyperplanes.adaptation import HullBlend, HyperPlanes, ModelConfig, NearestView
from hyperplanes.adaptation.checkpoints import find_checkpoints
from hyperplanes.adaptation.fine_tuned import FineTuned
from hyperplanes.cli import main
from hyperplanes.commands import find_verbs
from hyperplanes.commands.train import Arguments, resolve
from hyperplanes.configuration.presets import PRESETS, preset
from hyperplanes.configuration.settings_file import changed, document, parse_options, read_experiment, write_experiment
from hyperplanes.fields import TARGETS, ImageBasedConfig, NeRF, TargetConfig, find_targets
from hyperplanes.hypernetwork import ImageHyperNetworkConfig
from hyperplanes.methods import Method, Request, describe_method, make_method
from hyperplanes.rendering import Hierarchical, RayMarching
from hyperplanes.utilities import entry_points
from hyperplanes.utilities.files.checkpoints import CheckpointError
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.files.settings import SettingsError, structure

ROOT = Path(__file__).resolve().parents[2]


def leaves(value, prefix=""):
    """The paths and values of all entries that are not mappings."""
    for name, entry in value.items():
        if isinstance(entry, dict):
            yield from leaves(entry, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", entry


def other(value):
    """Another valid value of the same type, as written on the command line."""
    known = {
        "adam": "muon",
        "muon": "adam",
        "point_multiplane": "nerf",
        "convnet": "resnet101",
        "group": "batch",
        "silu": "relu",
    }
    known |= {
        "none": "relu",
        "running": "none",
        "concatenate": "mean",
        "low_rank": "full",
        "ray_marching": "hierarchical",
    }
    known |= {
        "all": "updated",
        "intervals": "samples",
        "farthest": "first",
        "matched": "file",
        "mv_meta": "maml",
        "nerf": "multiplane",
        "automatic": "single",
    }
    if isinstance(value, bool):
        return json.dumps(not value)
    if isinstance(value, str):
        return known[value]
    if isinstance(value, list | tuple):
        return "[colour]" if value else "[3]"
    return str(value + 1) if isinstance(value, int) else repr(value * 0.5 or 0.5)


@pytest.mark.parametrize(
    "base",
    [
        preset("quick"),
        preset("quick").by_protocol("paper"),
        preset("quick").by_method("autoencoder"),
        preset("quick").by_method("mv_meta"),
    ],
    ids=["ray_marching", "hierarchical", "autoencoder", "initialisation"],
)
def test_every_field_of_every_configuration_can_be_set_by_an_option(base):
    entries = dict(leaves({"model": base.model.as_json(), "training": asdict(base.training)}))
    assert len(entries) > 30
    for path, value in entries.items():
        if path in ("model.protocol", "model.hypernetwork.kind") or value is None:
            continue
        made = changed(base, parse_options([f"--{path.replace('_', '-')}", other(value)]))
        now = dict(leaves({"model": made.model.as_json(), "training": asdict(made.training)}))
        assert {name for name in entries if now[name] != entries[name]} == {path}


def test_a_whole_after_one_of_its_parts_is_refused():
    part, whole = ["--model.network.depth", "3"], ["--model.network", "{width: 4}"]
    assert parse_options([*whole, *part]) == {"model": {"network": {"width": 4, "depth": 3}}}
    with pytest.raises(SettingsError, match="given beside a part of it; leave one of them out"):
        parse_options([*part, *whole])


def test_one_number_is_accepted_where_a_list_is_expected():
    made = changed(preset("small"), parse_options(["--training.views", "5"]))
    assert made.training.views == (5,)


@pytest.mark.parametrize("name", PRESETS)
def test_a_written_configuration_is_read_back(name, tmp_path):
    chosen = preset(name).by_method("multiplane")
    chosen = replace(chosen, training=replace(chosen.training, seed=4))
    write_experiment(tmp_path / "config.yaml", chosen)
    found = read_experiment(tmp_path / "config.yaml")
    assert found["method"] == "multiplane"
    again = changed(preset("quick"), found)
    assert (again.model, again.training) == (chosen.model, chosen.training)
    assert yaml.safe_load(document(chosen))["model"] == json.loads(json.dumps(chosen.model.as_json()))


def test_another_kind_has_its_own_settings():
    made = changed(preset("small"), parse_options(["--model.hypernetwork.kind", "images"])).model.hypernetwork
    assert made == ImageHyperNetworkConfig()
    wanted = {"target": "point_multiplane", "hypernetwork": {"kind": "images"}}
    assert not isinstance(changed(preset("small"), {"model": wanted}).model.network, ImageBasedConfig)


def test_an_entry_that_lacks_a_part_is_named():
    entries = {**preset("small").model.as_json(), "symmetry": {"order": 2}}
    with pytest.raises(CheckpointError, match=r"symmetry\.plane: a missing entry"):
        ModelConfig.of_json(entries)


def test_a_file_overrides_the_preset_and_options_override_the_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "preset: small\nmethod: nerf\nmodel: {network: {depth: 3}, protocol: hierarchical, sampling: {coarse: 8}}\n"
        "training: {learning_rate: 1e-3, steps: 7, rays: 9}\n"
    )
    given = Arguments(
        data=(), out=tmp_path, config=path, steps=11, settings=("--training.rays", "13", "--model.sampling.fine=5")
    )
    chosen = resolve(given)
    small = preset("small")
    assert chosen.model.method == chosen.model.target == "nerf"
    assert chosen.model.hypernetwork is None
    assert chosen.model.network == TargetConfig(
        depth=3, width=128, planes=8, point_frequencies=6, direction_frequencies=2
    )
    assert chosen.model.sampling == Hierarchical(8, 5)
    of_subsets = {"views": (), "rotations": 0.0, "volume_loss": 0.0}
    assert chosen.training == replace(small.training, learning_rate=1e-3, steps=11, rays=13, **of_subsets)
    other = resolve(replace(given, method="multiplane", protocol="ray_marching", settings=()))
    assert other.model.sampling == RayMarching()
    assert resolve(replace(given, cache_size=0.5)).training.memory == 2**29
    with pytest.raises(ValueError, match="^--cache-size: "):
        resolve(replace(given, cache_size=-1))
    none = resolve(Arguments(data=(), out=tmp_path, settings=("--model.hypernetwork", "null")))
    assert none == changed(preset("quick"), {"model": {"hypernetwork": None}})
    assert none.model.method == "point_multiplane"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["--training.learning-rte", "1"], "--training.learning-rte: an unknown entry; did you mean learning_rate?"),
        (["--modle.views", "1"], "--modle.views: an unknown option; did you mean model?"),
        (["--training.learning-rate", "fast"], "--training.learning-rate: expected float, got 'fast'"),
        (["--training.learning-rate", ".nan"], "--training.learning-rate: expected finite numbers, got nan"),
        (["--training.learning-rate", "9" * 400], "--training.learning-rate: expected float, got 999"),
        (["--training.views", "1", "many"], "--training.views: expected a tuple of int, got a tuple of 1, 'many'"),
        (["--training.rays", "1.5"], "--training.rays: expected a whole number from 1 to 16777215, got 1.5"),
        (
            ["--model.hypernetwork.views", "0"],
            "--model.hypernetwork.views: expected a whole number from 1 to 1024, got 0",
        ),
        (["--model.protocol", "guessed"], "guessed"),
        (
            ["--model.hypernetwork.encoder", "vgg"],
            "encoder: expected one of 'convnet', 'resnet101', got 'vgg'",
        ),
        (["--model.target", "[1]"], "--model.target: expected str, got a list"),
        (
            ["--model.hypernetwork.kind", "[1]"],
            "--model.hypernetwork: kind: expected one of images, volume, got a list",
        ),
        (
            ["--model.symmetry.plane.normal", "[1, 0]"],
            "plane.normal: expected a tuple of 3 numbers, got a tuple of 1.0, 0.0",
        ),
        (
            ["--model.symmetry.plane.normal", "[1, 0, .nan]"],
            "plane.normal: expected finite numbers, got a tuple of 1.0,",
        ),
        (
            ["--model.network.density-scale", "0"],
            "--model.network.density-scale: expected more than 0 and finite, got 0",
        ),
        (
            ["--model.initialisation", "{inner_rate: -1}"],
            "--model.initialisation.inner-rate: expected a finite number of 0 or more, got -1",
        ),
        (["--model.hull-share", "2"], "--model.hull-share: expected a share from 0 to 1, got 2.0"),
        (
            ["--model.symmetry", "{plane: {normal: [1, 0, 0]}, order: 1000}"],
            "--model.symmetry.order: expected a whole number from 1 to 64, got 1000",
        ),
        (["--training.optimiser", "sgd"], "--training.optimiser: expected one of 'adam', 'muon', got 'sgd'"),
        (["--model.network.grid", "8"], "--model.network.grid: an unknown entry"),
        (["--model.network", "3"], "--model.network: expected its entries by name, got 3"),
        (["--training.rays", "["], "--training.rays: expected a plain value, got '['"),
        (["--training.rays", "!!int ''"], "--training.rays: expected a plain value"),
        (["--training.rays", "[" * 3000], "[[[ (maximum recursion depth exceeded"),
        (["--method", "magic"], "method: expected one of hyperplanes, "),
        (["--config", "OUT/none.yaml"], "none.yaml: expected a YAML file of settings"),
        (["--steps", "0"], "--steps: expected a whole number from 1 to 9999999999, got 0"),
    ],
)
def test_a_wrong_setting_is_one_line(settings, words, tmp_path, capsys):
    given = [each.replace("OUT", str(tmp_path)) for each in settings]
    assert main(["train", "--data", str(tmp_path), "--out", str(tmp_path / "run"), *given]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert words in lines[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[1]", "expected a mapping of settings, found a list"),
        ("model: [", "expected YAML"),
        ("a: &x [1]\nb: *x\n", "an alias"),
        ("trainig: {}\n", "trainig: an unknown entry; did you mean training?"),
        ("model: 3\n", "expected model of type dict, found int"),
        ("model: {network: {width: 4, width: 8}}\n", "found the entry 'width' more than once"),
        ("a: !!python/object/apply:os.system [ls]\n", "expected YAML"),
        ("", "expected a mapping of settings, found a NoneType"),
    ],
)
def test_a_file_without_valid_settings_is_refused(text, words, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(DataError) as caught:
        read_experiment(path)
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_list_becomes_an_optional_tuple():
    @dataclass(frozen=True)
    class Weights:
        values: tuple[float, ...] | None = None

    assert structure(Weights, {"values": [1, 2.5]}) == Weights((1.0, 2.5))
    assert structure(Weights, {"values": None}) == Weights()
    with pytest.raises(SettingsError, match="values: expected a tuple of float or None, got a tuple of 1.0, 'a'"):
        structure(Weights, {"values": [1, "a"]})


def test_structures_are_nested_and_named_by_their_path():
    @dataclass(frozen=True)
    class Refusing:
        size: int = 1

        def __post_init__(self):
            if self.size == 3:
                raise ValueError("size: 3 is refused")

    with pytest.raises(SettingsError, match=r"^size: 3 is refused$"):
        structure(Refusing, {"size": 3})
    with pytest.raises(SettingsError) as caught:
        ModelConfig.structured({**ModelConfig().as_json(), "network": {"depth": 10**30}})
    assert caught.value.path == "network.depth"


def test_the_configuration_that_training_writes_reproduces_it(tmp_path, capsys):
    data = str(demo_folder() / "data")
    first = ["--preset", "quick", "--steps", "2", "--training.rays", "8", "--model.network.planes", "6"]
    small = [
        "--model.network.width",
        "16",
        "--model.network.depth",
        "2",
        "--model.hypernetwork.views=2",
        "--model.hypernetwork.width",
        "16",
    ]
    assert main(["train", "--data", data, "--out", str(tmp_path / "one"), *first, *small]) == 0
    assert {"config.yaml", "curve.csv", "samples", "model.json"} <= {p.name for p in (tmp_path / "one").iterdir()}
    config = ["--config", str(tmp_path / "one" / "config.yaml")]
    assert main(["train", "--data", data, "--out", str(tmp_path / "two"), *config, "--tensorboard"]) == 0
    for name in ("model.safetensors", "config.yaml", "curve.csv", "samples/00000002.png"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert list((tmp_path / "two" / "tensorboard").iterdir())
    capsys.readouterr()
    assert main(["presets", "quick"]) == 0
    expected = {**asdict(preset("quick").training), "views": []}  # YAML has only lists
    assert yaml.safe_load(capsys.readouterr().out)["training"] == expected


class Constant(NeRF):
    """A field of another package."""


class FakeDistribution:
    name = "other-package"


BROUGHT = {
    "hyperplanes.fields": {"constant": f"{__name__}:Constant"},
    "hyperplanes.methods": {"copycat": f"{__name__}:COPYCAT"},
}
COPYCAT = Method(
    "the nearest support view, from another package",
    lambda request: NearestView(),
    steps="optional",
    swapped=lambda request: HullBlend(),
)


@pytest.fixture
def other_package(monkeypatch):
    """An installed distribution with entry points of both groups."""
    monkeypatch.setattr(
        entry_points,
        "find_entries",
        lambda group: EntryPoints(
            EntryPoint(name, value, group)._for(FakeDistribution()) for name, value in BROUGHT.get(group, {}).items()
        ),
    )


def test_a_field_of_another_package_is_trained_saved_and_loaded(other_package, tmp_path):
    assert find_targets()["constant"] is Constant
    chosen = preset("quick").by_method("constant")
    assert (chosen.model.target, chosen.model.hypernetwork) == ("constant", None)
    model = HyperPlanes(replace(chosen.model, network=replace(chosen.model.network, width=8)))
    assert isinstance(model.networks["fine"], Constant)
    model.save(tmp_path)
    assert isinstance(HyperPlanes.from_pretrained(tmp_path).networks["fine"], Constant)
    made = make_method(Request("constant_10", find_checkpoints([tmp_path])))
    assert isinstance(made, FineTuned)
    assert isinstance(made.model.networks["fine"], Constant)
    assert describe_method("constant_10") == "constant after 10 fine-tuning steps"


def test_a_method_of_another_package_is_made_and_described(other_package):
    assert describe_method("copycat") == "the nearest support view, from another package"
    assert isinstance(make_method(Request("copycat")), NearestView)
    assert describe_method("copycat_7") == "the nearest support view, from another package, 7 steps"
    assert isinstance(make_method(Request("copycat_auto")), NearestView)
    assert isinstance(make_method(Request("copycat_swapped")), HullBlend)
    with pytest.raises(ValueError, match="copycat"):
        make_method(Request("unheard_of"))
    with pytest.raises(ValueError, match=r"got 'copycats'; did you mean copycat\?"):
        make_method(Request("copycats"))


def test_names_of_other_packages_are_in_the_help(monkeypatch, capsys):
    brought = {"hyperplanes.methods": ["copycat"], "hyperplanes.fields": ["constant"]}
    points = {group: [EntryPoint(name, "nowhere:nothing", group) for name in names] for group, names in brought.items()}
    monkeypatch.setattr("hyperplanes.commands.parsing.find_entries", lambda group: points.get(group, []))
    with pytest.raises(SystemExit):
        main(["evaluate", "--help"])
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "Methods of other packages: copycat." in told
    assert "Fields of other packages: constant." in told


def test_an_entry_point_that_cannot_be_imported_is_left_out_and_its_package_named(other_package, monkeypatch):
    fields = {"lost": "no.such.module:Field", "constant": f"{__name__}:Constant", "gone": f"{__name__}:Gone"}
    monkeypatch.setitem(BROUGHT, "hyperplanes.fields", fields)
    with pytest.warns(UserWarning, match="other-package: '(lost|gone)' of hyperplanes.fields is left out") as warned:
        assert set(find_targets()) - set(TARGETS) == {"constant"}
    assert len(warned) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # each is imported, and warned of, once
        assert set(find_targets()) - set(TARGETS) == {"constant"}
    monkeypatch.setitem(BROUGHT, "hyperplanes.commands", {"lost": "no.such.module:VERB"})
    with pytest.warns(UserWarning, match="'lost' of hyperplanes.commands is left out"):
        assert "lost" not in find_verbs()


def test_options_in_the_documentation_exist():
    bases = [preset("quick"), preset("quick").by_protocol("paper")]
    known = {"model.hypernetwork"}
    for base in bases:
        known |= {path for path, _ in leaves({"model": base.model.as_json(), "training": asdict(base.training)})}
    pages = [*(ROOT / "docs").glob("*.md"), ROOT / "README.md"]
    named = {name for page in pages for name in re.findall(r"--((?:model|training)\.[\w.-]+)", page.read_text())}
    assert len(named) > 15
    assert {name.replace("-", "_") for name in named} <= known
