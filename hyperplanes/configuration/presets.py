"""Named configurations of models and their training."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from hyperplanes.configuration.initialisation import LEARNED, InitialisationConfig
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.fields import TARGETS, ImageBasedConfig, TargetConfig, find_targets
from hyperplanes.hypernetwork import AutoencoderConfig, ImageHyperNetworkConfig, VolumeHyperNetworkConfig
from hyperplanes.rendering.renderer import Hierarchical, RayMarching
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.messages.errors import did_you_mean

__all__ = ["PAPER_SAMPLING", "PRESETS", "PROTOCOLS", "TRAINABLE", "Preset", "preset"]


PAPER_SAMPLING = Hierarchical(64, 128)
"""The paper's: 64 stratified and 128 importance samples on every ray, no masks (Appendix B)."""

PROTOCOLS: dict[str, Hierarchical | RayMarching | None] = {
    "default": None,
    "paper": PAPER_SAMPLING,
    "ray_marching": RayMarching(),
}
"""Samplers of fields: that of the preset or checkpoint, that of the paper, or packed samples in occupied voxels."""


@dataclass(frozen=True)
class Preset:
    """A model and its training.

    Attributes:
        model: the architecture.
        training: the procedure.
        resolution: pixels a side of the images that it is meant for.
        about: one line for the list of presets.
        initialisation: how initialisations are learned at this scale; its `method` is ignored.
        outer_rate: learning rate of Adam for an initialisation.
        autoencoder: the shape of the autoencoder at this scale.
    """

    model: ModelConfig
    training: TrainingConfig
    resolution: int
    about: str
    initialisation: InitialisationConfig = field(default_factory=InitialisationConfig)
    outer_rate: float = 5e-5
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)

    def by_protocol(self, name: str) -> Preset:
        """The same model with the sampler of another protocol.

        Args:
            name: of PROTOCOLS; "ray_marching" does not change a preset that already uses it.

        Returns:
            The preset.

        Raises:
            ValueError: an unknown protocol.
        """
        if name not in PROTOCOLS:
            raise ValueError(f"protocol: expected one of {', '.join(PROTOCOLS)}, got {name!r}")
        sampling = PROTOCOLS[name]
        if sampling is None or (name == "ray_marching" and isinstance(self.model.sampling, RayMarching)):
            return self
        return replace(self, model=replace(self.model, sampling=sampling))

    def by_method(self, method: str, target: str | None = None) -> Preset:
        """The configuration of a method.

        Args:
            method: of TRAINABLE, or a field of another installed package.
            target: which field; by default that of the preset, or NeRF for learned initialisations.

        Returns:
            The preset of the same scale for that method.

        Raises:
            ValueError: an unknown method or target, HyperPlanes with a configuration without a hypernetwork, or a
                target that contradicts the method.
        """
        targets = find_targets()
        known = [*TRAINABLE, *(name for name in targets if name not in TRAINABLE)]
        if method not in known:
            raise ValueError(f"method: expected one of {', '.join(known)}, got {method!r}{did_you_mean(method, known)}")
        if target is not None and (target not in targets or (method in targets and method != target)):
            expected = repr(method) if method in targets else f"one of {', '.join(targets)}"
            raise ValueError(f"target: expected {expected}, got {target!r}{did_you_mean(target, targets)}")
        chosen = self
        if method in targets:
            chosen, target = self.without_hypernetwork(), method
        elif method == self.model.method:  # its settings are kept
            pass
        elif method == "autoencoder":
            chosen = self.with_autoencoder()
        elif method in LEARNED:
            chosen, target = self.learning_initialisation(method), target or "nerf"
        elif self.model.hypernetwork is None:
            raise ValueError("method: expected a configuration with a hypernetwork for hyperplanes, got one without")
        target = target or chosen.model.target
        if not targets[target].permutation_invariant:
            chosen = chosen.for_known_places()
        return replace(chosen, model=chosen.model.with_target(target))

    def for_known_places(self) -> Preset:
        """The preset without settings that only a field of any number of views supports."""
        alone = {"stacked": False, "gated": False, "learned_steps": 0, "hull_share": 0.0, "symmetric": False}
        model = replace(self.model, **alone, residuals=False, learned_correction=False, symmetry=None, azimuth=None)
        return replace(self, model=model, training=replace(_of_all_views(self.training), volume_loss=0.0))

    def without_hypernetwork(self) -> Preset:
        """The same target trained as one set of weights for all objects (PointMultiPlaneNeRF)."""
        training = replace(self.training, volume_loss=0.0)  # needs a hypernetwork
        model = replace(self.model, hypernetwork=None, autoencoder=None, initialisation=None, learned_steps=0)
        return replace(self, model=model, training=training)

    def with_autoencoder(self) -> Preset:
        """The same target with the code of an encoder as an input, instead of a hypernetwork."""
        plain = self.without_hypernetwork()
        return replace(plain, model=replace(plain.model, autoencoder=self.autoencoder))

    def learning_initialisation(self, method: str) -> Preset:
        """The same target as a learned initialisation: one object per step, Adam on the initialisation, no schedule.

        Args:
            method: one of LEARNED.
        """
        changes: dict[str, int] = {"inner_steps": MAML_STEPS} if method.startswith("maml") else {}
        initialisation = replace(self.initialisation, method=method, **changes)
        plain = self.without_hypernetwork()
        training = replace(
            _of_all_views(plain.training),
            optimiser="adam",
            learning_rate=self.outer_rate,
            random_background=False,
            empty_points=0,
            antialias=False,
        )
        if method == "mv_matched":
            training = replace(training, learning_rate=MATCHING_RATE)
        else:
            training = replace(training, tasks=1, rays=128, warmup=0, final_rate_factor=1.0)
        model = replace(plain.model, initialisation=initialisation, plane_dropout=0.0)
        return replace(plain, model=model, training=training)


def _of_all_views(training: TrainingConfig) -> TrainingConfig:
    """The same training on all support views of unrotated objects, instead of on random subsets."""
    return replace(training, views=(), rotations=0.0)


MAML_STEPS = 4
"""Inner steps of MAML, which keeps the graph of all of them."""

MATCHING_RATE = 1e-3
"""Learning rate of Adam on random weights that are matched to an initialisation."""


ALL_LAYERS = ImageHyperNetworkConfig(
    normalisation="group", activation="silu", layers=("all",), update="low_rank", weights_seen="all"
)
"""The best choice of docs/hypernetwork.md: a low-rank update of every layer, and no batch statistics."""

PAPER_TRAINING = TrainingConfig(steps=100_000, tasks=1, reference_objects=3, rays=512)
"""One object and 512 rays per step, Adam at 1e-4 for theta and the hypernetwork (Appendix B); the HyperPlanes of three
more objects are read for standardisation."""

MUON_TRAINING = TrainingConfig(
    tasks=4,
    rays=256,
    optimiser="muon",
    learning_rate=2e-3,
    hypernetwork_learning_rate=1e-3,
    final_rate_factor=0.02,
)
"""Training of fields of 128x128 in hours on a few cores."""

PRESETS: dict[str, Preset] = {
    "quick": Preset(
        ModelConfig(
            network=TargetConfig(depth=4, width=128, point_frequencies=5, direction_frequencies=2),
            hypernetwork=ALL_LAYERS,
            sampling=RayMarching(steps=64),
            hull_resolution=64,
        ),
        replace(
            MUON_TRAINING,
            steps=1200,
            rays=192,
            learning_rate=3e-3,
            hypernetwork_learning_rate=1.5e-3,
            warmup=100,
            final_rate_factor=0.03,
        ),
        64,
        "64x64, minutes on two cores: what `make demo` trains",
        InitialisationConfig(inner_steps=16, steps=200, test_rays=256),
        outer_rate=1e-3,
    ),
    "small": Preset(
        ModelConfig(
            target="image_based",
            network=ImageBasedConfig(
                depth=4, width=128, planes=8, grid=8, point_frequencies=6, direction_frequencies=2
            ),
            hypernetwork=VolumeHyperNetworkConfig(),
            sampling=RayMarching(steps=64),
            hull_resolution=96,
            stacked=True,
            residuals=True,
            symmetric=True,
        ),
        replace(
            MUON_TRAINING,
            steps=30_000,
            views=(1, 2, 3, 4, 5, 7, 10, 15, 25, 40),
            rotations=0.5,
            random_background=True,
            volume_loss=0.1,
            warmup=300,
        ),
        128,
        "any number of views of any rig, 128x128, hours on a few cores",
    ),
    "small-paper": Preset(
        ModelConfig(
            network=TargetConfig(depth=6, width=192, point_frequencies=6),
            hypernetwork=ALL_LAYERS,
            sampling=RayMarching(steps=96),
            hull_resolution=96,
        ),
        replace(MUON_TRAINING, steps=30_000, warmup=500),
        128,
        "the paper's field of 25 planes with a low-rank update of all layers, 128x128, hours on a few cores",
    ),
    "paper-128": Preset(
        ModelConfig(coarse_network=True, sampling=PAPER_SAMPLING),
        PAPER_TRAINING,
        128,
        "the paper's ShapeNet 128x128 setting (Appendix B): ConvNet, 5 HyperPlanes, 64 + 128 samples on every ray",
    ),
    "paper-128-brief": Preset(
        ModelConfig(coarse_network=True),
        replace(
            MUON_TRAINING,
            steps=800,
            rays=128,
            learning_rate=5e-4,
            hypernetwork_learning_rate=3e-4,
            warmup=100,
            empty_points=64,
            evaluate_every=200,
        ),
        128,
        "the paper's 128x128 networks by ray marching, half an hour on one core: what the benchmarks render with",
    ),
    "paper-200": Preset(
        ModelConfig(
            hypernetwork=ImageHyperNetworkConfig(views=25, encoder="resnet101", depth=10),
            coarse_network=True,
            sampling=PAPER_SAMPLING,
        ),
        PAPER_TRAINING,
        200,
        "the paper's ShapeNet 200x200 setting (Appendix B): ResNet101, 25 HyperPlanes, 64 + 128 samples on every ray",
    ),
}


@checked
def preset(name: str) -> Preset:
    """The preset of that name.

    Raises:
        ValueError: an unknown name.
    """
    if name not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {name!r}{did_you_mean(name, PRESETS)}")
    return PRESETS[name]


TRAINABLE = ("hyperplanes", *reversed(TARGETS), "autoencoder", *LEARNED)
"""Methods that `train` takes, besides the fields of other installed packages; those named as a field have one set of
weights for all objects."""
