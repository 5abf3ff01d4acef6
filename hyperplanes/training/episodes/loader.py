"""Draws the objects of each step from the seed and the number of the step; a thread prepares them in advance."""

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
from hyperplanes.training.parallel.distributed import Processes
from hyperplanes.utilities.files.encoding import sha256
from hyperplanes.utilities.tensors.lru_cache import LRUCache
from hyperplanes.views import Task, Tasks, class_of

__all__ = ["Batch", "Draw", "EpisodeLoader", "reads_hull", "reference_objects", "training_names"]


@dataclass(frozen=True)
class Draw:
    """One object of a step.

    Attributes:
        name: the name of the object; if views are drawn at random, with the number of the episode.
        episode: the prepared object.
        generator: the generator of its rays and samples, which does not depend on the other objects of the step.
    """

    name: str
    episode: Episode
    generator: torch.Generator


@dataclass(frozen=True)
class Batch:
    """The objects of a step.

    Attributes:
        names: the names of all objects of the step, in all processes.
        rendered: the objects of this process whose rays are rendered.
        reference: the objects of this process of which only the HyperPlanes are read.
    """

    names: Sequence[str]
    rendered: Sequence[Draw]
    reference: Sequence[Draw]


class EpisodeLoader:
    """Draws the objects of every step from (seed, step), so that a resumed training draws the same objects.

    Args:
        model: the model that is trained; it determines the planes and the device.
        data: the data set with the training objects.
        config: the configuration of the training.
        processes: the processes that share the objects of each step.

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
        self._lock = threading.Lock()  # for `_volumes`, which the prefetching thread uses too
        # PyTorch loads its linear algebra for GPUs on first use, which fails if two threads do so at the same time
        torch.linalg.det(torch.eye(3, device=model.rig.device))

    def batch(self, step: int) -> Batch:
        """The prepared objects of a step; steps begin at 0. Objects that no thread has prepared are prepared here."""
        names, seed = self.names_of(step), self.config.seed
        draws = [Draw(name, self.get(name), object_generator(seed, step, place)) for place, name in self._own(names)]
        count = self.config.tasks // self.processes.count
        return Batch(names, draws[:count], draws[count:])

    def expect(self, step: int) -> None:
        """Let a thread prepare the objects of the next `prefetch` steps after this one."""
        ahead = range(step + 1, min(step + 1 + self.config.prefetch, self.config.steps))
        self._prefetcher.expect(name for each in ahead for _, name in self._own(self.names_of(each)))

    def get(self, name: str) -> Episode:
        """A prepared object."""
        return self._prefetcher.get(name)

    def close(self) -> None:
        """End the thread."""
        self._prefetcher.close()

    @cached_property
    def fingerprint(self) -> dict[str, Any]:
        """Identifies the training objects: a hash of their names, and the images and calibration of the first one."""
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
        """The objects of a step, those to render first, then those for reference; steps begin at 0."""
        config, generator = self.config, step_generator(self.config.seed, step)
        count = config.tasks + reference_objects(self.model.config, config)
        if config.views:
            return [self._numbered(number) for number in draw_episodes(count, config.episodes, step, generator)]
        if self.classes:
            return draw_balanced(self.classes, count, generator)
        return draw(self.names, count, generator)

    def _numbered(self, number: int) -> str:
        """The name of an episode: the name of its object, #, and its number."""
        return f"{episode_object(self.classes or {'': self.names}, number, self.config.seed)}#{number}"

    def _own(self, names: Sequence[str]) -> Iterable[tuple[int, str]]:
        """This process's share of the objects of a step, each with its place in the step."""
        places, tasks = list(enumerate(names)), self.config.tasks
        return [*self.processes.share(places[:tasks]), *self.processes.share(places[tasks:])]

    def _load(self, name: str) -> Episode:
        """Read and prepare an object, or an episode with random views of it."""
        if not self.config.views:
            return prepare_episode(self.model, self.data.task(name), carved=reads_hull(self.model, self.config))
        name, _, number = name.rpartition("#")
        generator = episode_generator(self.config.seed, int(number))
        task, config = self.data.task(name), self.config
        target = self._target_volume(task)
        # rotate the views and the volume of the object about the vertical axis
        if config.rotations:
            rotation = draw_rotation(config.rotations, generator)
            task = Task(rotation.views(task.support), rotation.views(task.query), task.name)
            target = None if target is None else rotated_volume(target, rotation)
        # draw support and query views
        return prepare_subset(self.model, task, config.views, generator, target)

    def _target_volume(self, task: Task) -> Tensor | None:
        """The volume of all views of an object, if there is a volume loss; kept in an LRU cache."""
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
    """The names of the objects to train on; ValueError if there are none."""
    names = sorted(data.names("train"))
    if not names:
        raise ValueError("data: expected at least one training object, got none")
    return names


def reference_objects(model: ModelConfig, config: TrainingConfig) -> int:
    """The number of objects of a step of which only the HyperPlanes are read; 0 if no network reads HyperPlanes."""
    return config.reference_objects if (model.hypernetwork or model.autoencoder) is not None else 0


def reads_hull(model: HyperPlanes, config: TrainingConfig) -> bool:
    """Whether sampling, the field or a loss depends on the hull; the paper's protocol does not use it."""
    return model.target.permutation_invariant or model.config.sampling.needs_occupancy or config.empty_points > 0
