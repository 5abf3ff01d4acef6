"""LPIPS, the perceptual distance of Zhang et al. 2018, with AlexNet and weights that the user provides.

The weights are the state dict of the network of the package `lpips`. Where that package is installed, this writes them:

    import lpips, safetensors.torch
    state = lpips.LPIPS(net="alex").state_dict()
    safetensors.torch.save_file({name: value.clone() for name, value in state.items()}, "lpips-alex.safetensors")

The package itself is not a dependency, because it depends on torchvision, which installs another build of torch.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, relu

from hyperplanes.utilities.files.checkpoints import check_tensors, load_tensors

__all__ = ["LPIPS"]

# of the five convolutions: name in the file, output and input channels, kernel, stride, padding, whether pooled before
CONVOLUTIONS = (
    ("net.slice1.0", 64, 3, 11, 4, 2, False),
    ("net.slice2.3", 192, 64, 5, 1, 2, True),
    ("net.slice3.6", 384, 192, 3, 1, 1, True),
    ("net.slice4.8", 256, 384, 3, 1, 1, False),
    ("net.slice5.10", 256, 256, 3, 1, 1, False),
)
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of RGB in [-1, 1], as in the package
MIN_IMAGE_SIZE = 32  # pixels along a side: the first convolution has stride 4, and two poolings follow


class LPIPS:
    """The distance of two pictures in the features of AlexNet, weighted to agree with human judgements.

    Args:
        path: the safetensors file of the weights, as described above.
        device: the device to compute on.

    Raises:
        CheckpointError: the file does not exist, or tensors are missing or have other shapes.
    """

    def __init__(self, path: Path, device: torch.device | str = "cpu") -> None:
        expected: dict[str, Tensor] = {}
        for index, (name, out, into, kernel, *_) in enumerate(CONVOLUTIONS):
            expected[f"{name}.weight"] = torch.empty(out, into, kernel, kernel, device="meta")
            expected[f"{name}.bias"] = torch.empty(out, device="meta")
            expected[f"lin{index}.model.1.weight"] = torch.empty(1, out, 1, 1, device="meta")
        found = {name: value for name, value in load_tensors(path).items() if name in expected}
        check_tensors(path, found, expected)
        self.weights = {name: value.float().to(device) for name, value in found.items()}

    @torch.no_grad()
    def __call__(
        self, predicted: Float[Tensor, "view 3 height width"], truth: Float[Tensor, "view 3 height width"]
    ) -> Float[Tensor, " view"]:
        """The distance of each picture from the true image, both RGB in [0, 1]; 0 if they are equal.

        Raises:
            ValueError: pictures smaller than 32 x 32 pixels.
        """
        if min(truth.shape[2:]) < MIN_IMAGE_SIZE:
            expected = f"at least {MIN_IMAGE_SIZE} x {MIN_IMAGE_SIZE} pixels for LPIPS"
            raise ValueError(f"images: expected {expected}, got {truth.shape[2]} x {truth.shape[3]}")
        first, second = self._scaled(predicted), self._scaled(truth)
        total = torch.zeros(len(truth), device=first.device)
        for index, (name, _, _, _, stride, padding, pooled) in enumerate(CONVOLUTIONS):
            weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
            first, second = (
                relu(conv2d(max_pool2d(each, 3, 2) if pooled else each, weight, bias, stride, padding))
                for each in (first, second)
            )
            difference = (_unit(first) - _unit(second)).square()
            total = total + conv2d(difference, self.weights[f"lin{index}.model.1.weight"]).mean((1, 2, 3))
        return total.to(truth.device)

    def _scaled(self, images: Tensor) -> Tensor:
        """RGB in [0, 1], normalised as in the training of AlexNet."""
        images = images.float().to(next(iter(self.weights.values())).device)
        shift, scale = (images.new_tensor(each).view(1, 3, 1, 1) for each in (SHIFT, SCALE))
        return (2 * images - 1 - shift) / scale


def _unit(features: Tensor) -> Tensor:
    """Features with length 1 at every pixel."""
    return features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)
