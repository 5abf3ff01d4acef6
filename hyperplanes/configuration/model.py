"""The configuration of a model, written to files, and read from files that need not be trusted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from hyperplanes.configuration.initialisation import InitialisationConfig
from hyperplanes.fields import TargetConfig, find_targets
from hyperplanes.geometry.symmetry.reflections import Symmetry
from hyperplanes.hypernetwork import KINDS, AutoencoderConfig, HyperNetworkConfig, ImageHyperNetworkConfig
from hyperplanes.rendering.renderer import Hierarchical, RayMarching
from hyperplanes.utilities.files.checkpoints import CheckpointError, read_json
from hyperplanes.utilities.files.settings import SettingsError, choose_by_tag, flattened, structure, tagged
from hyperplanes.utilities.messages.arguments import checked_fields

__all__ = ["ModelConfig"]

SAMPLERS = {"hierarchical": Hierarchical, "ray_marching": RayMarching}
"""Samplers by the entry `protocol`."""

choose_by_tag(Hierarchical | RayMarching, "protocol", SAMPLERS)
choose_by_tag(HyperNetworkConfig | None, "kind", KINDS)


@checked_fields
@dataclass(frozen=True)
class ModelConfig:
    """The configuration of a model; saved with its weights.

    Attributes:
        target: which field: a name of `fields.find_targets()`.
        network: the shape of the target, in the dataclass of the field (`Target.config_type`).
        hypernetwork: the shape of the hypernetwork, which reads images or a volume; None for one set of weights for all
            objects.
        autoencoder: the shape of an encoder whose code the target reads, instead of a hypernetwork.
        initialisation: how the weights are learned as an initialisation, if they are.
        coarse_network: whether a second network of the same shape proposes samples (NeRF's coarse network).
        sampling: default sampler of fields, also in training.
        hull_resolution: voxels an axis of the visual hull; a field of any number of views uses up to 192 for larger
            images.
        order: which support view becomes which plane: the one "matched" to its camera direction in training, or views
            in the order of the "file", as in the paper.
        plane_dropout: probability that a training step masks a plane of an object, for a field with a fixed number of
            planes. With fewer views than planes, each view is then used for one plane and the other planes are masked,
            instead of filled with views from elsewhere.
        stacked: whether pictures of a field of any number of views are averaged with those of `hull_blend`. Of five or
            more views, some are held out to decide the share (`adaptation.correction.stacking`). Not used in training.
        hull_share: of `hull_blend` in pictures of a model that is not `stacked`, as decided for one object.
        gated: whether a gating network turns that share into one for each pixel (`adaptation.gating`);
            `training.gating` trains it after the model. With ten given views or more it also adds the hull to pictures
            after gradient steps.
        average: share, in pictures, of the field before gradient steps, in a model that these made for one object
            (`stacking.average`).
        fine_tuned: whether gradient steps made the model for one object; then the share of the correction network is
            found by cross-validation (`correction.residuals.ResidualField.network_share`).
        learned_steps: steps of gradient descent by a network after the forward pass
            (`adaptation.optimisation.learned_steps`), half as many from twenty views on; `training.learned_step`
            trains it after the model.
        residuals: whether pictures from three views or more, unless these are large, are corrected by the residuals of
            the views (`adaptation.correction.residuals`).
        learned_correction: whether a network computes this correction (`adaptation.correction_network`);
            `training.correction` trains it after the model.
        symmetric: whether reflections of the views of an object that looks symmetric are added to its views
            (`adaptation.symmetry.detection`). Not used in training.
        symmetry: of the object, if it is known.
        azimuth: rotation of the object to its canonical frame, in radians, if it is known. Otherwise a `symmetric`
            model looks for it (`adaptation.alignment.canonical_frame`).
    """

    target: str = "point_multiplane"
    network: TargetConfig = field(default_factory=TargetConfig)
    hypernetwork: HyperNetworkConfig | None = field(default_factory=ImageHyperNetworkConfig)
    autoencoder: AutoencoderConfig | None = None
    initialisation: InitialisationConfig | None = None
    coarse_network: bool = False
    sampling: Hierarchical | RayMarching = field(default_factory=RayMarching)
    hull_resolution: Annotated[int, range(1, 513)] = 64
    order: Literal["matched", "file"] = "matched"
    plane_dropout: float = 0.0
    stacked: bool = False
    hull_share: float = 0.0
    gated: bool = False
    average: float = 0.0
    fine_tuned: bool = False
    learned_steps: Annotated[int, range(33)] = 0
    residuals: bool = False
    learned_correction: bool = False
    symmetric: bool = False
    symmetry: Symmetry | None = None
    azimuth: float | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.plane_dropout < 1:
            raise ValueError(f"plane_dropout: expected a probability from 0 to below 1, got {self.plane_dropout}")
        for name in ("hull_share", "average"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected a share from 0 to 1, got {getattr(self, name)}")
        if self.azimuth is not None and not math.isfinite(self.azimuth):
            raise ValueError(f"azimuth: expected a finite angle in radians, got {self.azimuth}")
        if self.stacked and self.hull_share:
            raise ValueError(f"hull_share: expected 0 for a stacked model, which finds it, got {self.hull_share}")
        chosen = [name for name in ("hypernetwork", "autoencoder", "initialisation") if getattr(self, name) is not None]
        if len(chosen) > 1:
            raise ValueError(f"model: expected at most one way to find weights, got {' and '.join(chosen)}")

    @property
    def method(self) -> str:
        """The name of the method of such a model: "hyperplanes", "autoencoder", "mv_meta", "nerf" and so on."""
        if self.hypernetwork is not None:
            return "hyperplanes"
        if self.autoencoder is not None:
            return "autoencoder"
        return self.target if self.initialisation is None else self.initialisation.method

    def with_target(self, name: str) -> ModelConfig:
        """The same model with another field; settings of the shape that both fields have are kept."""
        kind = find_targets()[name].config_type
        shared = {each.name for each in fields(kind)} & {each.name for each in fields(self.network)}
        network = kind(**{name: getattr(self.network, name) for name in shared})
        return replace(self, target=name, network=network)

    def target_alone(self) -> ModelConfig:
        """The model of its target alone, without a network that finds weights and without averaged pictures."""
        alone = replace(self, hypernetwork=None, autoencoder=None, initialisation=None)
        averaging = {"stacked": False, "hull_share": 0.0, "gated": False, "average": 0.0}
        return replace(alone, **averaging, learned_steps=0, learned_correction=False, fine_tuned=False)

    def as_json(self) -> dict[str, Any]:
        """A JSON object from which `of_json` makes the same configuration."""
        sampling = tagged(self.sampling, "protocol", SAMPLERS) or {}
        protocol = sampling.pop("protocol")
        hypernetwork = tagged(self.hypernetwork, "kind", KINDS)
        return {**asdict(self), "hypernetwork": hypernetwork, "sampling": sampling, "protocol": protocol}

    @classmethod
    def of_json(cls, value: Mapping[str, Any], where: Path | str = "configuration") -> ModelConfig:
        """The configuration that `as_json` wrote. Entries with defaults may be missing.

        Args:
            value: content of a file.
            where: the file, for the message.

        Returns:
            A configuration with all numbers in their ranges.

        Raises:
            CheckpointError: an unknown or missing entry, one of a wrong type or out of range, or a field that no
                installed package has.
        """
        target, known = value.get("target"), find_targets()
        if isinstance(target, str) and target not in known:
            raise CheckpointError(
                f"{where}: target: expected one of {', '.join(known)}, got {target!r}; install the package that adds it"
            )
        try:
            return cls.structured(value)
        except SettingsError as error:
            raise CheckpointError(
                f"{where}: expected the entries of this version's models, found others ({error}); "
                "copy the file again, or train again with this version"
            ) from None

    @classmethod
    def structured(cls, value: Mapping[str, Any]) -> ModelConfig:
        """As `of_json`; SettingsError names the entry that does not fit."""
        for name in ("network", "sampling", "hypernetwork", "protocol"):
            if name not in value:
                raise SettingsError(name, "a missing entry")
        entries = {name: entry for name, entry in value.items() if name not in ("network", "protocol")}
        if isinstance(entries["sampling"], Mapping):
            entries["sampling"] = {**entries["sampling"], "protocol": value["protocol"]}
        made = structure(cls, entries)

        # the field determines the dataclass of its shape
        known = find_targets()
        kind = known[made.target].config_type if made.target in known else TargetConfig
        return replace(made, network=structure(kind, value["network"], "network"))

    @classmethod
    def load(cls, folder: Path) -> ModelConfig:
        """The configuration of a checkpoint; CheckpointError where model.json is missing or does not fit."""
        return cls.of_json(read_json(folder / "model.json"), folder / "model.json")

    def differences(self, other: ModelConfig) -> list[str]:
        """The names of the entries in which two models differ, such as "sampling.steps"."""
        mine, others = flattened(self.as_json()), flattened(other.as_json())
        return sorted(name for name in mine | others if mine.get(name, ...) != others.get(name, ...))
