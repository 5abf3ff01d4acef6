"""The interface of hypernetworks: from observations of several objects to an update of theta for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Bool, Float
from torch import Tensor, nn

from hyperplanes.parameters import Parameters

__all__ = ["HyperNetwork", "Observed"]


@dataclass(frozen=True)
class Observed:
    """The inputs of a hypernetwork for several objects; it reads the images or the volume.

    Attributes:
        images: the HyperPlanes, RGB in [0, 1].
        directions: their unit viewing directions in the world.
        present: mask of the images that are not padding, for objects with different numbers of them; all if None.
        volume: all views projected onto a grid over the scene.
    """

    images: Float[Tensor, "object view 3 height width"] | None = None
    directions: Float[Tensor, "object view 3"] | None = None
    present: Bool[Tensor, "object view"] | None = None
    volume: Float[Tensor, "object channel x y z"] | None = None


class HyperNetwork(nn.Module):
    """H(observed, theta; delta) -> one tensor for each named parameter that is updated (HyperPlanes, Eq. 7).

    Attributes:
        reads_volume: whether it reads `Observed.volume`, and each object alone; otherwise images with their directions.
        views: k, the number of images that it reads of an object.
        choice: which of the planes it reads: the "farthest" apart, or the "first".
        resolution: pixels a side to which images are resized; 0 leaves them unchanged.
    """

    reads_volume: ClassVar[bool] = False

    views: int = 0
    choice: str = "farthest"
    resolution: int = 0

    def forward(self, observed: Observed, theta: Mapping[str, Tensor]) -> list[Parameters]:
        """The update of theta for each object.

        Args:
            observed: the objects.
            theta: the target's parameters.

        Raises:
            TypeError: not defined by a subclass.
        """
        raise TypeError(f"{type(self).__name__} does not define forward")

    def standardised_codes(self, observed: Observed) -> Tensor | None:
        """Codes of the objects, standardised over the training; None if they are not standardised."""
        return None

    @property
    def activated(self) -> Sequence[nn.Module]:
        """The layers whose outputs go through an activation function, for diagnostics."""
        return ()
