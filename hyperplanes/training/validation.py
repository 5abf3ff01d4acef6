"""Validation during training: some query views of held-out objects are rendered and compared."""

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
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Tasks

__all__ = ["Validation", "Validator"]

VIEWS = 2  # query views of each object


@dataclass(frozen=True)
class Validation:
    """The results on held-out objects.

    Attributes:
        psnr: mean over the views, in dB.
        ssim: mean over the views; None if pictures are smaller than its window.
        samples: the rendered views and the true images.
        diagnostics: diagnostics of the hypernetwork; None without a hypernetwork, or with fewer than two objects.
    """

    psnr: float
    ssim: float | None
    samples: Samples
    diagnostics: Diagnostics | None


class Validator:
    """Renders the same query views of the same held-out objects each time.

    The objects are those of the "val" split, or of "test" if there is no "val" split. The results decide only which
    model is written to best/. Planes and hulls of the objects are prepared once.

    Args:
        model: the model that is trained.
        data: the data set with the held-out objects.
        config: the configuration of the training; `held_out` is the number of objects.
        adapt: makes the field of an object.
    """

    def __init__(
        self, model: HyperPlanes, data: Tasks, config: TrainingConfig, adapt: Callable[[SupportContext], AdaptedField]
    ) -> None:
        self.model, self.data, self.config, self.adapt = model, data, config, adapt
        self._episodes: dict[str, Episode] = {}

    def prepare(self) -> None:
        """Read and prepare the held-out objects; ValueError for an object that cannot be used.

        Otherwise the first validation does so.
        """
        self._held_out()

    @torch.no_grad()
    def run(self) -> Validation | None:
        """Validate the model; None if there are no held-out objects."""
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
                # the gap is that of the fields alone, so the PSNR of stacked pictures cannot be used
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
