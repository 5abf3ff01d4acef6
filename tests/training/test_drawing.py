"""Source of truth: counts of what is drawn. Generators of other places, steps and seeds draw other numbers."""

import json
from collections import Counter

import pytest
import torch

from hyperplanes.data.dataset import Datasets, open_dataset
from hyperplanes.data.devices import TasksOnDevice
from hyperplanes.data.support import WithSupport
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.training.episodes import Batch, Draw
from hyperplanes.training.episodes.drawing import draw, draw_balanced, object_generator
from hyperplanes.views import class_of
from tests.reference_rendering import Balls, small_model

CLASSES = {"car": [f"car{i}" for i in range(20)], "lamp": ["lamp0", "lamp1"], "chair": ["chair0"]}


@pytest.mark.parametrize("count", [1, 3, 4, 7])
def test_classes_are_drawn_equally_often_whatever_their_size(count):
    found, steps = Counter(), 600
    for step in range(steps):
        drawn = draw_balanced(CLASSES, count, torch.Generator().manual_seed(step))
        of_step = {name: sum(each in members for each in drawn) for name, members in CLASSES.items()}
        assert max(of_step.values()) - min(of_step.values()) <= 1
        assert sum(of_step.values()) == len(drawn) == count
        for name, members in CLASSES.items():
            assert len({*drawn} & {*members}) == min(of_step[name], len(members))
        found += Counter(drawn)
    for members in CLASSES.values():  # binomial, within five standard deviations
        expected = steps * count / 3 / len(members)
        assert all(abs(found[each] - expected) < 5 * expected**0.5 for each in members)


def test_with_a_single_class_all_objects_are_drawn_equally_often():
    names = CLASSES["car"]
    drawn = draw_balanced({"": names}, 5, torch.Generator().manual_seed(0))
    assert len(set(drawn)) == 5
    assert len(set(draw(names, 5, torch.Generator().manual_seed(0)))) == 5


def test_random_numbers_of_an_object_depend_on_seed_step_and_place():
    draws = {
        key: torch.rand(4, generator=object_generator(*key)).tolist()
        for key in ((0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 1, 1))
    }
    assert torch.rand(4, generator=object_generator(0, 1, 0)).tolist() == draws[0, 1, 0]
    assert len({tuple(each) for each in draws.values()}) == len(draws)


def test_the_rays_of_an_object_do_not_depend_on_other_objects_of_the_step():
    def left(tasks):
        """The states of a step's generators after the step."""
        trainer = Trainer(small_model(hypernetwork=None), Balls(3), TrainingConfig(tasks=tasks, rays=8))
        names = [f"train{place}" for place in range(tasks)]
        generators = [object_generator(0, 0, place) for place in range(tasks)]
        draws = [Draw(name, trainer.loader.get(name), each) for name, each in zip(names, generators, strict=True)]
        trainer.objective.gradients(Batch(names, draws, []))
        return [each.get_state() for each in generators]

    assert torch.equal(left(1)[0], left(3)[0])
    assert not torch.equal(left(1)[0], object_generator(0, 0, 0).get_state())


def test_classes_are_read_from_the_manifest_or_from_the_data_sets(tmp_path):
    for part, objects in (
        ("mixed", {"a": {"class": "car"}, "b": {"class": "lamp"}}),
        ("plain", {"a": {"class": None}}),
    ):
        folder = tmp_path / part
        folder.mkdir()
        manifest = {"format": "hyperplanes-dataset", "version": 1, "objects": objects, "splits": {"train": [*objects]}}
        (folder / "manifest.json").write_text(json.dumps(manifest))
    data = Datasets({name: open_dataset(tmp_path / name) for name in ("mixed", "plain")})
    around = TasksOnDevice(WithSupport(data, 2), torch.device("cpu"))
    found = {name: class_of(around, name) for name in around.names("train")}
    assert found == {"mixed/a": "car", "mixed/b": "lamp", "plain/a": "plain"}
    assert class_of(open_dataset(tmp_path / "plain"), "a") == class_of(Balls(), "train0") == ""


def test_a_balanced_training_draws_by_class():
    class Kinds(Balls):
        def class_of(self, name):
            return "rare" if name == "train0" else "common"

    trainer = Trainer(small_model(), Kinds(5), TrainingConfig(tasks=2, balanced=True))
    for step in range(20):
        assert sum(name == "train0" for name in trainer.loader.names_of(step)) == 1
