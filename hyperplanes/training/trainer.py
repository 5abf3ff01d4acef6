"""Meta-training: theta and the hypernetwork by separate Adam steps on query rays (HyperPlanes, Algorithm 1)."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.profiler import record_function

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.descent import ray_loss
from hyperplanes.adaptation.diagnostics import Diagnostics, diagnose, swap_gap
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.optimisers import make_optimisers
from hyperplanes.parameters import Parameters
from hyperplanes.training.completion import completion_loss
from hyperplanes.training.configuration import Progress, TrainingConfig
from hyperplanes.training.distributed import ProcessEnded, Processes, check_shares, other_processes
from hyperplanes.training.drawing import draw, draw_balanced, episode_generator, episode_object, object_generator
from hyperplanes.training.emptiness import emptiness_loss
from hyperplanes.training.episodes import Episode, prepare_episode, prepare_subset, whole_of
from hyperplanes.training.prefetching import Prefetcher
from hyperplanes.training.requirements import check_requirements
from hyperplanes.training.rotation import draw_rotation
from hyperplanes.training.state import Curve, check_model, check_whole, load_state, save_state
from hyperplanes.training.watching import Samples, write_curve
from hyperplanes.utilities.errors import prefix_errors
from hyperplanes.utilities.files import encode_png, sha256, write_json, write_whole
from hyperplanes.utilities.lru_cache import LRUCache
from hyperplanes.utilities.metrics import psnr
from hyperplanes.views import Task, Tasks, class_of

__all__ = ["Trainer", "train"]


FREE = ("steps", "epochs", "evaluate_every", "held_out", "checkpoint_every", "keep_last", "memory", "prefetch")
"""What may differ in a training that is resumed."""


class Trainer:
    """The state of one training: model, two optimisers, step count, the curve so far.

    Every step draws its objects from a generator seeded by (seed, step), and each object its rays from one seeded by
    (seed, step, place in the step), so a training that is stopped and resumed ends exactly where an uninterrupted one
    does. It computes where the model is.

    In a process of several (`launching.launched`) it renders its share of the objects of each step; the first process
    alone writes files and looks at held-out objects.

    Args:
        model: trained in place.
        data: tasks with a "train" split and perhaps a "val" or "test" split.
        config: how.
        folder: for checkpoints; a training that lies there already goes on.

    Raises:
        ValueError: no object to train on, or objects that the processes cannot share evenly.
    """

    def __init__(self, model: HyperPlanes, data: Tasks, config: TrainingConfig, folder: Path | None = None) -> None:
        self.model = model
        self.data = data
        self.processes = Processes.current()
        self.folder = folder if self.processes.first else None
        self.step = 0
        self.curve: Curve = []
        self.diagnostics: Diagnostics | None = None
        self.samples: Samples | None = None
        self.stopping = False  # set by whoever wants `run` to end after the step at hand
        self._stopped = False  # what the processes agreed on in the last step
        self.names = sorted(data.names("train"))
        if not self.names:
            raise ValueError("data: expected at least one training object, got none")
        check_requirements(config, model)
        self.config = config = replace(config, steps=config.steps_for(len(self.names)))
        check_shares(config.tasks, self._reference_objects, self.processes.count)
        self.classes: dict[str, list[str]] = {}
        for name in self.names if config.balanced else ():
            self.classes.setdefault(class_of(data, name), []).append(name)
        self._episodes: LRUCache[Episode] = LRUCache(config.memory, keep_last=True)
        self._prefetcher = Prefetcher(self._load, self._episodes)
        self._lock = threading.Lock()  # of `_wholes`, which the prefetching thread uses too
        self._wholes: LRUCache[Tensor] = LRUCache(config.memory // 2)
        self._held_out: dict[str, Episode] = {}
        self._updates: list[Parameters] = []
        theta = list(model.networks.parameters())
        self.optimisers = make_optimisers(theta, config.optimiser, config.learning_rate, config.muon_learning_rate)
        if model.hypernetwork is not None:
            rate = config.hypernetwork_learning_rate
            self.optimisers += make_optimisers(list(model.hypernetwork.parameters()), "adam", rate, 0.0)
        self.rates = [optimiser.param_groups[0]["lr"] for optimiser in self.optimisers]
        if folder is not None:
            check_model(folder, model.config)
            check_whole(folder)
        resumed = folder is not None and (folder / "training.json").exists()
        if not (resumed or model.rig.any()) and self.processes.first:  # the others get it with the weights
            with prefix_errors(self.names[0]):
                model.set_rig(data.task(self.names[0]).support)
        if folder is not None and resumed:
            defaults = asdict(TrainingConfig())
            loaded = load_state(folder, model, self.optimisers, asdict(config), FREE, defaults, self._data)
            self.step, self.curve = loaded
            if self.folder is not None and not (self.folder / "model.safetensors").exists():
                self.model.save(self.folder)  # of a first checkpoint that was killed before it
        with other_processes():
            self.processes.agree(model, self.step)

    def run(self) -> Iterator[Progress]:
        """Train until the last step, reporting every 25 steps; checkpoints are written on the way and at the end.

        With them come curve.csv and samples/STEP.png, held-out views beside the truth, and best/, the model of the look
        with the highest PSNR. Once `stopping` is set in any process, the step at hand is the last one, and a checkpoint
        of it is written.

        Yields:
            Where the training stands.
        """
        try:
            with other_processes():
                yield from self._run()
        finally:
            self._prefetcher.close()

    def _run(self) -> Iterator[Progress]:
        started, first, reported = time.perf_counter(), self.step, (time.perf_counter(), self.step)
        while self.step < self.config.steps:
            ahead = range(self.step, min(self.step + 1 + self.config.prefetch, self.config.steps))
            self._prefetcher.expect(
                name for step in ahead[1:] for _, name in self._own(self._drawn(step, self._generator(step)))
            )
            loss = self.take_step()
            step, last = self.step, self.step == self.config.steps
            look = step % self.config.evaluate_every == 0 or last
            report = look or step % 25 == 0
            now = time.perf_counter()
            quality, diagnostics = self.look() if look and self.processes.first else (None, None)
            self.diagnostics = diagnostics or self.diagnostics
            seen = self.samples if look else None
            if quality is not None and self.folder is not None and quality > self._best:
                self.model.save(self.folder / "best")
            if report:
                row = {"step": step, "loss": loss, **self.norms()}
                row |= {} if quality is None else {"psnr": quality}
                row |= {} if seen is None or seen.ssim is None else {"ssim": seen.ssim}
                row |= diagnostics.as_json() if diagnostics else {}
                self.curve.append(row)
            stopping = self._stopped if self.processes.count > 1 else self.stopping
            saving = step % self.config.checkpoint_every == 0 or last or stopping
            if self.folder is not None and (look or saving):
                write_curve(self.folder / "curve.csv", self.curve)
                if seen is not None:
                    write_whole(self.folder / "samples" / f"{step:08d}.png", encode_png(seen.sheet()))
            if saving:
                self.save()
            if stopping:
                return
            if not report:
                continue
            rays = (step - reported[1]) * self.rays_per_step / max(now - reported[0], 1e-9)
            left = (time.perf_counter() - started) / (step - first) * (self.config.steps - step)
            reported = (time.perf_counter(), step)
            ssim = seen.ssim if seen else None
            yield Progress(step, self.config.steps, loss, rays, quality, left, diagnostics, ssim)

    def take_step(self) -> float:
        """One step of the optimisers on freshly drawn objects and rays; returns the loss."""
        generator = self._generator(self.step)
        self.model.train()
        for optimiser in self.optimisers:
            optimiser.zero_grad(set_to_none=True)
        drawn = self._drawn(self.step, generator)
        own = self._own(drawn)
        with record_function("step:data"):
            episodes = [self._prefetcher.get(name) for _, name in own]
        generators = [object_generator(self.config.seed, self.step, place) for place, _ in own]
        loss = self.gradients([name for _, name in own], episodes, generators)
        with record_function("step:exchange"):
            moved = [value for each in self.optimisers for group in each.param_groups for value in group["params"]]
            loss, self._stopped = self.processes.average(moved, loss, self.stopping)
        self.stopping = self.stopping or self._stopped
        if not math.isfinite(loss):
            raise (ValueError if self.processes.first else ProcessEnded)(
                f"step {self.step + 1}, on {', '.join(drawn)}: expected a finite loss, got {loss}; the last checkpoint "
                "is kept; check the images of these objects, or train with lower rates"
            )
        for optimiser, rate in zip(self.optimisers, self.rates, strict=True):
            optimiser.param_groups[0]["lr"] = rate * self._schedule()
        with record_function("step:optimisers"):
            if self.config.clip:
                moved = [value for each in self.optimisers for group in each.param_groups for value in group["params"]]
                torch.nn.utils.clip_grad_norm_(moved, self.config.clip)
            for optimiser in self.optimisers:
                optimiser.step()
        self.step += 1
        return loss

    @property
    def rays_per_step(self) -> int:
        """Rays of all objects of a step."""
        return self.config.rays * self.config.tasks

    def gradients(
        self, drawn: Sequence[str], episodes: Sequence[Episode], generators: Sequence[torch.Generator]
    ) -> float:
        """Set the gradients of this process's share of a step.

        Args:
            drawn: names of its objects, those that are rendered first.
            episodes: the objects.
            generators: of the rays and samples of each.

        Returns:
            The mean loss of these objects.
        """
        config = self.config
        tasks = config.tasks // self.processes.count
        total = torch.zeros(())
        with record_function("step:update"):
            updates = self.model.updates([episode.prepared for episode in episodes])
        for name, episode, update, generator in list(zip(drawn, episodes, updates, generators, strict=True))[:tasks]:
            weights = self.model.theta + update
            field = self.model.field(self._with_dropout(episode.prepared, generator), weights)
            span = field.sampling.span
            with record_function("step:rays"), prefix_errors(name):
                drawn_rays = episode.query.sample_masked_rays(
                    config.rays, generator=generator, among=episode.live, span=span
                )
            rays, truth, opacity = drawn_rays
            with record_function("step:rendering"):
                seen = field.trace(rays, generator)
            if config.random_background:
                colour = torch.rand(3, generator=generator).to(truth)
                seen, truth = seen.over(colour), truth + (1 - opacity) * (colour - 1)
            if config.empty_points:
                with record_function("step:emptiness"):
                    total = total + emptiness_loss(field, config.empty_points, generator)
            total = total + ray_loss(seen, truth)
            if config.volume_loss:
                total = total + config.volume_loss * completion_loss(weights, episode)
        with record_function("step:gradients"):
            (total / tasks).backward()
        self._updates = [update.detach() for update in updates]
        return float(total.detach()) / tasks

    def _with_dropout(self, prepared: SupportContext, generator: torch.Generator) -> SupportContext:
        """The object without the planes that this step hides, where the model is trained to do without some."""
        chance = self.model.config.plane_dropout
        if not chance:
            return prepared
        hidden = torch.rand(len(prepared.views), generator=generator) < chance
        return prepared.hiding(hidden.nonzero()[:, 0])

    @torch.no_grad()
    def norms(self) -> dict[str, float]:
        """Norms of the last step: of the gradient of each part, and of its objects' updates (root mean square).

        Gradients are clipped. Where there are several processes, all of them are to ask.
        """
        parts = {"theta": self.model.networks, "hypernetwork": self.model.hypernetwork}
        found = {}
        for name, part in parts.items():
            gradients = [] if part is None else [each.grad for each in part.parameters() if each.grad is not None]
            if gradients:
                found[f"gradient_{name}"] = float(torch.stack([each.norm() for each in gradients]).norm())
        if self.model.hypernetwork is not None and self._updates:
            squares = [value.square().sum() for update in self._updates for value in update.values()]
            found["update"] = float(self.processes.mean(torch.stack(squares).sum() / len(self._updates)).sqrt())
        return found

    def _generator(self, step: int) -> torch.Generator:
        """What everything random of a step is drawn from, its objects first."""
        return torch.Generator().manual_seed(self.config.seed * 1_000_003 + step)

    def _numbered(self, number: int) -> str:
        """The name of an episode: that of its object, and its number."""
        return f"{episode_object(self.classes or {'': self.names}, number, self.config.seed)}#{number}"

    def _drawn(self, step: int, generator: torch.Generator) -> list[str]:
        """The objects of a step, different ones while there are enough: those to render, then the reference objects."""
        count = self.config.tasks + self._reference_objects
        if self.config.views:
            places = torch.randperm(max(self.config.episodes, count), generator=generator)[:count]
            return [self._numbered(step + place) for place in places.tolist()]
        if self.classes:
            return draw_balanced(self.classes, count, generator)
        return draw(self.names, count, generator)

    def _own(self, drawn: Sequence[str]) -> list[tuple[int, str]]:
        """This process's share of the objects of a step, each with its place in the step."""
        places, tasks = list(enumerate(drawn)), self.config.tasks
        return [*self.processes.share(places[:tasks]), *self.processes.share(places[tasks:])]

    @property
    def _reference_objects(self) -> int:
        return self.config.reference_objects if self.model.hypernetwork is not None else 0

    @property
    def _best(self) -> float:
        """The highest quality of the looks so far."""
        return max((row["psnr"] for row in self.curve if row.get("psnr") is not None), default=-math.inf)

    def warm(self, name: str) -> None:
        """Have the planes and the hull of an object ready, as its first step otherwise makes them."""
        self._prefetcher.get(name)

    @torch.no_grad()
    def look(self) -> tuple[float | None, Diagnostics | None]:
        """Mean PSNR in dB of two query views of some held-out objects, and the diagnostics of the hypernetwork there.

        The objects are those of the "val" split, or of "test" where a data set has no other; nothing but best/ is
        chosen by these numbers. None where there are no such objects, and no hypernetwork or a single object to compare
        updates of. `samples` holds the views themselves.
        """
        names = sorted(self.data.names("val")) or sorted(self.data.names("test"))
        for name in names[: self.config.held_out]:
            if name not in self._held_out:
                task = self.data.task(name)
                few = replace(task, query=task.query[:: max(1, len(task.query) // 2)][:2])
                self._held_out[name] = prepare_episode(self.model, few, carved=self._reads_hull)
        episodes = list(self._held_out.values())
        if not episodes:
            return None, None
        prepared, queries = [each.prepared for each in episodes], [each.query for each in episodes]
        model = self.model
        training = model.training
        model.eval()
        try:
            fields = [self._adapted(each) for each in episodes]
            pictures = [field.render(query.cameras).images for field, query in zip(fields, queries, strict=True)]
            self.samples = Samples(pictures, [query.images for query in queries])
            quality = float(torch.cat([psnr(*pair) for pair in self.samples.pairs]).mean())
            if model.hypernetwork is None or len(episodes) < 2:
                return quality, None
            _, gap = swap_gap(model, prepared, queries, quality)
            return quality, replace(diagnose(model, prepared), swap_gap=gap)
        finally:
            model.train(training)

    def _adapted(self, episode: Episode) -> AdaptedField:
        """The field of a held-out object."""
        return self.model.adapt_to(episode.prepared)

    def save(self) -> None:
        """Write model and training state to the folder, where there is one; whole or not at all."""
        if self.folder is not None:
            if self.diagnostics is not None:
                write_json(self.folder / "diagnostics.json", self.diagnostics.as_json())
            config = asdict(self.config)
            save_state(self.folder, self.model, self.optimisers, self.step, self.curve, config, self._data)

    @cached_property
    def _data(self) -> dict[str, Any]:
        """What tells the objects that are trained on from others: their names, and the pictures of the first."""
        first = (self.data.task(self.names[0]).support.images * 255).round().to(torch.uint8).cpu().contiguous()
        return {
            "objects": len(self.names),
            "names": sha256("\n".join(self.names).encode()),
            "pictures": sha256(first.numpy().tobytes()),
        }

    def _schedule(self) -> float:
        config = self.config
        if self.step < config.warmup:
            return (self.step + 1) / config.warmup
        done = (self.step - config.warmup) / max(1, config.steps - config.warmup)
        return config.final_rate_factor + (1 - config.final_rate_factor) * (1 + math.cos(math.pi * done)) / 2

    @property
    def _reads_hull(self) -> bool:
        """Whether a sample or the field depends on the hull; the paper's protocol samples without one."""
        return self.model.any_order or self.model.config.sampling.needs_occupancy or self.config.empty_points > 0

    def _load(self, name: str) -> Episode:
        if not self.config.views:
            return prepare_episode(self.model, self.data.task(name), carved=self._reads_hull)
        name, _, number = name.rpartition("#")
        generator = episode_generator(self.config.seed, int(number))
        task, config = self.data.task(name), self.config
        whole = self._whole(task)
        if config.rotations:
            drawn = draw_rotation(config.rotations, generator)
            task = Task(drawn.views(task.support), drawn.views(task.query), task.name)
            whole = None if whole is None else drawn.volume(whole)
        return prepare_subset(self.model, task, config.views, generator, whole)

    def _whole(self, task: Task) -> Tensor | None:
        """What all views of an object show, where the training completes volumes; made once while there is room."""
        if not self.config.volume_loss:
            return None
        with self._lock:
            kept = self._wholes.get(task.name)
        if kept is None:
            kept = whole_of(self.model, task)
            with self._lock:
                self._wholes.add(task.name, kept)
        return kept


def train(
    model: HyperPlanes,
    data: Tasks,
    config: TrainingConfig,
    folder: Path | None = None,
    report: Callable[[Progress], None] | None = None,
) -> Trainer:
    """Run a training, resumed from `folder` where it holds one.

    Args:
        model: trained in place.
        data: tasks, as in `Trainer`.
        config: how.
        folder: for checkpoints.
        report: called with every progress.

    Returns:
        The finished training.
    """
    trainer = Trainer(model, data, config, folder)
    for progress in trainer.run():
        if report is not None:
            report(progress)
    return trainer
