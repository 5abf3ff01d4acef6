"""The objects of each step: drawn from the seed and the number of the step, and made ready by a thread beforehand."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.geometry import cameras as camera
from hyperplanes.training.distributed import Processes
from hyperplanes.training.episodes.augmentation import draw_rotation, rotated_volume
from hyperplanes.training.episodes.drawing import (
    draw,
    draw_balanced,
    draw_episodes,
    episode_generator,
    episode_object,
    object_generator,
    step_generator,
)
from hyperplanes.training.episodes.episode import Episode, prepare_episode, prepare_subset, volume_of_all_views
from hyperplanes.training.episodes.prefetching import Prefetcher
from hyperplanes.utilities.encoding import sha256
from hyperplanes.utilities.lru_cache import LRUCache
from hyperplanes.views import Task, Tasks, class_of

__all__ = ["Batch", "Draw", "EpisodeLoader", "reads_hull", "reference_objects", "training_names"]


@dataclass(frozen=True)
class Draw:
    """One object of a step.

    Attributes:
        name: of the object, with the number of the episode where views are drawn too.
        episode: the object, ready.
        generator: of its rays and samples, the same whoever else is in the step.
    """

    name: str
    episode: Episode
    generator: torch.Generator


@dataclass(frozen=True)
class Batch:
    """The objects of a step.

    Attributes:
        names: of all of them, whichever process has them.
        rendered: this process's objects, of which rays are rendered.
        reference: this process's objects of which only the HyperPlanes are read.
    """

    names: Sequence[str]
    rendered: Sequence[Draw]
    reference: Sequence[Draw]


class EpisodeLoader:
    """Draws the objects of every step from (seed, step), so that a training that is resumed draws the same.

    Args:
        model: that is trained; its planes and its device count.
        data: with the training objects.
        config: of the training.
        processes: that share the objects of each step.

    Raises:
        ValueError: no object to train on.
    """

    def __init__(self, model: HyperPlanes, data: Tasks, config: TrainingConfig, processes: Processes) -> None:
        self.model, self.data, self.config, self.processes = model, data, config, processes
        self.names = training_names(data)
        self.classes: dict[str, list[str]] = {}
        for name in self.names if config.balanced else ():
            self.classes.setdefault(class_of(data, name), []).append(name)
        self.cache: LRUCache[Episode] = LRUCache(config.memory, keep_last=True)
        self._prefetcher = Prefetcher(self._load, self.cache)
        self._volumes: LRUCache[Tensor] = LRUCache(config.memory // 2)
        self._lock = threading.Lock()  # of `_volumes`, which the prefetching thread uses too
        # PyTorch loads its linear algebra for GPUs when it is first asked for, which fails in two threads at a time
        torch.linalg.det(torch.eye(3, device=model.rig.device))

    def batch(self, step: int) -> Batch:
        """The objects of a step (the first is 0), ready; one that is asked for the first time is made ready here."""
        names = self.names_of(step)
        draws = [Draw(name, self.get(name), self._generator(step, place)) for place, name in self._own(names)]
        count = self.config.tasks // self.processes.count
        return Batch(names, draws[:count], draws[count:])

    def expect(self, step: int) -> None:
        """Have a thread begin with the objects of the steps after this one, as many as `prefetch` says."""
        ahead = range(step + 1, min(step + 1 + self.config.prefetch, self.config.steps))
        self._prefetcher.expect(name for each in ahead for _, name in self._own(self.names_of(each)))

    def get(self, name: str) -> Episode:
        """An object, ready."""
        return self._prefetcher.get(name)

    def close(self) -> None:
        """Let the thread end."""
        self._prefetcher.close()

    @cached_property
    def fingerprint(self) -> dict[str, Any]:
        """What tells the objects that are trained on from others: names, and pictures and calibration of the first."""
        support = self.data.task(self.names[0]).support
        first = (support.images * 255).round().to(torch.uint8).cpu().contiguous()
        matrix = camera.intrinsics(support.cameras)[0].double().cpu()
        return {
            "objects": len(self.names),
            "names": sha256("\n".join(self.names).encode()),
            "pictures": sha256(first.numpy().tobytes()),
            "calibration": [round(float(matrix[place]), 2) for place in ((0, 0), (1, 1), (0, 2), (1, 2))],
        }

    def names_of(self, step: int) -> list[str]:
        """The objects of a step (the first is 0), different while there are enough: to render, then for reference."""
        config, generator = self.config, step_generator(self.config.seed, step)
        count = config.tasks + reference_objects(self.model.config, config)
        if config.views:
            return [self._numbered(number) for number in draw_episodes(count, config.episodes, step, generator)]
        if self.classes:
            return draw_balanced(self.classes, count, generator)
        return draw(self.names, count, generator)

    def _generator(self, step: int, place: int) -> torch.Generator:
        return object_generator(self.config.seed, step, place)

    def _numbered(self, number: int) -> str:
        """The name of an episode: that of its object, and its number."""
        return f"{episode_object(self.classes or {'': self.names}, number, self.config.seed)}#{number}"

    def _own(self, names: Sequence[str]) -> Iterable[tuple[int, str]]:
        """This process's share of the objects of a step, each with its place in the step."""
        places, tasks = list(enumerate(names)), self.config.tasks
        return [*self.processes.share(places[:tasks]), *self.processes.share(places[tasks:])]

    def _load(self, name: str) -> Episode:
        """Read an object and make it ready: as it is, or as the episode of this number shows it."""
        if not self.config.views:
            return prepare_episode(self.model, self.data.task(name), carved=reads_hull(self.model, self.config))
        name, _, number = name.rpartition("#")
        generator = episode_generator(self.config.seed, int(number))
        task, config = self.data.task(name), self.config
        target = self._target_volume(task)
        # turn the object about the vertical axis, views and volume alike
        if config.rotations:
            rotation = draw_rotation(config.rotations, generator)
            task = Task(rotation.views(task.support), rotation.views(task.query), task.name)
            target = None if target is None else rotated_volume(target, rotation)
        # show some of its views, and keep others for rays
        return prepare_subset(self.model, task, config.views, generator, target)

    def _target_volume(self, task: Task) -> Tensor | None:
        """What all views of an object show, where there is a volume loss; made once while there is room."""
        if not self.config.volume_loss:
            return None
        with self._lock:
            kept = self._volumes.get(task.name)
        if kept is None:
            kept = volume_of_all_views(self.model, task)
            with self._lock:
                self._volumes.add(task.name, kept)
        return kept


def training_names(data: Tasks) -> list[str]:
    """The objects to train on; ValueError where there are none."""
    names = sorted(data.names("train"))
    if not names:
        raise ValueError("data: expected at least one training object, got none")
    return names


def reference_objects(model: ModelConfig, config: TrainingConfig) -> int:
    """How many objects of a step only have their HyperPlanes read; none where no network reads HyperPlanes."""
    return config.reference_objects if (model.hypernetwork or model.autoencoder) is not None else 0


def reads_hull(model: HyperPlanes, config: TrainingConfig) -> bool:
    """Whether a sample or the field depends on the hull; the paper's protocol samples without one."""
    return model.target.permutation_invariant or model.config.sampling.needs_occupancy or config.empty_points > 0
