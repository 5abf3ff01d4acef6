"""Sources of truth: the files of every experiment at the smallest scale, and methods evaluated directly."""

import csv
import io
import json
import re
import shutil
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import cache

import pytest
import torch
from rendered_here import rendered_here

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.cli import main
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.data import open_dataset
from hyperplanes.data.support import WithSupport
from hyperplanes.evaluation import evaluate
from hyperplanes.experiments import EXPERIMENTS, SCALES, estimate
from hyperplanes.experiments.data_sets import DataSets
from hyperplanes.experiments.engine import Runner
from hyperplanes.experiments.workspace import Workspace
from hyperplanes.methods import Request, make_method
from hyperplanes.rendering import Hierarchical
from tests.reference_rendering import Balls

CLASSES = ("car", "chair", "lamp", "plane")


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A folder that all experiments share; the first one generates cars, which are used for all classes."""
    return tmp_path_factory.mktemp("reproduce")


@pytest.fixture(scope="module")
def cars(out):
    """The data set that `reproduce` generates if none is given."""
    with rendered_here(), pytest.MonkeyPatch.context() as patch:
        leave_figures_out(patch)
        assert main(["reproduce", "time", "--scale", "smoke", "--only", "HyperPlanes-0", "--out", str(out)]) == 0
    (folder,) = (out / "data").glob("car-*")
    return folder


@pytest.fixture(scope="module")
def given(cars):
    """The options with the data sets of all classes."""
    return ["--data", *(f"{name}={cars}" for name in CLASSES)]


@pytest.fixture(scope="module")
def reproduced(out, given):
    """The output and the files of `reproduce NAME`; each experiment runs once for all tests."""

    @cache
    def run(name):
        with redirect_stdout(io.StringIO()) as shown:
            assert main(["reproduce", name, "--scale", "smoke", "--out", str(out), *given]) == 0
        files = {path.name: path.read_bytes() for path in (out / name).iterdir()}
        return Reproduced(shown.getvalue(), files, json.loads(files["results.json"]))

    return run


def leave_figures_out(patch):
    """Do not draw figures; `reproduced` draws the figure of each experiment once."""
    patch.setattr("hyperplanes.utilities.images.plots.encode_figure", lambda figure, kind: b"")


@pytest.fixture
def without_figures(monkeypatch):
    leave_figures_out(monkeypatch)


@dataclass(frozen=True)
class Reproduced:
    shown: str
    files: dict
    results: dict

    @property
    def table(self):
        return self.results["table"]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_runs(name, reproduced):
    experiment, found = SCALES["smoke"].applied(EXPERIMENTS[name]), reproduced(name)
    lines = list(csv.DictReader(io.StringIO(found.files["table.csv"].decode(), newline="")))
    assert [(line["row"], line["column"]) for line in lines] == [(c.row, c.column) for c in experiment.cells]
    for line in lines:
        published = experiment.published_value(line["row"], line["column"])
        assert (line["paper"] == "") if published is None else (float(line["paper"]) == published)
        if line["quantity"] == "psnr":  # by Jensen's inequality, pooled PSNR is at most the mean PSNR
            assert float(line["pooled"]) <= float(line["value"])
    text = found.files["table.md"].decode()
    assert found.files["figure.png"].startswith(b"\x89PNG")
    for note in found.results["differs"]:
        assert note in text
        assert " ".join(note.split()) in " ".join(found.shown.split())
    assert "Paper: ShapeNet" in text
    assert found.results["commit"] in text
    assert experiment.where in text


@pytest.mark.usefixtures("without_figures")
def test_results_are_reused_and_missing_ones_are_made_again(out, given, reproduced, capsys):
    table = reproduced("target").files["table.csv"]
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    gone = next((out / "evaluations").glob("car-*-hyperplanes-0-*.json"))
    gone.unlink()
    assert main(["reproduce", "target", "--scale", "smoke", "--out", str(out), *given]) == 0
    shown = capsys.readouterr().out
    assert "training" not in shown.split("Target network")[0]
    assert shown.count("car_test_00000") <= 1
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")} == before
    assert (out / "target" / "table.csv").read_bytes() == table


@pytest.mark.usefixtures("without_figures")
def test_several_worker_processes_give_the_same_table_as_one(out, given, tmp_path):
    command = ["reproduce", "target", "--scale", "smoke", "--only", "NeRF", "MultiPlaneNeRF", *given, "--out"]
    assert main([*command, str(out)]) == 0
    assert main([*command, str(tmp_path), "--workers", "2"]) == 0
    assert (tmp_path / "target" / "table.csv").read_text() == (out / "target" / "table.csv").read_text()


def test_a_cell_is_the_evaluation_of_its_checkpoint(out, cars, reproduced):
    table = reproduced("target").table
    data = WithSupport(open_dataset(cars), 4)
    (folder,) = (
        path.parent
        for path in (out / "trainings").glob("car-*-hyperplanes-0-*/model.json")
        if json.loads(path.read_text())["target"] == "nerf"
    )
    adapter = make_method(Request("hyperplanes", {"hyperplanes": folder}))
    score = evaluate("hyperplanes", adapter, data, data.names("test")[:1])
    assert table["PSNR"]["NeRF"]["value"] == pytest.approx(score.mean("psnr"), abs=1e-4)
    assert table["SSIM"]["NeRF"]["value"] == pytest.approx(score.mean("ssim"), abs=1e-4)


def test_cells_fine_tune_the_part_that_their_column_names(out, cars, reproduced):
    """In the columns of the paper, theta is frozen and the hypernetwork is tuned; the last column tunes all weights."""
    row = reproduced("single-class").table["Test Cars"]
    folder = next(  # given and generated data have the same weights
        path.parent
        for path in (out / "trainings").glob("car-*-hyperplanes-0-*/model.json")
        if json.loads(path.read_text())["hypernetwork"]["views"] == 4
    )
    data = WithSupport(open_dataset(cars), 4)
    for column, trainable in (("HyperPlanes-100", "hypernetwork"), ("HyperPlanes-100, all weights", "weights")):
        settings = replace(SCALES["smoke"].fine_tuning, trainable=trainable)
        adapter = make_method(Request("hyperplanes_2", {"hyperplanes": folder}, settings=settings))
        score = evaluate("hyperplanes_2", adapter, data, data.names("test")[:1])
        assert row[column]["value"] == pytest.approx(score.mean("psnr"), abs=1e-4)
    values = [row[column]["value"] for column in row if column.startswith("HyperPlanes")]
    assert len(set(values)) == len(values) - 1  # at this scale, 10 and 100 steps both become 2


@pytest.mark.parametrize("name", SCALES)
def test_settings_of_fine_tuning_all_weights_and_the_hypernetwork(name, tmp_path):
    """Source of truth: the defaults of `render` with the rays of the scale for all weights; otherwise the scale."""
    scale, cpu = SCALES[name], torch.device("cpu")
    runner = Runner(
        Workspace(tmp_path), DataSets(Workspace(tmp_path), scale, generate=None, device=cpu), train=print, device=cpu
    )
    for cell in EXPERIMENTS["cross-class"].cells:
        found = runner.fine_tuning(cell)
        if cell.trainable == "weights":
            assert found == FineTuning(rays=128 if name == "small" else 1024)
        elif cell.trained.method == "hyperplanes":
            assert found == scale.fine_tuning


def test_every_row_of_an_ablation_is_another_model(reproduced):
    for name in ("target", "layers", "inputs"):
        cells = [cell for row in reproduced(name).table.values() for cell in row.values()]
        found = {
            (cell["value"], cell["score"]["ssim"]) for cell in cells
        }  # after one step, many differ only in the last digits
        assert len(found) == len(cells), name


@pytest.mark.usefixtures("without_figures")
def test_settings_of_other_sources_of_the_paper_reach_trainings_and_evaluations(out, cars, tmp_path, monkeypatch):
    published = tmp_path / "car-learnit"
    splits = {split: list(open_dataset(cars).names(split)) for split in ("train", "test")}
    for name in sum(splits.values(), []):  # as learnit publishes them
        shutil.copytree(next(cars.rglob(f"{name}/transforms.json")).parent, published / "cars" / name)
    (published / "car_splits.json").write_text(json.dumps(splits))
    # The scale "paper" with the sizes of "smoke", but the field, sampler and sphere of learnit, and --legacy.
    smoke, paper = SCALES["smoke"], SCALES["paper"]
    small = {**paper.learned, "model.network.depth": 1, "model.sampling": Hierarchical(4, 0), "training.steps": 1}
    kept = {name: getattr(paper, name) for name in ("learned_target", "fine_tuning", "scratch", "bounds")}
    monkeypatch.setitem(SCALES, "paper", replace(smoke, learned=small, **kept))
    command = ["reproduce", "shapenet", "--scale", "paper", "--only", "Cars", "MV Meta, 25 views", "--legacy"]
    assert main([*command, "--data", f"car={published}", "--out", str(out)]) == 0
    models = [json.loads(path.read_text()) for path in (out / "trainings").glob("car-*-mv_meta-0-*/model.json")]
    (learned,) = (model for model in models if model["target"] == "simplified_nerf")
    assert (learned["protocol"], learned["sampling"]["coarse"], learned["coarse_network"]) == ("hierarchical", 4, False)
    written = [json.loads(path.read_text())["settings"] for path in (out / "evaluations").glob("car-*.json")]
    (found,) = (settings for settings in written if "legacy" in settings)
    assert found["bounds"] == {"centre": [0.0, 0.0, 0.0], "radius": 2.0}
    results = json.loads((out / "shapenet" / "results.json").read_text())
    assert list(results["table"]) == ["MV Meta, 25 views"]
    assert "--only Cars 'MV Meta, 25 views' --legacy" in results["command"]


@pytest.mark.parametrize("name", SCALES)
def test_adapted_fields_have_the_sampler_of_the_training(name, tmp_path, monkeypatch):
    """Source of truth: the configuration of the training. One cell per kind of model and method is adapted."""
    monkeypatch.setattr(DataSets, "tasks", lambda data, class_name: Balls())
    shape = {"model.network.depth": 1, "model.network.width": 8, "model.network.point_frequencies": 1}
    reader = {"model.hypernetwork.encoder": "convnet", "model.hypernetwork.width": 8, "model.hull_resolution": 8}
    scale = SCALES[name]
    scale = replace(scale, changes={**scale.changes, **shape, **reader}, learned={**scale.learned, **shape}, views=8)
    few = {"fine_tuning": replace(scale.fine_tuning, rays=16), "scratch": replace(scale.scratch, rays=16)}
    scale = replace(scale, max_steps=1, max_curve_steps=1, **few)

    def train(trained, chosen, data, reference, folder):
        model = HyperPlanes(chosen.model)
        model.set_rig(data.task("train0").support)
        model.save_pretrained(folder)

    cpu, seen = torch.device("cpu"), set()
    data = DataSets(Workspace(tmp_path), scale, generate=None, device=cpu, given=dict.fromkeys(CLASSES, tmp_path))
    runner = Runner(data.workspace, data, train=train, device=cpu)
    for experiment in map(scale.applied, EXPERIMENTS.values()):
        for cell in experiment.cells:
            method, trained = scale.method(cell.method), cell.trained
            kind = experiment.size, trained.method, trained.changes.get("model.target"), method.rstrip("0123456789")
            if trained.packaged or kind in seen:
                continue
            seen.add(kind)
            folder = runner.trainings.folder(experiment, trained, 0)
            adapter, tasks = runner._method(experiment, cell, method, folder, 0)
            field = adapter.adapt(tasks.task("test0").support)
            assert field.sampling == runner.trainings.configuration(experiment, trained, 0).model.sampling, cell


@pytest.mark.usefixtures("without_figures")
def test_several_seeds_are_several_trainings(out, given):
    command = ["reproduce", "time", "--scale", "smoke", "--seeds", "2", "--out", str(out), *given]
    assert main(command) == 0
    cell = json.loads((out / "time" / "results.json").read_text())["table"]["seconds"]["HyperPlanes-0"]
    assert len(cell["score"]["seeds"]) == 2
    assert cell["score"]["deviation"]["psnr"] > 0
    assert len(list((out / "trainings").glob("car-*-hyperplanes-1-*"))) == 1


def test_an_estimate_counts_every_seed(out, given, monkeypatch, capsys):
    monkeypatch.setattr(estimate, "MEASURED_STEPS", 1)
    monkeypatch.setattr(estimate, "MEASURED_VIEW_SIZE", 8)
    command = ["reproduce", "shapenet", "--scale", "smoke", "--estimate", "--out", str(out), *given]
    assert main([*command, "--seeds", "3"]) == 0
    shown = capsys.readouterr().out
    assert all(shown.count(f"{method} on ") == 3 for method in ("hyperplanes", "mv_meta", "mv_matched", "sv_meta"))
    assert "3 x 2" in shown
    assert re.search(r"all of it: .+ on this machine", shown)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--scale", "paper"], "expected --data car=FOLDER"),
        (["--data", "cars"], "CLASS=FOLDER, each of the classes car, chair, plane, lamp once, got 'cars'"),
        (["--data", "car="], "once, got 'car='"),
        (["--data", "car=A", "car=B"], "once, got 'car=B'"),
        (["--data", "boat=A"], "once, got 'boat=A'"),
        (["--seeds", "0"], "--seeds: expected at least 1, got 0"),
    ],
)
def test_wrong_input_is_reported_in_one_line(words, expected, tmp_path, capsys):
    assert main(["reproduce", "target", "--out", str(tmp_path), *words]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert expected in lines[0]


def test_a_table_with_its_own_classes_accepts_data_of_these(tmp_path, monkeypatch, capsys):
    """The command looks for the given folder, which does not exist."""
    table = EXPERIMENTS["target"]
    cells = tuple(replace(cell, on="boat", trained=replace(cell.trained, on="boat")) for cell in table.cells)
    monkeypatch.setitem(EXPERIMENTS, "boats", replace(table, name="boats", cells=cells))
    data = ["--data", f"boat={tmp_path / 'none'}"]
    assert main(["reproduce", "boats", "--scale", "smoke", "--out", str(tmp_path), *data]) == 2
    assert f"{tmp_path / 'none'}: expected" in capsys.readouterr().err
