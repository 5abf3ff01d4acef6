"""Named configurations: what a model is made of and how it is trained."""

from __future__ import annotations

from dataclasses import dataclass, replace

from hyperplanes.adaptation.hyperplanes import ModelConfig
from hyperplanes.fields import find_targets
from hyperplanes.fields.base import TargetConfig
from hyperplanes.hypernetwork.hypernetwork import HyperNetworkConfig
from hyperplanes.rendering.renderer import Hierarchical, Marched
from hyperplanes.training import TrainingConfig

__all__ = ["PAPER_SAMPLING", "PRESETS", "PROTOCOLS", "TRAINABLE", "Preset", "configure", "preset"]


PAPER_SAMPLING = Hierarchical(64, 128)
"""The paper's: 64 stratified and 128 importance samples on every ray, no masks (Appendix B)."""

PROTOCOLS: dict[str, Hierarchical | Marched | None] = {"default": None, "paper": PAPER_SAMPLING, "fast": Marched()}
"""How fields are sampled: as the preset or the checkpoint says, as the paper does, or packed where something is."""


@dataclass(frozen=True)
class Preset:
    """A model and its training.

    Attributes:
        model: the architecture.
        training: the procedure.
        resolution: pixels a side of the images it is meant for.
        about: one line for the list of presets.
    """

    model: ModelConfig
    training: TrainingConfig
    resolution: int
    about: str

    def by_protocol(self, name: str) -> Preset:
        """The same model sampled by another protocol.

        Args:
            name: of PROTOCOLS; "fast" leaves a preset that is sampled so already as it is.

        Returns:
            The preset.

        Raises:
            ValueError: an unknown protocol.
        """
        if name not in PROTOCOLS:
            raise ValueError(f"protocol: expected one of {', '.join(PROTOCOLS)}, got {name!r}")
        sampling = PROTOCOLS[name]
        if sampling is None or (name == "fast" and isinstance(self.model.sampling, Marched)):
            return self
        return replace(self, model=replace(self.model, sampling=sampling))

    def by_method(self, method: str) -> Preset:
        """The configuration of a method: HyperPlanes, or a field alone with one set of weights for all objects.

        Raises:
            ValueError: an unknown method, or HyperPlanes of a configuration without a hypernetwork.
        """
        known = [*TRAINABLE, *(name for name in find_targets() if name not in TRAINABLE)]
        if method not in known:
            raise ValueError(f"method: expected one of {', '.join(known)}, got {method!r}")
        if method == "hyperplanes":
            if self.model.hypernetwork is None:
                raise ValueError(
                    "method: expected a configuration with a hypernetwork for hyperplanes, got one without"
                )
            return self
        without = self.without_hypernetwork()
        return replace(without, model=replace(without.model, target=method))

    def without_hypernetwork(self) -> Preset:
        """The same target trained as one set of weights for all objects (PointMultiPlaneNeRF)."""
        return replace(self, model=replace(self.model, hypernetwork=None))


ALL_LAYERS = HyperNetworkConfig(
    normalisation="group", activation="silu", layers=("all",), update="low_rank", weights_seen="all"
)
"""What served best in docs/hypernetwork.md: a low-rank update of every layer, and no batch statistics."""

PAPER_TRAINING = TrainingConfig(steps=100_000, tasks=1, rays=512)
"""One object and 512 rays a step, Adam at 1e-4 for theta and the hypernetwork (Appendix B)."""

PRESETS: dict[str, Preset] = {
    "quick": Preset(
        ModelConfig(
            network=TargetConfig(depth=4, width=128, point_octaves=5, direction_octaves=2),
            hypernetwork=ALL_LAYERS,
            sampling=Marched(steps=64),
            hull_side=64,
        ),
        TrainingConfig(
            steps=1200,
            tasks=4,
            rays=192,
            optimiser="muon",
            learning_rate=3e-3,
            hypernetwork_learning_rate=1.5e-3,
            warmup=100,
            final=0.03,
        ),
        64,
        "64x64, minutes on two cores: what `make demo` trains",
    ),
    "small": Preset(
        ModelConfig(
            network=TargetConfig(depth=6, width=192, point_octaves=6),
            hypernetwork=ALL_LAYERS,
            sampling=Marched(steps=96),
            hull_side=96,
        ),
        TrainingConfig(
            steps=30_000,
            tasks=4,
            rays=256,
            optimiser="muon",
            learning_rate=2e-3,
            hypernetwork_learning_rate=1e-3,
            warmup=500,
            final=0.02,
        ),
        128,
        "128x128, hours on a few cores",
    ),
    "paper-128": Preset(
        ModelConfig(coarse_network=True, sampling=PAPER_SAMPLING),
        PAPER_TRAINING,
        128,
        "the paper's ShapeNet 128x128 setting (Appendix B): ConvNet, 5 HyperPlanes, 64 + 128 samples on every ray",
    ),
    "paper-128-brief": Preset(
        ModelConfig(coarse_network=True),
        TrainingConfig(
            steps=800,
            tasks=4,
            rays=128,
            optimiser="muon",
            learning_rate=5e-4,
            hypernetwork_learning_rate=3e-4,
            warmup=100,
            final=0.02,
            empty_points=64,
            evaluate_every=200,
        ),
        128,
        "the paper's 128x128 networks by the fast protocol, half an hour on one core: what the benchmarks render with",
    ),
    "paper-200": Preset(
        ModelConfig(
            hypernetwork=HyperNetworkConfig(views=25, encoder="resnet101", depth=10),
            coarse_network=True,
            sampling=PAPER_SAMPLING,
        ),
        PAPER_TRAINING,
        200,
        "the paper's ShapeNet 200x200 setting (Appendix B): ResNet101, 25 HyperPlanes, 64 + 128 samples on every ray",
    ),
}


def preset(name: str) -> Preset:
    """The preset of that name.

    Raises:
        ValueError: an unknown name.
    """
    if name not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]


TRAINABLE = ("hyperplanes", "point_multiplane", "multiplane", "nerf")
"""Methods that `train` knows, with the fields of other installed packages; all but the first are one set of weights for
all objects."""


def configure(
    name: str, method: str = "hyperplanes", *, steps: int | None = None, seed: int = 0, protocol: str = "default"
) -> Preset:
    """The configuration of a method at the scale of a preset.

    Args:
        name: of the preset.
        method: one of TRAINABLE, or a field that another installed package brings.
        steps: other than the preset's.
        seed: of the training.
        protocol: a name in PROTOCOLS: how rays are sampled.

    Returns:
        Model and training.

    Raises:
        ValueError: an unknown preset, method or protocol, or no step.
    """
    if steps is not None and steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    chosen = preset(name).by_protocol(protocol).by_method(method)
    return replace(chosen, training=replace(chosen.training, steps=steps or chosen.training.steps, seed=seed))
