"""Masks by a program that the user names, such as rembg or a wrapper of SAM."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from hyperplanes.data.pictures.images import read_mask
from hyperplanes.utilities.files.encoding import encode_png
from hyperplanes.utilities.files.reading import DataError

__all__ = ["Command"]

TIMEOUT_SECONDS = 600  # for one image


@dataclass(frozen=True)
class Command:
    """A program that reads an image and writes its mask, or the image with alpha.

    Attributes:
        line: the command, with {image} and {mask} for the paths of the two files. It is run without a shell.

    Raises:
        ValueError: {image} or {mask} is missing, a quotation is not closed, or the program is not installed.
    """

    line: str

    def __post_init__(self) -> None:
        if "{image}" not in self.line or "{mask}" not in self.line:
            raise ValueError(
                f"--mask: expected a command with {{image}} and {{mask}} in it, got {self.line!r}; "
                'such as --mask "rembg i {image} {mask}"'
            )
        try:
            program = shlex.split(self.line)[0]
        except ValueError as error:  # an unbalanced quotation mark
            raise ValueError(f"--mask: expected a command, got {self.line!r} ({error}); correct it") from None
        if shutil.which(program) is None:
            raise ValueError(f"--mask: expected a program that is installed, found none called {program!r}")

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Opacity in [0, 1].

        Raises:
            ValueError: the program fails, or takes longer than ten minutes.
            DataError: the mask has another size than the image.
        """
        with tempfile.TemporaryDirectory() as folder:
            image, mask = Path(folder) / "image.png", Path(folder) / "mask.png"
            image.write_bytes(encode_png(picture))
            words = [
                word.replace("{image}", str(image)).replace("{mask}", str(mask)) for word in shlex.split(self.line)
            ]
            try:
                done = subprocess.run(
                    words, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_SECONDS, check=False
                )
            except (OSError, subprocess.TimeoutExpired) as error:
                raise ValueError(f"--mask: expected a program that runs, found {error}; check {self.line!r}") from error
            if done.returncode or not mask.is_file():
                said = (done.stderr or done.stdout).strip().splitlines()[-1:] or ["nothing"]
                raise ValueError(
                    f"--mask: expected a mask from {words[0]}, found exit code {done.returncode} and {said[0]!r}; "
                    "try the command on one photograph"
                )
            opacity = read_mask(mask)
        if opacity.shape != picture.shape[:2]:
            found = f"{opacity.shape[1]} x {opacity.shape[0]}"
            size = f"{picture.shape[1]} x {picture.shape[0]} pixels"
            raise DataError("--mask", f"a mask of {size}, as the image", found, "correct the command")
        return opacity / 255.0
