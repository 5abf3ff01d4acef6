"""Write the weights of one object: theta plus the update that the hypernetwork makes from a few posed images of it.

The result is a checkpoint without a hypernetwork. `render` and `export` take it like any other, together with the same
images, which the field looks its colours up in.

Example:
    hyperplanes adapt --checkpoint runs/demo --views photos/ --out chair-weights --steps 100
    hyperplanes render --checkpoint chair-weights --views photos/ --out new-views
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from hyperplanes.commands.console import Console
from hyperplanes.commands.options import Free, Steps, Up
from hyperplanes.commands.render import after_steps, read_scene
from hyperplanes.formatting import format_duration

__all__ = ["Arguments", "run"]


@dataclass(frozen=True)
class Arguments:
    """What to adapt to.

    Attributes:
        checkpoint: What `train` or `demo` wrote.
        views: The posed images of the object.
        out: The folder for the weights.
        steps: Fine-tuning steps on the shown views, or auto: as many as show left-out ones best. 0 is the paper's
            single forward pass.
        fine_tune: What fine-tuning optimises: theta + delta itself, or the hypernetwork with theta frozen.
        all_views: Show the model every view, not only the support half.
        up: The axis that points up in the world of the views: y as in training data, z as in Blender.
        device: auto, cpu or cuda.
    """

    checkpoint: Path
    views: Path
    out: Path
    steps: Steps = 0
    fine_tune: Free = "weights"
    all_views: bool = False
    up: Up = "y"
    device: str = "auto"


def run(arguments: Arguments) -> int:
    """Adapt and write the weights."""
    from hyperplanes.files import one_writer

    with one_writer(arguments.out):
        return _run(arguments)


def _run(arguments: Arguments) -> int:
    from hyperplanes.adaptation.fine_tuning import FineTuning
    from hyperplanes.adaptation.pretrained import adapted_model, load_model
    from hyperplanes.devices import choose_device

    console, device = Console(), choose_device(arguments.device)
    model = load_model(arguments.checkpoint).to(device)
    task = read_scene(arguments.views, arguments.all_views, arguments.up)
    started = time.perf_counter()
    settings, taken = FineTuning(free=arguments.fine_tune), []
    field = model.fine_tune(task.support.to(device), arguments.steps, settings, on_step=taken.append)
    seconds = time.perf_counter() - started
    adapted_model(model, field).save(arguments.out)
    how = f"in {format_duration(seconds)}{after_steps(taken)}"
    console.say(f"{arguments.out}: adapted to {len(task.support)} views of {task.name} {how}")
    up = "" if arguments.up == "y" else f" --up {arguments.up}"
    console.say(f"next: hyperplanes render --checkpoint {arguments.out} --views {arguments.views}{up} --out new-views")
    return 0
