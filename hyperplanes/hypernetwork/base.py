"""The interface of every hypernetwork: what is observed of some objects becomes an update of theta for each of them."""

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
    """What is seen of several objects; a hypernetwork reads the images or the volume.

    Attributes:
        images: the HyperPlanes, RGB in [0, 1].
        directions: their unit viewing directions in the world.
        present: which of the images there are, where objects have different numbers of them; all where None.
        volume: what all views show on a grid over the scene.
    """

    images: Float[Tensor, "object view 3 height width"] | None = None
    directions: Float[Tensor, "object view 3"] | None = None
    present: Bool[Tensor, "object view"] | None = None
    volume: Float[Tensor, "object channel x y z"] | None = None


class HyperNetwork(nn.Module):
    """H(observed, theta; delta) -> one tensor for each named parameter that is updated (HyperPlanes, Eq. 7).

    Attributes:
        reads_volume: it reads `Observed.volume`, each object alone, and otherwise images with their directions.
        views: k, how many images it reads of an object.
        choice: which of the planes they are: the "farthest" apart, or the "first".
        resolution: pixels a side that it wants images to have; 0 takes them as they are.
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
            TypeError: a subclass that computes nothing.
        """
        raise TypeError(f"{type(self).__name__} does not say what it computes")

    def standardised_codes(self, observed: Observed) -> Tensor | None:
        """Codes of the objects in deviations of those of the training; None where nothing is standardised."""
        return None

    @property
    def activated(self) -> Sequence[nn.Module]:
        """The layers whose outputs go through an activation function, for diagnostics."""
        return ()
