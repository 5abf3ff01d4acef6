"""Trainings on random numbers of random views. Source of truth: counts, and synthetic pictures."""

from collections import Counter, defaultdict
from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes, ModelConfig
from hyperplanes.fields import ImageBasedConfig
from hyperplanes.geometry.cameras import centres
from hyperplanes.hypernetwork import ImageHyperNetworkConfig
from hyperplanes.rendering import RayMarching
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.training.episodes.drawing import draw_episodes, episode_object
from hyperplanes.training.episodes.episode import QUERIES, prepare_subset
from hyperplanes.training.parallel.distributed import Processes
from hyperplanes.views import Task, Views
from tests.reference_rendering import Balls, ball_views, ring, small_model

MODEL = ModelConfig(
    "image_based",
    ImageBasedConfig(depth=2, width=16, planes=4, blended=2, point_frequencies=2, direction_frequencies=1),
    ImageHyperNetworkConfig(views=2, normalisation="group", code=8, depth=2, width=16, join="mean"),
    sampling=RayMarching(24),
    hull_resolution=16,
)
TRAINING = TrainingConfig(
    steps=4, tasks=2, rays=32, views=(1, 3), episodes=4, random_background=True, learning_rate=1e-3, held_out=0,
    checkpoint_every=2,
)  # fmt: skip


def test_an_episode_has_separate_support_and_query_views():
    model, task = HyperPlanes(MODEL), Balls(views=6).task("train0")
    known, shown = torch.cat([centres(task.support.cameras), centres(task.query.cameras)]), Counter()
    for seed in range(60):
        episode = prepare_subset(model, task, (1, 3, 5), torch.Generator().manual_seed(seed))
        sources = [
            torch.cdist(centres(part.cameras), known).argmin(1) for part in (episode.prepared.views, episode.query)
        ]
        assert not set(sources[0].tolist()) & set(sources[1].tolist())
        assert len(episode.query) == min(QUERIES, 12 - len(sources[0]))
        shown.update([len(sources[0])])
    assert set(shown) == {1, 3, 5}
    assert min(shown.values()) > 10
    last = prepare_subset(model, task, (50,), torch.Generator().manual_seed(0))
    assert (len(last.prepared.views), len(last.query)) == (11, 1)  # one view is left as the query


def test_every_object_is_drawn_once_per_round_and_classes_in_turn():
    classes = {"car": ["a", "b", "c"], "chair": ["d"]}
    drawn = [episode_object(classes, number, 0) for number in range(12)]
    assert drawn[1::2] == ["d"] * 6
    assert sorted(drawn[0:6:2]) == sorted(drawn[6:12:2]) == ["a", "b", "c"]


def test_a_step_draws_from_the_loaded_episodes_and_each_is_drawn_several_times():
    trainer = Trainer(HyperPlanes(MODEL), Balls(train=5), replace(TRAINING, tasks=3, episodes=6))
    numbers = Counter()
    for step in range(200):
        drawn = [int(name.partition("#")[2]) for name in trainer.loader.names_of(step)]
        assert len(set(drawn)) == 3
        assert all(step <= number < step + 6 for number in drawn)
        numbers.update(drawn)
    assert sum(numbers[number] for number in range(6, 200)) / 194 == pytest.approx(3, abs=0.1)  # the number of tasks


def test_each_four_objects_of_a_step_draw_from_separate_episodes():
    at_hand, steps, shares = 6, 50, defaultdict[int, set[int]](set)
    drawn_often = Counter[int]()
    for step in range(steps):
        drawn = draw_episodes(12, at_hand, step, torch.Generator().manual_seed(step))
        assert len(set(drawn)) == 12
        drawn_often.update(drawn)
        for process in range(3):
            shares[process].update(Processes(process, 3).share(drawn))
    assert [{number % 3 for number in shares[process]} for process in range(3)] == [{0}, {1}, {2}]  # none is shared
    begun = [drawn_often[number] for number in range(3 * at_hand, 3 * steps)]
    assert sum(begun) / len(begun) == pytest.approx(4, abs=0.1)  # as with four objects per step
    assert draw_episodes(4, at_hand, 7, torch.Generator().manual_seed(7)) == [
        7 + place for place in torch.randperm(at_hand, generator=torch.Generator().manual_seed(7))[:4].tolist()
    ]


def test_a_resumed_training_is_equal_to_an_uninterrupted_one(tmp_path):
    whole = Trainer(HyperPlanes(MODEL), Balls(), TRAINING)
    list(whole.run())
    first = Trainer(HyperPlanes(MODEL), Balls(), TRAINING, tmp_path)
    for _ in range(2):
        first.take_step()
    first.save()
    second = Trainer(HyperPlanes(MODEL), Balls(), TRAINING, tmp_path)
    assert second.step == 2
    list(second.run())
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[name]), name


class White(Balls):
    """White balls on a white background: only the masks show them."""

    def task(self, name):
        views = ball_views(ring(8))
        white = Views(torch.ones_like(views.images), views.cameras, views.masks, views.bounds)
        return Task(white[:4], white[4:], name)


@pytest.mark.parametrize("random", [True, False])
def test_only_random_backgrounds_distinguish_a_white_surface_from_an_empty_field(random):
    model = HyperPlanes(replace(MODEL, hypernetwork=None))
    with torch.no_grad():
        model.networks["fine"].density.bias.fill_(-50.0)  # empty everywhere
    loss = Trainer(model, White(), replace(TRAINING, random_background=random)).take_step()
    assert loss > 0.02 if random else loss == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("model", "training", "message"),
    [
        (small_model, TRAINING, "image_based"),
        (lambda: HyperPlanes(MODEL), replace(TRAINING, views=(0, 3)), "at least 1"),
    ],
)
def test_settings_that_do_not_fit_the_model_are_refused(model, training, message):
    with pytest.raises(ValueError, match=message):
        Trainer(model(), Balls(), training)
