"""The gradients of two methods of meta-learning: MAML (Finn et al. 2017) and Reptile (Nichol et al. 2018)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import torch
from torch import Tensor

from hyperplanes.parameters import Parameters

__all__ = ["maml_gradient", "reptile_gradient"]

Loss: TypeAlias = Callable[[Parameters], Tensor]


def maml_gradient(
    theta: Mapping[str, Tensor], inner: Sequence[Loss], outer: Loss, rate: float, *, first_order: bool = False
) -> tuple[Parameters, Tensor]:
    """The gradient with respect to theta of outer(theta_K), the loss after K gradient steps from theta.

    theta_0 = theta, theta_{i+1} = theta_i - rate grad inner_i(theta_i).

    Args:
        theta: the initialisation.
        inner: the loss of each of the K gradient steps on an object.
        outer: the loss after these steps.
        rate: the learning rate of the steps.
        first_order: treat the gradients of the inner losses as constants, so that no second derivative is needed.

    Returns:
        The gradient, and the value of the outer loss.

    >>> square = lambda parameters: parameters["w"].square()
    >>> gradient, loss = maml_gradient({"w": torch.tensor(1.0)}, [square], square, 0.25)
    >>> loss.item(), gradient["w"].item()  # w' = w - 0.25 (2 w) = w / 2; d (w / 2)^2 / dw = w / 2
    (0.25, 0.5)
    """
    with torch.enable_grad():
        start = Parameters((name, value.detach().clone().requires_grad_(True)) for name, value in theta.items())
        parameters = start
        for loss in inner:
            slope = _gradient(loss(parameters), parameters, create_graph=not first_order)
            parameters = Parameters((name, value - rate * slope[name]) for name, value in parameters.items())
        value = outer(parameters)
        return _gradient(value, start).detach(), value.detach()


def _gradient(value: Tensor, parameters: Parameters, *, create_graph: bool = False) -> Parameters:
    """The gradient of a scalar; zero for parameters that it does not depend on."""
    found = torch.autograd.grad(value, list(parameters.values()), create_graph=create_graph, materialize_grads=True)
    return Parameters(zip(parameters, found, strict=True))


@torch.no_grad()
def reptile_gradient(theta: Mapping[str, Tensor], adapted: Sequence[Mapping[str, Tensor]]) -> Parameters:
    """Theta minus the mean of the weights after gradient descent on each of several objects.

    A gradient step with this gradient and learning rate e is Reptile's theta + e (mean - theta). Tancik et al. 2021
    pass it to Adam.

    Args:
        theta: the initialisation.
        adapted: the weights of each object after gradient descent.
    """
    return Parameters(
        (name, value - torch.stack([each[name] for each in adapted]).mean(0)) for name, value in theta.items()
    )
