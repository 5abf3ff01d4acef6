"""The layers before the heads of a network in one kernel, for evaluation without gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import NoReturn

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from hyperplanes.geometry.kernels.compiling import compile_kernel, layers_module
from hyperplanes.geometry.kernels.threads import parallel_for

__all__ = ["Layer", "PackedLayers", "has_mixed_precision"]

Layer = tuple[Tensor, Tensor]
"""Weights (width, input) and biases (width,)."""

MLP_CHUNK = 480  # in one call of a kernel: eight blocks of the kernels for AVX-512, three of that for AMX


def has_mixed_precision() -> bool:
    """Whether this processor has a separate kernel for mixed precision."""
    return layers_module(mixed_precision=True) != layers_module()


@dataclass(frozen=True)
class PackedLayers:
    """Fully connected layers with ReLU and one skip connection from the inputs, packed for the kernel.

    Four layers of 128 values take 0.67 to 0.83 of the time of PyTorch with AVX-512 and 0.36 to 0.50 with AMX, for 64 to
    4,096 points (one thread of an Intel processor), and 0.64 to 0.77 with AVX-512 and 0.37 to 0.45 with its bfloat16
    instructions on a Zen 4. The kernels release the GIL. With AMX, values differ from those of PyTorch by about 1e-5 to
    3e-5 of the largest, in mixed precision by 0.1 to 1 %. The packed layers are valid in this process only and cannot
    be pickled.

    Attributes:
        module: of the kernel (`layers_module`).
        weights: of all layers, from its `pack_weights`.
        biases: of all layers.
        shape: the number of layers, their width, and the index of the layer with the skip connection; 0 for none.
        inputs: size of the inputs.
    """

    module: str
    weights: Shaped[Tensor, " weight"]
    biases: Float[Tensor, " bias"]
    shape: tuple[int, int, int]
    inputs: int

    @classmethod
    def of(cls, layers: Sequence[Layer], skip: int, *, mixed_precision: bool = False) -> PackedLayers | None:
        """Packs the layers of a network.

        Args:
            layers: in order.
            skip: index of the layer that reads the inputs and the output of the layer before; 0 for none.
            mixed_precision: whether factors of products may be rounded to bfloat16 where that is faster.

        Returns:
            None if no kernel is faster or supports them: without numba, AVX-512 and AMX, on other devices, in other
            precisions, for widths above its largest or not a multiple of its columns, and for inconsistent shapes.
        """
        kinds = {(value.device.type, value.dtype) for layer in layers for value in layer}
        module = layers_module(mixed_precision=mixed_precision)
        if module is None or kinds != {("cpu", torch.float32)}:
            return None
        kernel = import_module(f"hyperplanes.geometry.kernels.{module}")
        width, inputs = layers[0][0].shape
        own = [inputs if index in (0, skip) else 0 for index in range(len(layers))]
        shapes = [((width, size + width * (index > 0)), (width,)) for index, size in enumerate(own)]
        fits = width % kernel.COLUMNS == 0 and width <= kernel.MAX_LAYER_WIDTH
        if not fits or [(weight.shape, bias.shape) for weight, bias in layers] != shapes:
            return None
        packed = [kernel.pack_weights(weight.detach(), size) for (weight, _), size in zip(layers, own, strict=True)]
        biases = torch.cat([bias.detach() for _, bias in layers])
        return cls(module, torch.cat(packed), biases, (len(layers), width, skip), inputs)

    def __reduce__(self) -> NoReturn:
        raise TypeError("packed layers: expected to be packed again in each process, which may have another kernel")

    def takes(self, inputs: Tensor) -> bool:
        """Whether the kernel takes these inputs: float32, on the CPU, and of the size that the first layer reads.

        Args:
            inputs: one row per point.
        """
        fits = inputs.ndim == 2 and inputs.shape[1] == self.inputs
        return fits and inputs.dtype == torch.float32 and inputs.device.type == "cpu"

    @torch.no_grad()
    def __call__(self, inputs: Float[Tensor, "point input"]) -> Float[Tensor, "point width"]:
        """The values after the last layer; without gradients."""
        result = inputs.new_empty(len(inputs), self.shape[1])
        given, weights, biases, out = (each.detach().numpy() for each in (inputs, self.weights, self.biases, result))
        kernel = compile_kernel(f"{self.module}.layers", torch.float32)
        parallel_for(lambda a, b: kernel(given, weights, biases, self.shape, out, a, b), len(inputs), MLP_CHUNK)
        return result
