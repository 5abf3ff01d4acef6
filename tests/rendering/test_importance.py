"""Gradients of samples that are drawn by their weights. Source of truth: the gradients of all samples, on average."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere
from hyperplanes.rendering import RayMarching, march, render
from hyperplanes.rendering.integration import _all_at_once, _by_importance
from hyperplanes.rendering.scene import Scene
from tests.reference_rendering import some_rays


@dataclass(frozen=True)
class Ball:
    """A density that decreases with the distance from the origin, through a softplus; colours depend on position."""

    weights: Tensor

    def __call__(self, points, directions):
        return self.colour_of(self.hidden(points), directions), self.density_of(self.hidden(points))

    def hidden(self, points):
        return points

    def density_of(self, hidden):
        return 20 * torch.nn.functional.softplus(self.weights[0] - self.weights[1] * hidden.norm(dim=1))

    def colour_of(self, hidden, directions):
        return torch.sigmoid(self.weights[2] * hidden + self.weights[3])


def ball(level):
    weights = torch.tensor([level, 12.0, 2.0, 0.5], dtype=torch.double, requires_grad=True)
    return Ball(weights), weights


def gradient_of(rendered, weights):
    truth = torch.linspace(0, 1, rendered.colour.numel(), dtype=torch.double).reshape(rendered.colour.shape)
    loss = (rendered.colour - truth).square().mean()
    return loss.detach(), torch.autograd.grad(loss, weights)[0]


@pytest.mark.parametrize("level", [6.0, 0.0])  # a solid ball, and haze whose samples all have small weights
def test_the_mean_gradient_and_the_pixels_are_those_of_all_samples(level):
    field, weights = ball(level)
    rays, grid = some_rays(40), full(Sphere(), 4)
    samples = march(rays, grid, 2 / 64)
    loss, expected = gradient_of(_all_at_once(Scene(field, grid), rays, samples), weights)
    losses, found = zip(
        *(
            gradient_of(
                _by_importance(Scene(field, grid), rays, samples, 1e-3, torch.Generator().manual_seed(seed)), weights
            )
            for seed in range(60)
        ),
        strict=True,
    )
    assert float(torch.stack(losses).mean()) == pytest.approx(float(loss), rel=0.01)
    torch.testing.assert_close(torch.stack(found).mean(0), expected, rtol=0.03, atol=0.01 * float(expected.norm()))


def test_not_all_samples_have_gradients():
    field, weights = ball(6.0)
    differentiated, evaluated = [], []

    class Counting(Ball):
        def hidden(self, points):
            evaluated.append(len(points))
            return super().hidden(points)

        def __call__(self, points, directions):
            differentiated.append(len(points))
            return super().__call__(points, directions)

    rays, grid = some_rays(40), full(Sphere(), 4)
    seen = render(Counting(weights), rays, RayMarching(64), occupancy=grid, generator=torch.Generator().manual_seed(0))
    assert seen.colour.requires_grad
    assert differentiated[0] < 0.5 * len(march(rays, grid, 2 / 64))
    assert seen.samples == sum(evaluated) - sum(differentiated)  # a call of the ball evaluates `hidden` twice


def test_without_random_samples_or_stopping_all_samples_have_gradients():
    field, weights = ball(6.0)
    rays, grid = some_rays(40), full(Sphere(), 4)
    expected = gradient_of(_all_at_once(Scene(field, grid), rays, march(rays, grid, 2 / 64)), weights)
    torch.testing.assert_close(gradient_of(render(field, rays, RayMarching(64), occupancy=grid), weights), expected)
    drawn = [torch.Generator().manual_seed(1) for _ in range(2)]
    jittered = march(rays, grid, 2 / 64, drawn[0])
    expected = gradient_of(_all_at_once(Scene(field, grid), rays, jittered), weights)
    found = render(field, rays, RayMarching(64, 0.0), occupancy=grid, generator=drawn[1])
    torch.testing.assert_close(gradient_of(found, weights), expected)


def test_a_ray_without_drawn_samples_has_the_colour_of_the_background():
    field, _ = ball(-3.0)  # haze, in which only some rays have a drawn sample
    rays, grid = some_rays(40), full(Sphere(), 4)
    samples = march(rays, grid, 2 / 64)
    seen = _by_importance(Scene(field, grid, background=0.7), rays, samples, 1e-3, torch.Generator().manual_seed(0))
    undrawn = (seen.colour - 0.7).abs().amax(1) < 1e-9
    assert 10 < undrawn.sum() < 40
    assert seen.opacity[undrawn].max() > 0.01
