"""Write the weights of one object: theta plus the update that the hypernetwork predicts from a few posed images of it.

The result is a checkpoint without a hypernetwork. `render` and `export` take it like any other checkpoint, together
with the same images, because the field reads its colours from them.

Example:
    hyperplanes adapt --checkpoint small --views scene --out chair-weights --steps 100
    hyperplanes render --checkpoint chair-weights --views scene --out new-views
"""

from __future__ import annotations

from dataclasses import dataclass

from hyperplanes.commands.inputs.fields import adapt_to, load_adaptable, refuse_baked
from hyperplanes.commands.inputs.object_record import record_object
from hyperplanes.commands.inputs.scene import read_object, refuse_sources
from hyperplanes.commands.options import Free, ObjectArguments, check_fine_tune
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.output.writing import refuse_checkpoint, writes_to
from hyperplanes.utilities.messages.shell import command_line

__all__ = ["Arguments", "run"]


@dataclass(frozen=True)
class Arguments(ObjectArguments):
    """The options of `adapt`.

    Attributes:
        fine_tune: What fine-tuning optimises: the weights theta + delta, or the hypernetwork while theta is frozen.
    """

    fine_tune: Free = "weights"


@writes_to(lambda arguments: arguments.out, check=lambda arguments: refuse_sources(arguments.out, arguments.views))
def run(arguments: Arguments) -> int:
    """Adapt and write the weights."""
    from hyperplanes.adaptation.base import AdaptedField
    from hyperplanes.configuration.fine_tuning import FineTuning
    from hyperplanes.data.devices import choose_device

    check_fine_tune(arguments.fine_tune, arguments.steps)
    console, device = Console(), choose_device(arguments.device)
    refuse_baked(arguments.checkpoint, "adapt")
    refuse_checkpoint(arguments.out, arguments.checkpoint)
    model = load_adaptable(arguments.checkpoint, device, reflections=not arguments.no_reflections)
    task, up = read_object(arguments, model, console)
    settings = FineTuning(trainable=arguments.fine_tune)
    field, _ = adapt_to(model, task.support.to(device), task.name, console, steps=arguments.steps, settings=settings)
    assert isinstance(field, AdaptedField)
    model.with_weights_of(field).save(arguments.out)
    record_object(arguments.out, task.name, None if arguments.learn_background else task.support)
    same = [] if (arguments.up, up) == ("auto", "y") else [f"--up={up}"]
    same += ["--all-views"] * arguments.all_views + ["--learn-background"] * arguments.learn_background
    same += ["--refine-poses"] * arguments.refine_poses
    same += [] if arguments.downscale is None else ["--downscale", arguments.downscale]
    given = ["--checkpoint", arguments.out, "--views", arguments.views]
    console.say(f"{arguments.out}: the weights of {task.name}")
    console.say(f"next: {command_line('hyperplanes', 'render', given, same, '--out', 'new-views')}")
    return 0
