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
from hyperplanes.commands.options import Up
from hyperplanes.commands.render import read_scene
from hyperplanes.words import duration

__all__ = ["Arguments", "run"]


@dataclass(frozen=True)
class Arguments:
    """What to adapt to.

    Attributes:
        checkpoint: What `train` or `demo` wrote.
        views: The posed images of the object.
        out: The folder for the weights.
        steps: Fine-tuning steps on the shown views; none is the paper's single step.
        all_views: Show the model every view, not only the support half.
        up: The axis that points up in the world of the views: y as in training data, z as in Blender.
        device: auto, cpu or cuda.
    """

    checkpoint: Path
    views: Path
    out: Path
    steps: int = 0
    all_views: bool = False
    up: Up = "y"
    device: str = "auto"


def run(arguments: Arguments) -> int:
    """Adapt and write the weights."""
    from hyperplanes.models import adapt, adapted_model, choose_device, load_model

    console, device = Console(), choose_device(arguments.device)
    model = load_model(arguments.checkpoint).to(device)
    task = read_scene(arguments.views, arguments.all_views, arguments.up)
    started = time.perf_counter()
    field = adapt(model, task.support.to(device), arguments.steps)
    seconds = time.perf_counter() - started
    adapted_model(model, field).save(arguments.out)
    console.say(f"{arguments.out}: adapted to {len(task.support)} views of {task.name} in {duration(seconds)}")
    up = "" if arguments.up == "y" else f" --up {arguments.up}"
    console.say(f"next: hyperplanes render --checkpoint {arguments.out} --views {arguments.views}{up} --out new-views")
    return 0
