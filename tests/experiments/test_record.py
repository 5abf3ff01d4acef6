"""Source of truth: stages that are started, interrupted and finished here, with existing and missing files."""

import json
import threading
import time
from concurrent.futures import Future
from dataclasses import replace

import pytest
import torch

from hyperplanes.commands.runs import make_workers
from hyperplanes.experiments import data_sets, workers
from hyperplanes.experiments.data_sets import DataSets
from hyperplanes.experiments.demonstration.settings import DemoSettings
from hyperplanes.experiments.engine import Runner
from hyperplanes.experiments.record import Record
from hyperplanes.experiments.workspace import Workspace
from hyperplanes.utilities.files.checkpoints import CheckpointError
from tests.reference_rendering import Balls


def test_an_interrupted_stage_continues_and_one_with_other_settings_starts_again(tmp_path):
    made = tmp_path / "made"

    def interrupted():
        with Record(tmp_path / "stages.json").working("a", {"sizes": (1, 2)}, made):
            made.mkdir()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    record = Record(tmp_path / "stages.json")
    assert not record.done("a", {"sizes": (1, 2)}, made)
    with record.working("a", {"sizes": (1, 2)}, made):
        assert made.exists()
    spent = record.seconds("a")
    assert Record(tmp_path / "stages.json").done("a", {"sizes": (1, 2)}, made)
    assert not record.done("a", {"sizes": (1, 2)}, made, tmp_path / "gone")
    with record.working("a", {"sizes": (1, 3)}, made):
        assert not made.exists()
    assert spent > 0
    assert record.seconds("b") == 0


def test_a_damaged_record_is_one_line(tmp_path):
    (tmp_path / "stages.json").write_text('{"data": 3}')
    with pytest.raises(CheckpointError, match="expected settings, done and seconds of every stage, found others of"):
        Record(tmp_path / "stages.json")


def test_a_training_in_a_named_folder_is_made_again_when_its_data_changes(tmp_path, monkeypatch):
    """The names of folder, model and objects stay the same; only the resolution of the data changes."""
    monkeypatch.setattr(DataSets, "tasks", lambda data, class_name: Balls())
    settings, trained = DemoSettings.quick_check(), []

    def train(what, chosen, data, reference, folder):
        assert not folder.exists()
        folder.mkdir(parents=True)
        trained.append(what.method)

    def run(resolution):
        scale = replace(settings.scale, resolution=resolution)
        places = {each: each for each in ("hyperplanes", "point_multiplane")}
        workspace, cpu = Workspace(tmp_path, places), torch.device("cpu")
        data = DataSets(workspace, scale, generate=None, device=cpu)
        runner = Runner(workspace, data, train=train, device=cpu)
        for each in settings.table.trainings:
            assert runner.trainings.folder(settings.table, each, 0) == tmp_path / each.method

    run(24)
    run(24)
    assert len(trained) == 2
    run(32)
    assert len(trained) == 4


def test_names_of_results_depend_on_the_content_of_a_given_data_set(tmp_path, monkeypatch):
    """Property: with other content at the same path, data and trainings have other names."""
    monkeypatch.setattr(DataSets, "tasks", lambda data, class_name: Balls())
    cars, table, cpu = tmp_path / "cars", DemoSettings.quick_check().table, torch.device("cpu")
    cars.mkdir()

    def names():
        workspace = Workspace(tmp_path / "out")
        data = DataSets(workspace, DemoSettings.quick_check().scale, generate=None, device=cpu, given={"car": cars})
        runner = Runner(workspace, data, train=print, device=cpu)
        return data.name("car"), runner.trainings.name(table, table.trainings[0], 0)

    before = names()
    assert names() == before
    (cars / "manifest.json").write_text("{}")
    assert all(now != then for now, then in zip(names(), before, strict=True))


def test_legacy_applies_only_to_given_data_sets(tmp_path, monkeypatch):
    """A given data set inside the workspace and a generated one, in the main process and in a worker."""
    read, cpu = {}, torch.device("cpu")
    monkeypatch.setattr(data_sets, "open_dataset", lambda path, legacy: read.setdefault(path.name, legacy) or Balls())
    scale, given = DemoSettings.quick_check().scale, {"car": tmp_path / "data" / "cars"}

    def generate(settings, folder):
        folder.mkdir(parents=True)

    main = DataSets(Workspace(tmp_path), scale, generate=generate, device=cpu, given=given, legacy=True)
    main.tasks("car")
    main.tasks("chair")
    assert list(read.values()) == [True, False]
    read.clear()
    worker = make_workers(2, tmp_path, scale, "cpu", given=given, legacy=True)._make()
    monkeypatch.setattr(workers, "_runner", worker, raising=False)
    for name in given | {"chair": ""}:
        workers._do({name: main.folder(name)}, lambda runner, name=name: runner.data.tasks(name))
    assert list(read.values()) == [True, False]


def test_seconds_are_stored_separately_for_each_number_of_threads(tmp_path, monkeypatch):
    """Property: PSNR and seconds of an evaluation have separate files; seconds have one per number of threads."""
    monkeypatch.setattr(DataSets, "tasks", lambda data, class_name: Balls())
    cpu, psnr = torch.device("cpu"), replace(DemoSettings.quick_check().packaged.cells[0], split="test")
    data = DataSets(Workspace(tmp_path), DemoSettings.quick_check().packaged_scale(tmp_path), generate=None, device=cpu)
    runner, seconds = Runner(data.workspace, data, train=print, device=cpu), replace(psnr, quantity="image_seconds")

    def files(cell):
        experiment = replace(DemoSettings.quick_check().packaged, cells=(cell,), keep_pictures=False)
        return {path for _, _, path, _ in runner._evaluations(experiment, cell, 0)}

    found = files(psnr), files(seconds)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    assert files(psnr) == found[0]
    assert len(found[0] | found[1] | files(seconds)) == 3 * len(found[0])


class ManualWorkers:
    """Two workers whose tasks end when the test sets their results."""

    count = 2

    def __init__(self):
        self.submitted = []

    def submit(self, given, work):
        self.submitted.append((work.func.__name__, work.args, Future()))
        return self.submitted[-1][2]


def test_each_of_several_trainings_is_recorded_when_it_ends(tmp_path, monkeypatch):
    """The second training is interrupted after the first has ended; the first stays recorded with its own time."""
    monkeypatch.setattr(DataSets, "tasks", lambda data, class_name: Balls())
    table, cpu, workers = DemoSettings.quick_check().table, torch.device("cpu"), ManualWorkers()
    workspace = Workspace(tmp_path, {"hyperplanes": "hyperplanes", "point_multiplane": "point_multiplane"})
    data = DataSets(workspace, DemoSettings.quick_check().scale, generate=None, device=cpu, given={"car": tmp_path})
    runner = Runner(workspace, data, train=print, device=cpu, workers=workers)

    def end_one_after_the_other():
        until = time.monotonic() + 5

        def wait_for(condition):
            while not condition() and time.monotonic() < until:
                time.sleep(0.01)

        wait_for(lambda: len(workers.submitted) == 2)
        ends = {args[0].method: end for _, args, end in workers.submitted}
        (tmp_path / "point_multiplane").mkdir()
        (tmp_path / "point_multiplane" / "model.json").write_text(json.dumps({"network": {"planes": 2}}))
        ends["point_multiplane"].set_result(None)
        wait_for(lambda: len(workers.submitted) > 2)
        ends["hyperplanes"].set_exception(KeyboardInterrupt())

    ending = threading.Thread(target=end_one_after_the_other)
    ending.start()
    only_cars = replace(table, cells=tuple(cell for cell in table.cells if cell.on == "car"))
    with pytest.raises(KeyboardInterrupt):
        runner.train_all(table, 0, [only_cars])
    ending.join()
    written = json.loads((tmp_path / "stages.json").read_text())
    assert {name: written[name]["done"] for name in written} == {"point_multiplane": True, "hyperplanes": False}
    assert written["point_multiplane"]["seconds"] < written["hyperplanes"]["seconds"]
    evaluated = {args[0].cell.method for name, args, _ in workers.submitted if name == "_evaluate"}
    assert evaluated == {"point_multiplane", "scratch_2", "nearest_view", "hull_blend"}, "evaluations start meanwhile"
