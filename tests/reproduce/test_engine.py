"""Source of truth: every experiment run small, its files, and the methods run by hand."""

import csv
import json

import pytest
from small_demo import demo_folder

from hyperplanes.cli import main
from hyperplanes.data import open_dataset
from hyperplanes.evaluation import evaluate
from hyperplanes.methods import make_method
from hyperplanes.reproduce import EXPERIMENTS, SCALES
from hyperplanes.support import WithSupport


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A folder that all experiments share."""
    return tmp_path_factory.mktemp("reproduce")


def given(*names):
    """The demonstration's cars, under the names of all classes but one that is generated."""
    return ["--data", *(f"{name}={demo_folder() / 'data'}" for name in names)]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_runs(name, out, capsys):
    experiment = SCALES["smoke"].applied(EXPERIMENTS[name])
    data = given("car", "chair", "lamp") if name == "layers" else given("car", "chair", "lamp", "plane")
    assert main(["reproduce", name, "--scale", "smoke", "--out", str(out), *data]) == 0
    shown = capsys.readouterr().out
    with open(out / name / "table.csv", encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [(line["row"], line["column"]) for line in lines] == [(c.row, c.column) for c in experiment.cells]
    for line in lines:
        published = experiment.published and experiment.published.value(line["row"], line["column"])
        assert (line["paper"] == "") if published is None else (float(line["paper"]) == published)
    results = json.loads((out / name / "results.json").read_text())
    text = (out / name / "table.md").read_text()
    assert (out / name / "figure.png").read_bytes().startswith(b"\x89PNG")
    for note in results["differs"]:
        assert note in text
        assert " ".join(note.split()) in " ".join(shown.split())
    assert "Paper: ShapeNet" in text
    assert results["commit"] in text
    assert experiment.where in text


def test_nothing_is_made_twice_and_what_is_missing_is_made_again(out, capsys):
    command = ["reproduce", "target", "--scale", "smoke", "--out", str(out), *given("car")]
    assert main(command) == 0
    capsys.readouterr()
    table = (out / "target" / "table.csv").read_text()
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    gone = next((out / "evaluations").glob("car-hyperplanes-0-*.json"))
    gone.unlink()
    assert main(command) == 0
    shown = capsys.readouterr().out
    assert "training" not in shown.split("Target network")[0]
    assert shown.count("car_test_00000") <= 1
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")} == before
    assert (out / "target" / "table.csv").read_text() == table


def test_a_cell_is_the_evaluation_of_its_checkpoint(out):
    main(["reproduce", "target", "--scale", "smoke", "--out", str(out), *given("car")])
    table = json.loads((out / "target" / "results.json").read_text())["table"]
    data = WithSupport(open_dataset(demo_folder() / "data"), 6)
    for target in ("nerf", "multiplane", "point_multiplane"):
        heading = {"nerf": "NeRF", "multiplane": "MultiPlaneNeRF", "point_multiplane": "PointMultiPlaneNeRF"}[target]
        found = [
            folder
            for folder in (out / "trainings").glob("car-hyperplanes-0-*")
            if json.loads((folder / "model.json").read_text())["target"] == target
        ]
        values = [
            evaluate("m", make_method("hyperplanes", {"hyperplanes": folder}), data, data.names("test")[:1]).mean(
                "psnr"
            )
            for folder in found
        ]
        assert any(table["PSNR"][heading]["value"] == pytest.approx(value, abs=1e-4) for value in values)


def test_seeds_are_of_trainings(out):
    command = ["reproduce", "time", "--scale", "smoke", "--seeds", "2", "--out", str(out), *given("car")]
    assert main(command) == 0
    cell = json.loads((out / "time" / "results.json").read_text())["table"]["seconds"]["HyperPlanes-0"]
    assert len(cell["score"]["seeds"]) == 2
    assert cell["score"]["deviation"]["psnr"] > 0
    assert len(list((out / "trainings").glob("car-hyperplanes-1-*"))) == 1


def test_an_estimate_counts_every_seed(out, capsys):
    command = ["reproduce", "hyperplanes", "--scale", "smoke", "--estimate", "--out", str(out), *given("plane")]
    assert main([*command, "--seeds", "3"]) == 0
    shown = capsys.readouterr().out
    assert shown.count("hyperplanes on plane, model.hypernetwork.views") == 4
    assert "3 x 2" in shown
    assert "hours" in shown


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--scale", "paper"], "expected --data car=FOLDER"),
        (["--data", "cars"], "--data: expected CLASS=FOLDER with a class of car, chair, plane, lamp, got 'cars'"),
        (["--seeds", "0"], "--seeds: expected at least 1, got 0"),
    ],
)
def test_mistakes_get_one_line(words, expected, tmp_path, capsys):
    assert main(["reproduce", "target", "--out", str(tmp_path), *words]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert expected in lines[0]
