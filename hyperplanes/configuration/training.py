"""How a model is trained."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from hyperplanes.utilities.messages.arguments import checked_fields

__all__ = ["TrainingConfig"]


@checked_fields
@dataclass(frozen=True)
class TrainingConfig:
    """How a model is trained (HyperPlanes, Appendix B: one task per step, 512 rays, learning rates 1e-4, no schedule).

    Four objects with 128 rays per step take as long as one with 512 and end 0.5 dB higher; the paper's presets use one.

    Attributes:
        steps: Adam steps.
        epochs: how often each training object is drawn, on average, instead of `steps`; 0 uses `steps`.
        tasks: objects per step.
        reference_objects: further objects per step, of which only the HyperPlanes are read. The hypernetwork
            standardises codes over the objects of the step, and one object does not tell what all have in common.
        rays: query pixels per object and step.
        antialias: whether each of these pixels is the mean of three rays; pictures have five at edges. A field trained
            on one ray per pixel learns a soft surface in place of the mean over its area.
        views: numbers of support views, for a field that takes any number of them. Each episode shows one of these
            numbers of random views of its object, both support and query views, and draws rays from the others. If
            empty, each step shows all support views.
        episodes: number of episodes that are kept for every four objects of a step. Each step adds one of them and
            draws four, so that views, masks and hulls are prepared once for several steps.
        rotations: share of the episodes of `views` whose object is rotated about the vertical axis by a random angle. A
            grid of features, and a network that reads it, learn objects in the orientation of the training; photographs
            have any orientation.
        random_background: whether prediction and truth are composited over a random colour for each object and step,
            where masks show background: over white alone, a white surface looks like none.
        empty_points: points outside the hull, per object and step, at which the density is trained to be 0. Packed
            training takes no samples there, but a field may be rendered without masks.
        volume_loss: weight of an additional loss for a hypernetwork that reads a volume: the first features of the
            target's grid are trained to be the hull and the colours of all views of the object, so that every cell,
            not only those on rays, teaches what few views do not show; 0 for none.
        optimiser: of theta: "adam" as in the paper, or "muon" for the matrices of its hidden layers.
        learning_rate: of theta, by Adam.
        muon_learning_rate: of the matrices of theta that Muon optimises.
        hypernetwork_learning_rate: of the hypernetwork.
        precision: of a hypernetwork's convolutions and matrix products: "single", or "bfloat16" with weights and
            updates in single precision (`torch.autocast`). "automatic" is bfloat16 for hypernetworks that read volumes
            on CPUs with AMX and, on Linux, AMD's with AVX512_BF16, where a step of `small` takes three quarters of the
            time, and single elsewhere. Those that read images standardise codes over the few objects of a step, which
            amplifies rounding. A resumed training keeps its precision.
        warmup: steps in which the learning rates rise from zero.
        final_rate_factor: the learning rates fall to this fraction along half a cosine; 1 keeps them.
        clip: largest norm of the gradient of all trained weights, to which it is clipped; 0 does not clip.
        balanced: whether classes are drawn equally often, whatever their numbers of objects. If a data set states no
            classes, it is one class.
        evaluate_every: steps between validations on held-out objects.
        held_out: number of these objects, from the "val" split, or "test" if there is none.
        checkpoint_every: steps between checkpoints.
        keep_last: number of checkpoints that are kept; older ones are deleted.
        memory: bytes of images, planes and hulls that are kept for later steps; the last object is always kept.
        prefetch: steps whose objects a thread prepares ahead, beyond `memory`; 0 prepares them when they are needed.
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
        """The number of steps for a number of training objects.

        >>> TrainingConfig(epochs=10, tasks=4).steps_for(150)
        375

        Args:
            objects: number of training objects.
        """
        return -(-self.epochs * objects // self.tasks) if self.epochs else self.steps
