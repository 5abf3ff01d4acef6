"""Gradient descent on the support views of one object, from trained, random or meta-learned weights.

All share one loop (`Descent.run`): a field is made from some variables, rays of the support views are rendered, and the
variables follow the gradient of the squared error (HyperPlanes, section 3, fine-tuning).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.optimisation.gradients import summed_gradients
from hyperplanes.adaptation.optimisation.optimisers import make_optimisers
from hyperplanes.configuration.fine_tuning import RATES, FineTuning
from hyperplanes.geometry.rays import Rays
from hyperplanes.parameters import Parameters
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.views import Views

__all__ = ["Descent", "contrast", "draw_pixels", "pixels_of", "ray_loss", "split_holdout"]

HOLDOUT_RAYS = 4096  # of held-out views, on which "auto" compares numbers of steps
PART = 512  # rays of a step whose gradients one thread computes, at most
CHECKS = 10  # of "auto" along the schedule
LEAST = 0.05  # added to the contrast of all pixels


def ray_loss(seen: Rendered, truth: Tensor, weights: Tensor | float = 1.0) -> Tensor:
    """Mean squared error of the colours of rays, plus that of the coarse pass if there is one (Eq. 2).

    Args:
        seen: the rendered rays.
        truth: their true colours (ray, 3).
        weights: of each ray (ray, 1).
    """
    loss = (weights * (seen.colour - truth).square()).mean()
    return loss if seen.coarse is None else loss + (weights * (seen.coarse.colour - truth).square()).mean()


def contrast(images: Float[Tensor, "view 3 height width"]) -> Float[Tensor, "view height width"]:
    """The range of values in the 3x3 pixels around each pixel, averaged over channels.

    >>> contrast(torch.tensor([0.0, 0.0, 0.0, 0.6]).expand(1, 3, 1, 4))
    tensor([[[0.0000, 0.0000, 0.6000, 0.6000]]])

    Args:
        images: with values in [0, 1].

    Returns:
        In [0, 1], for each pixel.
    """
    # view by view, to stay in cache: 19 ms for 50 views of 200x200, where `max_pool2d` takes 400 (one thread)
    return torch.stack([(_local_maximum(view) + _local_maximum(-view)).mean(0) for view in images])


def _local_maximum(values: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel height width"]:
    """The largest value in the 3x3 pixels around each pixel."""
    for axis, size in ((1, values.shape[1]), (2, values.shape[2])):
        first, last = values.narrow(axis, 0, 1), values.narrow(axis, size - 1, 1)
        padded = torch.cat([first, values, last], axis)
        values = torch.maximum(torch.maximum(padded.narrow(axis, 0, size), padded.narrow(axis, 2, size)), values)
    return values


def draw_pixels(
    importance: Float[Tensor, " pixel"], among: Int[Tensor, " some"] | None, count: int, generator: torch.Generator
) -> tuple[Int[Tensor, " drawn"], Float[Tensor, "drawn 1"]]:
    """Pixels drawn in proportion to an importance, and weights that make their mean unbiased.

    This is importance sampling (Kahn & Marshall 1953). The closer the importance is to the error, the lower the
    variance of the loss (`tests/test_trained.py`).

    Args:
        importance: above 0.
        among: indices of the pixels to draw from; all if None.
        count: how many, drawn with replacement.
        generator: on the CPU.

    Returns:
        Their indices and weights; weights are 1 if the importance is constant.

    Raises:
        ValueError: no pixel to draw from.
    """
    known = importance if among is None else importance[among]
    if not len(known):
        raise ValueError("among: expected at least one pixel to draw rays from, got none")
    summed = known.to(torch.float64).cumsum(0)
    places = torch.rand(count, generator=generator, dtype=torch.float64).to(summed.device) * summed[-1]
    drawn = torch.searchsorted(summed, places).clamp_max(len(summed) - 1)
    weights = (summed[-1] / len(summed) / known[drawn]).to(importance)
    return drawn if among is None else among[drawn], weights[:, None]


@dataclass(frozen=True)
class Descent:
    """A descent on the squared error of rays of support views.

    Attributes:
        field: makes the field of the current tensors, with the views of the given indices masked.
        tensors: optimised in place.
        weights: makes the parameters of the field of the current tensors.
        views: the views that rays and their colours are drawn from.
        settings: rays, rates and seed; a `draw` of None is uniform.
        pixels: flat indices (view, row, column) of `views` to draw from, ascending; all if None.
        masks_views: whether the views that the rays of a step come from may be masked, as `settings.mask_views` says.
    """

    field: Callable[[Int[Tensor, " masked"] | None], AdaptedField]
    tensors: Sequence[Tensor]
    weights: Callable[[], Parameters]
    views: Views
    settings: FineTuning
    pixels: Int[Tensor, " pixel"] | None = None
    masks_views: bool = False

    def run(self, steps: int) -> Iterator[int]:
        """Gradient steps.

        Args:
            steps: length of the schedule of the rates.

        Yields:
            The number of steps done: 0, then one more after each step.
        """
        settings, views = self.settings, self.views
        name, adam, muon = RATES[settings.trainable]
        optimisers = make_optimisers(
            self.tensors,
            settings.optimiser or name,
            adam if settings.learning_rate is None else settings.learning_rate,
            muon if settings.muon_learning_rate is None else settings.muon_learning_rate,
            betas=settings.betas,
        )
        rates = [optimiser.param_groups[0]["lr"] for optimiser in optimisers]
        generator = torch.Generator().manual_seed(settings.seed)
        masks_views = self.masks_views and settings.mask_views and len(views) > 1
        importance = contrast(views.images).flatten() + LEAST if settings.draw == "contrast" else None
        yield 0
        for step in range(steps):
            with torch.enable_grad():
                # the views that this step's rays come from are masked
                masked = self._draw_views(generator) if masks_views else None
                among = self.pixels if masked is None else pixels_of(masked, views, self.pixels)
                # the current field, and the gradients of the error of its rays
                field = self.field(masked)
                near_far, weights = field.sampling.near_far, None
                if importance is None:
                    rays, truth = views.sample_rays(settings.rays, generator=generator, among=among, near_far=near_far)
                else:
                    drawn, weights = draw_pixels(importance, among, settings.rays, generator)
                    rays, truth, _ = views.rays_at(drawn, near_far=near_far)
                gradients = self._gradients(field, rays, truth, generator, weights)
                # one step of each optimiser, at the scheduled rate
                for tensor, gradient in zip(self.tensors, gradients, strict=True):
                    tensor.grad = gradient
                for optimiser, rate in zip(optimisers, rates, strict=True):
                    optimiser.param_groups[0]["lr"] = rate * settings.schedule(step, steps)
                    optimiser.step()
            yield step + 1

    def _gradients(
        self,
        field: AdaptedField,
        rays: Rays,
        truth: Tensor,
        generator: torch.Generator,
        weights: Tensor | None = None,
    ) -> Sequence[Tensor | None]:
        """The gradients of the mean loss of rays, split into parts with one thread and one generator each."""
        # with a hypernetwork all rays share its graph
        size = PART if self.settings.trainable == "weights" and truth.device.type == "cpu" else len(rays)
        starts = range(0, len(rays), size)
        generators = [generator]
        if len(starts) > 1:
            seeds = torch.randint(2**62, (len(starts),), generator=generator)
            generators = [torch.Generator().manual_seed(seed) for seed in seeds.tolist()]

        def loss(index: int) -> Tensor:
            part = slice(starts[index], starts[index] + size)
            share = len(truth[part]) / len(truth)
            counted = 1.0 if weights is None else weights[part]
            return share * ray_loss(field.trace(rays[part], generators[index]), truth[part], counted)

        return summed_gradients(loss, len(starts), self.tensors, thread_safe=field.thread_safe)[1]

    @torch.no_grad()
    def errors(self) -> tuple[float, float]:
        """Squared errors on the same `settings.rays` rays of the views: of the current field and an empty picture."""
        field, generator = self.field(None), torch.Generator().manual_seed(self.settings.seed + 2)
        near_far = field.sampling.near_far
        rays, truth = self.views.sample_rays(
            self.settings.rays, generator=generator, among=self.pixels, near_far=near_far
        )
        seen = field.trace(rays, differentiable=False).colour
        return float((seen - truth).square().mean()), float((1 - truth).square().mean())

    def best_stop(
        self,
        holdout: Views,
        *,
        unchanged: AdaptedField | None = None,
        beside: AdaptedField | None = None,
        share: float = 0.0,
        pixels: Int[Tensor, " pixel"] | None = None,
        on_step: Callable[[int], None] | None = None,
    ) -> int:
        """The number of steps, up to `settings.max_steps`, after which the error on held-out views is least.

        The squared error of the same HOLDOUT_RAYS rays is compared at 0 steps and CHECKS times along the schedule.
        It ends early after three checks without improvement.

        Args:
            holdout: the held-out views.
            unchanged: the field of 0 steps, if that is not the one that the descent begins with.
            beside: a field that pictures are averaged with, if any.
            share: of `beside` in the average.
            pixels: flat indices of the pixels of `holdout` to draw rays from.
            on_step: called with the number of steps done, before the first and after each.
        """
        most = self.settings.max_steps
        generator = torch.Generator().manual_seed(self.settings.seed + 1)
        # the rays that fields are compared on, the same at every check
        with torch.no_grad():
            near_far = self.field(None).sampling.near_far
            rays, truth = holdout.sample_rays(HOLDOUT_RAYS, generator=generator, among=pixels, near_far=near_far)
            averaged = None if beside is None else beside.trace(rays, differentiable=False).colour
        errors: dict[int, float] = {}
        every = max(1, most // CHECKS)

        best = 0
        for step in self.run(most):
            if on_step is not None:
                on_step(step)
            # between two checks
            if step not in (0, every // 3, most) and step % every:
                continue
            field = unchanged if unchanged is not None and not step else self.field(None)
            with torch.no_grad():
                colour = field.trace(rays, differentiable=False).colour
                colour = colour if averaged is None else colour.lerp(averaged, share)
                error = float((colour - truth).square().mean())
            errors[step] = error if math.isfinite(error) else math.inf
            best = min(errors, key=lambda each: errors[each])
            if step - best > 2 * every:
                break
        return best

    def _draw_views(self, generator: torch.Generator) -> Int[Tensor, " masked"]:
        """The views that a step draws rays from, among those with a pixel to draw from."""
        drawn = torch.randperm(len(self.views), generator=generator).to(self.views.images.device)
        if self.pixels is not None:
            area = self.views.size[0] * self.views.size[1]
            edges = torch.arange(len(self.views) + 1, device=self.pixels.device) * area
            drawn = drawn[(torch.searchsorted(self.pixels, edges).diff() > 0)[drawn]]
        return drawn[: max(1, len(self.views) // self.settings.holdout)]


def pixels_of(chosen: Int[Tensor, " chosen"], views: Views, pixels: Int[Tensor, " pixel"] | None) -> Tensor:
    """Flat indices (view, row, column) of the pixels of some views: all of them, or those among `pixels`.

    Args:
        chosen: indices of the views.
        views: all of them.
        pixels: flat indices, ascending; all if None.
    """
    area = views.size[0] * views.size[1]
    if pixels is None:
        return (chosen[:, None] * area + torch.arange(area, device=chosen.device)).flatten()
    edges = torch.searchsorted(pixels, torch.stack([chosen, chosen + 1], 1) * area)
    return torch.cat([pixels[start:stop] for start, stop in edges.tolist()])


def split_holdout(support: Views, settings: FineTuning) -> tuple[Views, Views]:
    """The views that "auto" fine-tunes on while it chooses the number of steps, and the held-out ones.

    Raises:
        ValueError: fewer than 3 views.
    """
    if len(support) < 3:
        raise ValueError(f"steps: expected at least 3 support views for 'auto', got {len(support)}")
    every = min(settings.holdout, len(support))
    held_out = torch.arange(len(support)) % every == every // 2
    return support[(~held_out).nonzero()[:, 0]], support[held_out.nonzero()[:, 0]]
