"""HyperPlanes: a target network, and the hypernetwork that predicts its update from a few support views."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import torch

from hyperplanes.adaptation.alignment.canonical_frame import to_canonical_frame
from hyperplanes.adaptation.alignment.finding_symmetry import find_symmetry
from hyperplanes.adaptation.alignment.rotation import RotatedField
from hyperplanes.adaptation.base import AdaptedField, masks_problem
from hyperplanes.adaptation.checkpoints import read_checkpoint, write_checkpoint
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.correction.residuals import corrected_field
from hyperplanes.adaptation.correction.stacking import learned_part, stacked_field
from hyperplanes.adaptation.fine_tuning import fine_tune
from hyperplanes.adaptation.hub import upload_checkpoint
from hyperplanes.adaptation.network import HyperPlanesNetwork
from hyperplanes.adaptation.optimisation.learned_steps import updated_weights
from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.geometry.inputs import check_precision
from hyperplanes.geometry.symmetry.reflections import Symmetry
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.gradients import with_gradients
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.views import Views

__all__ = ["HyperPlanes", "ModelConfig"]


class HyperPlanes(HyperPlanesNetwork):
    """theta, the hypernetwork that updates it, and the rig of support views it was trained with.

    Without a hypernetwork all objects share the same weights: the plain target network that the paper compares with.
    Views are moved to the device of the weights.

    Args:
        config: the architecture.
        seed: of the weights; the global random state is not used.

    Raises:
        ValueError: incompatible parts (`configuration.compatibility`).
    """

    def without_reflections(self) -> Self:
        """A model with the same weights that uses no reflections of the views of an object that looks symmetric."""
        return self._configured(symmetric=False, symmetry=None)

    def without_residuals(self) -> Self:
        """A model with the same weights without residual correction of its pictures (`correction.residuals`)."""
        result = self._configured(residuals=False, learned_correction=False)
        result.corrector = None
        return result

    def _configured(self, **changes: Any) -> Self:
        """A model that shares the weights of this one and has another configuration."""
        result = copy(self)
        for parts in ("_modules", "_parameters", "_buffers"):  # so that a part set to None stays in this model
            result.__dict__[parts] = dict(self.__dict__[parts])
        result.config = replace(self.config, **changes)
        return result

    @checked
    @without_autocast
    @torch.inference_mode(mode=False)  # learned steps read gradients
    @torch.no_grad()
    def adapt(self, support: Views) -> AdaptedField:
        """The field of one object in one forward pass: theta + delta (HyperPlanes, Eq. 6).

        Then come `config.learned_steps` steps of gradient descent by a network (`optimisation.learned_steps`). With
        `config.symmetric`, reflections of the views of an object that looks symmetric are added to its views
        (`symmetry.detection`), and it is adapted to in its canonical frame (`alignment.canonical_frame`). With
        `config.stacked`, pictures are averaged with those of the visual hull (`correction.stacking`). With
        `config.residuals`, pictures are corrected by the residuals of the support views (`correction.residuals`).

        Repeated calls give the same field. The order of the views changes it a little, because learned steps draw rays
        and views by position: pictures of two orders agree to 38 to 40 dB (docs/image-based.md).

        A UserWarning is issued if the views have no masks and the hypernetwork reads a volume, which needs masks.
        """
        self._warn_without_masks(support)
        placed = to_canonical_frame(self, support)
        context = placed.context(self)
        adapted = stacked_field(self, context, updated_weights(self, context))
        return corrected_field(self, placed.in_scene(adapted), support)

    def _warn_without_masks(self, support: Views) -> None:
        """Issue a UserWarning about missing masks if the hypernetwork reads a volume, which is made with masks."""
        if self.reads_volume and (problem := masks_problem(support)):
            warnings.warn(problem, stacklevel=2)

    @checked
    @without_autocast
    def find_symmetry(self, support: Views) -> Symmetry | None:
        """The symmetry by which the views of an object are reflected, if `config.symmetric` is set.

        Args:
            support: the views of one object.

        Returns:
            `config.symmetry` if that is known. Otherwise the planes about which the object looks symmetric
            (`symmetry.symmetry_of`), or None. A single view is reflected about several planes if its silhouette and
            colours show them, and about one if the model renders the view itself better with it.
        """
        return find_symmetry(self, support)

    @without_autocast
    @torch.inference_mode(mode=False)
    @torch.no_grad()
    def adapt_to(self, context: SupportContext) -> AdaptedField:
        """As `adapt`, of a prepared object, with or without reflections of its views."""
        return corrected_field(self, stacked_field(self, context, updated_weights(self, context)), context.given)

    @checked
    @without_autocast
    @with_gradients
    def fine_tune(
        self,
        support: Views,
        steps: Steps,
        settings: FineTuning | None = None,
        *,
        on_step: Callable[[int], None] | None = None,
        on_trial: Callable[[int], None] | None = None,
    ) -> AdaptedField:
        """The field of one object after gradient steps on its support views; the model itself stays as it is.

        The steps begin at theta + delta, interpolated with random weights by `settings.fresh`. They optimise either
        these weights or, as in the paper, a copy of the hypernetwork while theta is frozen (HyperPlanes, section 3,
        fine-tuning). Zero steps give the field of `adapt`. From 20 views on, the grid of features gets more cells
        (`settings.cells`). From three views on, pictures are corrected as those of `adapt` are, but the share of the
        correction network is found by cross-validation (`ResidualField.network_share`). With fewer than ten
        views they are averaged with those of the field before the steps (`settings.average`). With more, if the model
        does not correct them (`without_residuals`, or large views) but has a gating network, they are averaged with
        those of the visual hull (`stacking.tuned_field`).

        Args:
            support: the views of the object.
            steps: gradient steps on rays of the support views, or "auto": the number, up to `settings.max_steps`, that
                is best for held-out support views; 0 if all steps make these worse.
            settings: what is optimised, rates, rays and seed.
            on_step: called with the number of steps done, before the first and after each.
            on_trial: the same for the trial steps of "auto", of which there are up to `settings.max_steps`.

        Returns:
            The field. A UserWarning as that of `adapt`. Raises ValueError for steps that are impossible: on a
            hypernetwork that the model does not have, a negative number, "auto" with fewer than 3 views, or on a single
            view of a field that takes any number of them, unless `settings.mask_views` is off. Raises NoProgressError,
            a ValueError with the final field, if the steps do not lower the error. Raises RuntimeError inside
            `torch.inference_mode`.
        """
        self._warn_without_masks(support)
        return fine_tune(self, support, steps, settings, on_step=on_step, on_trial=on_trial)

    def with_weights_of(self, adapted: AdaptedField) -> HyperPlanes:
        """The weights of one object as a model without a hypernetwork: its theta is theta + delta (HyperPlanes, Eq. 6).

        Args:
            adapted: the field that this model made of the object.

        Returns:
            A model that makes the same field from the same views, with symmetry, frame and hull share fixed.

        Raises:
            ValueError: a field of another model.
        """
        adapted = adapted.without_residuals()
        learned = learned_part(adapted)
        beside = {"hull_share": learned.share, "gated": learned.gate is not None, "average": learned.average}
        azimuth = -adapted.rotation.angle if isinstance(adapted, RotatedField) else 0.0
        beside |= {
            "learned_correction": self.config.learned_correction,
            "fine_tuned": adapted.fine_tuned,
            "symmetric": False,
            "symmetry": adapted.symmetry,
            "azimuth": azimuth,
        }
        found = {"fine": learned.field.field, "coarse": learned.field.proposal}
        shape = self.target.config_of(self.target.parameters_of(found["fine"]))
        result = HyperPlanes(replace(self.config.target_alone(), network=shape, **beside)).to(self.rig)
        if result.gate is not None and learned.gate is not None:
            result.gate.load_state_dict(learned.gate.state_dict())
        if result.corrector is not None and self.corrector is not None:
            result.corrector.load_state_dict(self.corrector.state_dict())
        result.rig.copy_(self.rig)
        pairs = [(network, found[name]) for name, network in result.targets.items()]
        if learned.before is not None:
            earlier = {"fine": learned.before.field, "coarse": learned.before.proposal}
            pairs += [(network, earlier[name]) for name, network in result.targets_before.items()]
        for network, values in pairs:
            try:
                network.load_state_dict(network.parameters_of(values))
            except RuntimeError as error:
                raise ValueError(f"adapted: expected a field of this model, got {adapted!r}") from error
        return result.eval()

    @checked
    def save(self, folder: Path | str, dtype: torch.dtype | None = None) -> None:
        """Write model.json and model.safetensors.

        Args:
            folder: created if absent.
            dtype: of the weights in the file, such as float16, which halves it; by default their own. Buffers keep
                their dtype, and `from_pretrained` converts all to float32.
        """
        check_precision(dtype)
        weights = self.state_dict()
        if dtype is not None:
            weights |= {name: value.to(dtype) for name, value in self.named_parameters()}
        write_checkpoint(folder, self.config, weights)

    save_pretrained = save

    def push_to_hub(self, repository: str, *, private: bool = False, message: str = "Upload of a model") -> str:
        """Write the model to a repository of the Hugging Face hub, from which `from_pretrained` reads it.

        Args:
            repository: user/model; created if absent.
            private: for a repository that is created.
            message: of the commit.

        Returns:
            The address of the commit. Raises ValueError for a name of another form, and RuntimeError if huggingface_hub
            is not installed.
        """
        return upload_checkpoint(self.save, repository, private=private, message=message)

    @classmethod
    @checked
    def from_pretrained(cls, name: Path | str) -> HyperPlanes:
        """The model that `save` wrote.

        Args:
            name: its folder, the name of a model that comes with the package, or user/model on the Hugging Face hub
                if huggingface_hub is installed; a folder of that name takes precedence.

        Returns:
            The model, in evaluation mode. Raises DataError if it is missing, damaged or does not fit.
        """
        return read_checkpoint(name, cls)
