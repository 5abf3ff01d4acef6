"""How a model is trained."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from hyperplanes.utilities.arguments import checked_fields

__all__ = ["TrainingConfig"]


@checked_fields
@dataclass(frozen=True)
class TrainingConfig:
    """How a model is trained (HyperPlanes, Appendix B: one task a step, 512 rays, learning rates 1e-4, no schedule).

    Four objects of 128 rays a step cost what one of 512 does and end 0.5 dB higher; the paper's presets say one.

    Attributes:
        steps: Adam steps.
        epochs: how often each training object is drawn, on average, instead of `steps`; 0 takes `steps`.
        tasks: objects a step.
        reference_objects: further objects a step, of which only the HyperPlanes are read. The hypernetwork standardises
            codes by the objects of the step, and cannot tell what one object alone has in common with the others.
        rays: query pixels an object and step.
        antialias: each of these pixels is the mean of three rays; pictures have five at edges. What is trained by
            one ray a pixel shows the mean over its area by a soft surface.
        views: numbers of support views, for a field that takes any number of them. Each episode shows one of these
            numbers of random views of its object, support and query alike, and draws rays from others. Empty: all
            support views, in every step.
        episodes: how many of those are at hand at a time for every four objects of a step. Each step begins one of
            them and draws four, so that views, masks and hulls are made ready once for several steps.
        rotations: share of the episodes of `views` whose object is rotated about the vertical axis by a random angle. A
            grid of features and what reads it know objects as they stand in the training; photographs come with any
            heading.
        random_background: prediction and truth are composited over a random colour for every object and step, as far
            as masks say what is background: over white alone, a white surface cannot be told from none.
        empty_points: points outside the hull, an object and step, at which the field is asked to be empty. Packed
            training sees nothing there, but a field that is rendered without masks must know.
        volume_loss: weight of a loss beside that of rays, for a hypernetwork that reads a volume: the first features of
            the target's grid are to be the hull and the colours of all views of the object, so that every cell teaches
            what is behind what few views show, and not only those that a ray meets; 0 is none.
        optimiser: of theta: "adam" as in the paper, or "muon" for the matrices of its hidden layers.
        learning_rate: of theta, by Adam.
        muon_learning_rate: of the matrices of theta that Muon optimises.
        hypernetwork_learning_rate: of the hypernetwork.
        precision: of a hypernetwork's convolutions and matrix products: "single", or "bfloat16" beside weights and
            updates of single precision (`torch.autocast`). "automatic" is bfloat16 for hypernetworks that read volumes
            on CPUs with AMX and, on Linux, AMD's with AVX512_BF16, where a step of `small` takes three quarters of the
            time, and single elsewhere. Those that read images standardise codes over the few objects of a step, and
            rounding grows with that. A training that is resumed keeps the precision that it began with.
        warmup: steps in which the learning rates rise from zero.
        final_rate_factor: what the learning rates fall to along half a cosine, as a fraction; 1 keeps them.
        clip: the norm to which the gradient of all weights that a step moves is cut where it is longer; 0 leaves it.
        balanced: classes are drawn equally often, however many objects each has. Where a data set does not state them,
            each data set is one.
        evaluate_every: steps between validations on held-out objects.
        held_out: how many of them are taken: objects of the "val" split, or where there is none of "test".
        checkpoint_every: steps between checkpoints.
        keep_last: how many of them are kept; older ones are deleted.
        memory: bytes of images, planes and hulls that are kept for later steps; the last object always is.
        prefetch: steps whose objects a thread makes ready ahead, beyond `memory`; 0 makes them when they are due.
        seed: of the objects, rays and samples of every step.
    """

    steps: Annotated[int, range(1, 10**10)] = 2000
    epochs: Annotated[int, range(10**7)] = 0
    tasks: Annotated[int, range(1, 4097)] = 4
    reference_objects: Annotated[int, range(4097)] = 0
    rays: Annotated[int, range(1, 2**24)] = 128
    antialias: bool = False
    views: tuple[int, ...] = ()
    episodes: Annotated[int, range(1, 4097)] = 16
    rotations: float = 0.0
    random_background: bool = False
    empty_points: Annotated[int, range(2**24)] = 0
    volume_loss: float = 0.0
    optimiser: Literal["adam", "muon"] = "adam"
    learning_rate: float = 1e-4
    muon_learning_rate: float = 0.02
    hypernetwork_learning_rate: float = 1e-4
    precision: Literal["automatic", "single", "bfloat16"] = "automatic"
    warmup: Annotated[int, range(10**10)] = 0
    final_rate_factor: float = 1.0
    clip: float = 0.0
    balanced: bool = False
    evaluate_every: Annotated[int, range(1, 10**10)] = 250
    held_out: Annotated[int, range(10**6)] = 4
    checkpoint_every: Annotated[int, range(1, 10**10)] = 500
    keep_last: Annotated[int, range(1, 10**6)] = 1
    memory: Annotated[int, range(2**50)] = 2 * 2**30
    prefetch: Annotated[int, range(1025)] = 1
    seed: Annotated[int, range(2**40)] = 0

    def __post_init__(self) -> None:
        for name in (
            *("learning_rate", "muon_learning_rate", "hypernetwork_learning_rate"),
            *("final_rate_factor", "volume_loss", "clip"),
        ):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a finite number of 0 or more, got {getattr(self, name)}")
        if not 0 <= self.rotations <= 1:
            raise ValueError(f"rotations: expected a share from 0 to 1, got {self.rotations}")

    def steps_for(self, objects: int) -> int:
        """How many steps are taken with so many training objects.

        >>> TrainingConfig(epochs=10, tasks=4).steps_for(150)
        375

        Args:
            objects: to train on.
        """
        return -(-self.epochs * objects // self.tasks) if self.epochs else self.steps
