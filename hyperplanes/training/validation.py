"""Evaluation during training: some query views of held-out objects, rendered and compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.diagnostics import Diagnostics, diagnose, swap_gap
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.network import in_use
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.training.episodes.episode import Episode, prepare_episode
from hyperplanes.training.episodes.loader import reads_hull
from hyperplanes.training.monitoring import Samples
from hyperplanes.utilities.metrics import psnr
from hyperplanes.views import Tasks

__all__ = ["Validation", "Validator"]

VIEWS = 2  # query views of each object


@dataclass(frozen=True)
class Validation:
    """What held-out objects show of a model.

    Attributes:
        psnr: mean over the views, in dB.
        ssim: likewise; None of pictures that are smaller than its window.
        samples: the views themselves.
        diagnostics: of the hypernetwork, where there is one and at least two objects to compare the updates of.
    """

    psnr: float
    ssim: float | None
    samples: Samples
    diagnostics: Diagnostics | None


class Validator:
    """Renders query views of the same held-out objects each time.

    The objects are those of the "val" split, or of "test" where a data set has no other; nothing but best/ is chosen by
    these numbers. Their planes and hulls are made ready once.

    Args:
        model: that is trained.
        data: with the held-out objects.
        config: of the training; `held_out` says how many objects.
        adapt: makes the field of an object.
    """

    def __init__(
        self, model: HyperPlanes, data: Tasks, config: TrainingConfig, adapt: Callable[[SupportContext], AdaptedField]
    ) -> None:
        self.model, self.data, self.config, self.adapt = model, data, config, adapt
        self._episodes: dict[str, Episode] = {}

    def prepare(self) -> None:
        """Read the held-out objects and make them ready; ValueError for one that cannot be validated on.

        The first validation does so where nobody has.
        """
        self._held_out()

    @torch.no_grad()
    def run(self) -> Validation | None:
        """PSNR of the views and the diagnostics of the hypernetwork; None where there are no held-out objects."""
        model, episodes = self.model, self._held_out()
        if not episodes:
            return None
        with in_use(model):
            # adapt to each object and render its query views
            fields = [self.adapt(each.prepared) for each in episodes]
            queries = [each.query for each in episodes]
            pictures = [field.render(query.cameras).images for field, query in zip(fields, queries, strict=True)]
            samples = Samples(pictures, [query.images for query in queries])
            quality = float(torch.cat([psnr(*pair) for pair in samples.pairs]).mean())
            # does the update depend on the object?
            diagnostics = None
            if model.hypernetwork is not None and len(episodes) > 1:
                prepared = [each.prepared for each in episodes]
                # stacked pictures are no measure of what an update alone loses
                stacked = model.config.stacked or model.config.hull_share or model.config.gated
                gap = swap_gap(model, prepared, queries, None if stacked else quality)
                diagnostics = replace(diagnose(model, prepared), swap_gap=gap)
        return Validation(quality, samples.ssim, samples, diagnostics)

    def _held_out(self) -> list[Episode]:
        names = sorted(self.data.names("val")) or sorted(self.data.names("test"))
        for name in names[: self.config.held_out]:
            if name not in self._episodes:
                task = self.data.task(name)
                few = replace(task, query=task.query[:: max(1, len(task.query) // VIEWS)][:VIEWS])
                self._episodes[name] = prepare_episode(self.model, few, carved=reads_hull(self.model, self.config))
        return list(self._episodes.values())
