"""The checkpoints of a training: when the first is read, and which are written."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from hyperplanes.adaptation.diagnostics import Diagnostics
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.training.episodes import EpisodeLoader
from hyperplanes.training.optimisation import Optimisation
from hyperplanes.training.state import Curve, check_model, check_whole, load_state, save_state
from hyperplanes.utilities.checkpoints import read_json
from hyperplanes.utilities.environment import has_fast_bfloat16
from hyperplanes.utilities.writing import write_json

__all__ = ["Checkpointing", "choose_precision"]

MAY_DIFFER = ("steps", "epochs", "evaluate_every", "held_out", "checkpoint_every", "keep_last", "memory", "prefetch")
"""Settings that may be others in a training that is resumed."""


def choose_precision(config: TrainingConfig, model: HyperPlanes, folder: Path | None) -> str:
    """What `config.precision` "automatic" is: what the training in the folder began with, or what is fast and exact.

    Args:
        config: of the training.
        model: that is trained.
        folder: of the training.

    Returns:
        "single" or "bfloat16".
    """
    if config.precision != "automatic":
        return config.precision
    if folder is not None and (folder / "training.json").exists():
        before = read_json(folder / "training.json").get("config")
        found = before.get("precision") if isinstance(before, dict) else None
        if found in ("single", "bfloat16"):  # others are refused where the state is read
            return found
    suits = model.reads_volume and model.rig.device.type == "cpu" and has_fast_bfloat16()
    return "bfloat16" if suits else "single"


class Checkpointing:
    """Reads and writes the state of one training.

    Args:
        folder: of the training; without one, nothing is read or written.
        model: that is trained.
        optimisation: its optimisers.
        config: of the training.
        writes: whether this process is the one that writes.

    Raises:
        CheckpointError: the folder holds another model, or weights without the state of their training.
    """

    def __init__(
        self, folder: Path | None, model: HyperPlanes, optimisation: Optimisation, config: TrainingConfig, writes: bool
    ) -> None:
        self.folder, self.model, self.optimisation, self.config = folder, model, optimisation, config
        self._writes = writes and folder is not None
        if folder is not None:
            check_model(folder, model.config)
            check_whole(folder)

    @property
    def resumable(self) -> bool:
        """Whether there is a state to go on from."""
        return self.folder is not None and (self.folder / "training.json").exists()

    def resume(self, loader: EpisodeLoader) -> tuple[int, Curve]:
        """Set weights and optimisers to the last state, if there is one.

        Args:
            loader: of the objects, which are to be those that the training began with.

        Returns:
            The steps done, and the curve. DataError where the state is that of another training, or damaged.
        """
        if self.folder is None or not self.resumable:
            return 0, []
        optimisers, data = self.optimisation.optimisers, loader.fingerprint
        step, curve = load_state(self.folder, self.model, optimisers, asdict(self.config), MAY_DIFFER, data)
        if self._writes and not (self.folder / "model.safetensors").exists():
            self.model.save(self.folder)  # of a first checkpoint that was killed before it
        return step, curve

    def save(self, step: int, curve: Curve, diagnostics: Diagnostics | None, loader: EpisodeLoader) -> None:
        """Write model and state, whole or not at all.

        Args:
            step: steps done.
            curve: so far.
            diagnostics: of the last validation.
            loader: of the objects.
        """
        if self._writes and self.folder is not None:
            if diagnostics is not None:
                write_json(self.folder / "diagnostics.json", diagnostics.as_json())
            config, data = asdict(self.config), loader.fingerprint
            save_state(self.folder, self.model, self.optimisation.optimisers, step, curve, config, data)

    def save_best(self) -> None:
        """Write the model as the one with the highest PSNR so far."""
        if self._writes and self.folder is not None:
            self.model.save(self.folder / "best")
