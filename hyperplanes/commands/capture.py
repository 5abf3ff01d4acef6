"""Turn photographs or a video of an object into a scene for the other verbs, with camera poses, masks and up direction.

This needs the extra `photos`: pip install 'hyperplanes[photos]'. To resume an interrupted capture, run the same command
again.

Example:
    hyperplanes capture photos/ --out scene
    hyperplanes render --checkpoint small --views scene --all-views --orbit 48 --out turntable
    hyperplanes capture walk.mp4 --frames 80 --out scene
    hyperplanes capture photos/ --mask "rembg i {image} {mask}" --out scene
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from hyperplanes.commands.options import Exists, OptionalInt
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.output.writing import writes_to
from hyperplanes.utilities.messages.formatting import format_duration
from hyperplanes.utilities.messages.shell import command_line

if TYPE_CHECKING:
    from hyperplanes.commands.output.console import Bar

__all__ = ["Arguments", "run"]

RESUMES = True  # the same command continues an interrupted one


@dataclass(frozen=True)
class Arguments:
    """The options of `capture`.

    Attributes:
        photographs: A folder of photographs, which may contain a folder masks/, or a video.
        out: The folder for the scene: images/, masks/ and transforms.json in nerfstudio's layout.
        mask: How the object is found in the images: auto, given (alpha, or masks/ beside them), colour (in front of a
            plain background), network, grabcut, none, or a command that contains {image} and {mask}.
        size: Most pixels along the longer side of the images.
        order: Which photographs are matched. sequence: neighbours, as in a video. any: all pairs. auto: neighbours for
            a video and for many photographs, otherwise all pairs.
        frames: Frames that are taken from a video, 60 if not given.
    """

    photographs: Annotated[
        tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOGRAPHS"), Exists("a folder of photographs, or a video")
    ]
    out: Path
    mask: Annotated[str, tyro.conf.arg(metavar="{auto,given,colour,network,grabcut,none,COMMAND}")] = "auto"
    size: Annotated[int, range(64, 1 << 16)] = 1000
    order: Literal["auto", "sequence", "any"] = "auto"
    frames: Annotated[OptionalInt, range(3, 1 << 16)] = None


@writes_to(lambda arguments: arguments.out)
def run(arguments: Arguments) -> int:
    """Find poses and masks, write the scene, and print what was found and what was left out."""
    from hyperplanes.capture import Settings, capture
    from hyperplanes.capture.pipeline import VIDEO_FRAMES

    console, started = Console(), time.perf_counter()
    if arguments.frames is not None and arguments.photographs.is_dir():
        found = f"the folder {arguments.photographs}, whose photographs are all used"
        raise ValueError(f"--frames: expected a video, got {found}; leave it out")
    settings = Settings(arguments.size, arguments.mask, arguments.frames or VIDEO_FRAMES, arguments.order)
    with ExitStack() as stack:
        shown: tuple[str, Bar] | None = None

        def progress(stage: str, done: int, total: int, text: str) -> None:
            nonlocal shown
            if shown is None or shown[0] != stage:  # a stage comes again if photographs are tried a second time
                stack.close()
                shown = stage, stack.enter_context(console.bar(stage))
            shown[1].show(done, total, text, important=done == 0)

        captured = capture(arguments.photographs, arguments.out, settings, progress)
    for note in captured.notes:
        console.warn(f"{arguments.photographs}: {note}")
    console.say(
        f"poses: {captured.count} photographs, {captured.points:,} points, {captured.error:.2f} pixels mean error"
    )
    console.say(f"masks: {captured.mask}")
    console.say(f"up: by {captured.up_from}")
    console.say(f"{captured.folder}: a scene, in {format_duration(time.perf_counter() - started)}; for a turntable:")
    given = ["--checkpoint", "small", "--views", captured.folder, "--all-views", "--orbit", 48]
    given += ["--out", captured.folder / "turntable"] + ["--learn-background"] * (captured.mask == "none")
    console.say(f"  {command_line('hyperplanes', 'render', given)}")
    return 0
