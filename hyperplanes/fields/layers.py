"""The layers before the heads of a network by one kernel, where no gradient is wanted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.lookup_torch import transform_of

__all__ = ["PackedLayers", "has_kernel"]

POINTS = 480  # that one call of the kernel works on


@cache
def has_kernel() -> bool:
    """Whether the kernel is faster here than PyTorch: on CPUs with AVX-512."""
    if not find_spec("numba"):
        return False
    from llvmlite.binding import get_host_cpu_features

    try:
        return bool(get_host_cpu_features().get("avx512f"))
    except RuntimeError:  # a processor that LLVM does not know
        return False


@dataclass(frozen=True)
class PackedLayers:
    """Fully connected layers with ReLU, of which one reads the inputs once more, as the kernel reads them.

    With batches of 1,024 points and layers of 128 values the kernel computes 1.5 times as much in a second as PyTorch,
    and twice as much with 64 points (one thread, AVX-512). It does not hold the interpreter's lock.

    Attributes:
        weights: of all layers (`pack_weights`).
        biases: of all layers.
        shape: the number of layers, their width, and the index of the layer that reads the inputs, too; 0 for none.
    """

    weights: Float[Tensor, " weight"]
    biases: Float[Tensor, " bias"]
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, parameters: Mapping[str, Tensor], depth: int, skip: int) -> PackedLayers | None:
        """Those of a network.

        Args:
            parameters: "layers.0.weight", "layers.0.bias" and so on.
            depth: how many layers there are.
            skip: index of the layer that reads the inputs and the values of the layer before; 0 for none.

        Returns:
            None where the kernel does not take them: other devices and precisions, and widths that are no multiple of
            64.
        """
        named = [(parameters[f"layers.{index}.weight"], parameters[f"layers.{index}.bias"]) for index in range(depth)]
        kinds = {(value.device.type, value.dtype) for pair in named for value in pair}
        if not has_kernel() or kinds != {("cpu", torch.float32)}:
            return None
        from hyperplanes.geometry.kernels.layers import COLUMNS, pack_weights

        width = len(named[0][1])
        if width % COLUMNS:
            return None
        packed = [pack_weights(weight.detach()) for weight, _ in named]
        return cls(torch.cat(packed), torch.cat([bias.detach() for _, bias in named]), (depth, width, skip))

    def takes(self, inputs: Tensor) -> bool:
        """Whether the kernel takes these inputs: numbers alone, of single precision, on the CPU."""
        return inputs.dtype == torch.float32 and inputs.device.type == "cpu" and not transform_of(inputs)

    @torch.no_grad()
    def __call__(self, inputs: Float[Tensor, "point input"]) -> Float[Tensor, "point width"]:
        """The values after the last layer; without gradients."""
        result = torch.empty(len(inputs), self.shape[1])
        given, weights, biases = (each.contiguous().numpy() for each in (inputs, self.weights, self.biases))
        kernel, out = compile_kernel("layers.layers", torch.float32), result.numpy()
        parallel_for(lambda a, b: kernel(given, weights, biases, self.shape, out, a, b), len(inputs), POINTS)
        return result
