"""Optimisers: Muon for the weight matrices of hidden layers with Adam for the rest, Adam, or plain gradient descent."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry.kernels.threads import parallel_map
from hyperplanes.utilities.tensors.uncompiled_optimisers import SGD, Adam, Optimizer

__all__ = ["Muon", "make_optimisers", "orthogonalise"]

NEWTON_SCHULZ_COEFFICIENTS = (3.4445, -4.7750, 2.0315)  # of the quintic Newton-Schulz iteration of Jordan et al. 2024
NEWTON_SCHULZ_ITERATIONS = 5
MUON_MOMENTUM = 0.95
NARROWEST = 16  # matrices with fewer rows or columns, such as the heads of colour and density, are left to Adam


def orthogonalise(matrix: Float[Tensor, "row column"]) -> Float[Tensor, "row column"]:
    """An approximation of U V^T, where U S V^T is the singular value decomposition of the matrix.

    Quintic Newton-Schulz iterations (Jordan et al. 2024, "Muon"); the singular values of the result lie between about
    0.7 and 1.2.

    Args:
        matrix: of any scale.
    """
    a, b, c = NEWTON_SCHULZ_COEFFICIENTS
    tall = matrix.shape[0] > matrix.shape[1]
    value = matrix.mT if tall else matrix
    value = value / value.norm().clamp_min(1e-7)
    for _ in range(NEWTON_SCHULZ_ITERATIONS):
        gram = value @ value.mT
        value = torch.addmm(value, torch.addmm(gram, gram, gram, beta=b, alpha=c), value, beta=a)
    return value.mT if tall else value


class Muon(Optimizer):
    """Nesterov momentum whose update of every matrix is orthogonalised (Jordan et al. 2024).

    torch.optim.Muon iterates in bfloat16, which only recent CPUs compute with; this one iterates in the precision of
    the parameters. On one thread, a step on six matrices of 128x128 takes torch.optim.Muon 15 ms and this one 12 ms
    with AMX, 55 and 10 ms with AVX-512 (no bfloat16), and 277 and 14 ms with AVX2 (set by ONEDNN_MAX_CPU_ISA).

    Args:
        parameters: matrices.
        lr: learning rate; the update of a matrix has spectral norm about lr sqrt(max(1, rows / columns)).
    """

    def __init__(self, parameters: Iterable[Tensor], lr: float = 0.02) -> None:
        super().__init__(parameters, {"lr": lr})
        if any(value.ndim != 2 for group in self.param_groups for value in group["params"]):
            raise ValueError("parameters: expected matrices, got a tensor of another number of dimensions")

    @torch.no_grad()
    def step(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """One step along the orthogonalised momentum."""
        for group in self.param_groups:
            moved = [value for value in group["params"] if value.grad is not None]
            for value in moved:
                momentum = self.state[value].setdefault("momentum", torch.zeros_like(value))
                momentum.lerp_(value.grad, 1 - MUON_MOMENTUM)
            # on a CPU, one thread per matrix is faster for small products than all threads for each
            run = parallel_map if all(value.device.type == "cpu" for value in moved) else map
            ahead = [value.grad.lerp(self.state[value]["momentum"], MUON_MOMENTUM) for value in moved]
            for value, direction in zip(moved, run(orthogonalise, ahead), strict=True):
                value.add_(direction, alpha=-group["lr"] * max(1, value.shape[0] / value.shape[1]) ** 0.5)


def make_optimisers(
    variables: Sequence[Tensor],
    name: Literal["adam", "muon", "sgd"],
    adam_rate: float,
    muon_rate: float,
    betas: tuple[float, float] = (0.9, 0.999),
) -> list[Optimizer]:
    """The optimisers of a network's parameters.

    Args:
        variables: the parameters.
        name: "adam", "muon" for the matrices of hidden layers and Adam for the rest, or "sgd", without momentum.
        adam_rate: learning rate of Adam, or of plain gradient descent.
        muon_rate: learning rate of Muon.
        betas: of Adam.

    Returns:
        One optimiser, or Adam and Muon, each with at least one parameter.
    """
    if name == "sgd":
        return [SGD(list(variables), adam_rate)]
    hidden = [name == "muon" and value.ndim == 2 and min(value.shape) >= NARROWEST for value in variables]
    matrices = [value for value, chosen in zip(variables, hidden, strict=True) if chosen]
    others = [value for value, chosen in zip(variables, hidden, strict=True) if not chosen]
    made: list[Optimizer] = []
    if others:
        made.append(Adam(others, adam_rate, betas=betas, fused=True))
    if matrices:
        made.append(Muon(matrices, muon_rate))
    return made
