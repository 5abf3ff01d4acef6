"""HyperPlanes: a hypernetwork reads a few posed images of an object and predicts the weights of a NeRF.

This is the public API. A name is imported on first use, so `import hyperplanes` is fast:

    import hyperplanes as hp

    model = hp.HyperPlanes.from_pretrained("cars-64")
    task = hp.read_task("example-car")
    field = model.adapt(task.support)
    pictures = field.render(task.query.cameras)
    hp.save_images(pictures.images, "new_views")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hyperplanes.utilities.machine.threads import wait_passively

if TYPE_CHECKING:
    from hyperplanes.adaptation.baselines.nearest_view import NearestView
    from hyperplanes.adaptation.fine_tuned import FineTuned
    from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
    from hyperplanes.configuration.fine_tuning import FineTuning
    from hyperplanes.configuration.presets import preset
    from hyperplanes.data import DataError, Dataset, open_dataset, read_task, read_views
    from hyperplanes.evaluation import evaluate
    from hyperplanes.export.images import save_images, save_turntable
    from hyperplanes.export.surfaces.mesh import extract_mesh, save_mesh
    from hyperplanes.geometry import ImagePlanes, Lookup
    from hyperplanes.rendering.renderer import render
    from hyperplanes.training import Trainer
    from hyperplanes.utilities.files.checkpoints import CheckpointError
    from hyperplanes.utilities.files.writing import WriteError
    from hyperplanes.utilities.images.metrics import psnr, ssim
    from hyperplanes.views import Task, Views

wait_passively()  # must run before PyTorch is loaded

_HOMES = {
    "CheckpointError": "utilities.files.checkpoints",
    "DataError": "data",
    "Dataset": "data",
    "FineTuned": "adaptation.fine_tuned",
    "FineTuning": "configuration.fine_tuning",
    "HyperPlanes": "adaptation.hyperplanes",
    "ImagePlanes": "geometry",
    "Lookup": "geometry",
    "ModelConfig": "adaptation.hyperplanes",
    "NearestView": "adaptation.baselines.nearest_view",
    "Task": "views",
    "Trainer": "training",
    "Views": "views",
    "WriteError": "utilities.files.writing",
    "evaluate": "evaluation",
    "extract_mesh": "export.surfaces.mesh",
    "open_dataset": "data",
    "preset": "configuration.presets",
    "psnr": "utilities.images.metrics",
    "read_task": "data",
    "read_views": "data",
    "render": "rendering.renderer",
    "save_images": "export.images",
    "save_mesh": "export.surfaces.mesh",
    "save_turntable": "export.images",
    "ssim": "utilities.images.metrics",
}

__all__ = [
    "CheckpointError",
    "DataError",
    "Dataset",
    "FineTuned",
    "FineTuning",
    "HyperPlanes",
    "ImagePlanes",
    "Lookup",
    "ModelConfig",
    "NearestView",
    "Task",
    "Trainer",
    "Views",
    "WriteError",
    "evaluate",
    "extract_mesh",
    "open_dataset",
    "preset",
    "psnr",
    "read_task",
    "read_views",
    "render",
    "save_images",
    "save_mesh",
    "save_turntable",
    "ssim",
]


def __getattr__(name: str) -> Any:
    """A public name, imported on first use, or `__version__`."""
    if name == "__version__":
        from importlib.metadata import version

        return version("hyperplanes")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """The public names, and those that every module has."""
    return sorted([*__all__, *(name for name in globals() if name.startswith("__")), "__version__"])
