"""Describe a data set or a checkpoint, and check it.

For a data set: counts, splits, bounds, skipped objects, whether the poses agree with the masks (OpenCV poses declared
as OpenGL are recognised), and two pictures: a contact sheet, and the cameras around the object. For a single scene also
the sides that its views cover, their overlap, reprojection errors if there is a sparse reconstruction, the worst views,
and the quality to expect, measured with `small` on left-out views. The exit code is 1 if a check fails.

Example:
    hyperplanes inspect data/cars
    hyperplanes inspect data/cars --checksums
    hyperplanes inspect scene          # what `capture` wrote, or photographs that another program has posed
    hyperplanes inspect runs/demo/hyperplanes
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from hyperplanes.commands.options import OptionalFolder
from hyperplanes.commands.output.console import Console
from hyperplanes.utilities.files.reading import MANIFEST

if TYPE_CHECKING:
    from hyperplanes.adaptation.diagnostics import Diagnostics

__all__ = ["Arguments", "baked_lines", "checkpoint_lines", "recorded_diagnostics", "run"]


@dataclass(frozen=True)
class Arguments:
    """What to inspect.

    Attributes:
        path: A data set in any layout, a folder of posed images, a checkpoint, a folder of these such as `demo` writes,
            a baked file, or one of the package: small, small-paper, cars-64, example-car.
        out: Folder for the pictures; runs/inspect/NAME when not given.
        objects: Number of objects to inspect closely.
        checksums: Also compare every file with its checksum in the manifest.
    """

    path: tyro.conf.Positional[Path]
    out: OptionalFolder = None
    objects: int = 8
    checksums: bool = False


def checkpoint_lines(folder: Path) -> list[str]:
    """The content of a checkpoint, one fact per line."""
    from hyperplanes.adaptation.checkpoints import checkpoint_folder
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.hypernetwork import ImageHyperNetworkConfig
    from hyperplanes.utilities.files.checkpoints import read_json
    from hyperplanes.utilities.files.reading import malformed

    folder = checkpoint_folder(folder)
    model = HyperPlanes.from_pretrained(folder)
    config = model.config
    lines = [
        f"target: {config.target}, {config.network.depth} layers of {config.network.width}, "
        f"{config.network.planes} planes, {sum(p.numel() for p in model.networks.parameters()):,} weights",
        f"sampling: {config.sampling}",
    ]
    if config.hypernetwork is not None and model.hypernetwork is not None:
        hyper = config.hypernetwork
        what = (
            f"{hyper.encoder} reads {hyper.views} views, {hyper.update} update of {', '.join(hyper.layers)}"
            if isinstance(hyper, ImageHyperNetworkConfig)
            else "volume reads all views, update of the grid"
        )
        weights = sum(p.numel() for p in model.hypernetwork.parameters())
        lines.append(f"hypernetwork: {what}, {weights:,} weights")
        missing = "not recorded; `hyperplanes train` does, with two held-out objects or more"
        lines.append(f"diagnostics: {recorded_diagnostics(folder) or missing}")
    else:
        lines.append("hypernetwork: none, the same weights for every object")
    if (folder / "training.json").exists():
        with malformed(folder / "training.json", "the state of a training"):
            lines.append(_training_line(read_json(folder / "training.json")))
    return lines


def _training_line(state: dict[str, Any]) -> str:
    looked = [entry["psnr"] for entry in state["curve"] if "psnr" in entry]
    quality = f", {looked[-1]:.2f} dB on held-out objects when last looked at" if looked else ""
    return f"training: {state['step']:,} of {state['config']['steps']:,} steps{quality}"


def baked_lines(path: Path) -> list[str]:
    """The content of a baked file, one fact per line."""
    from hyperplanes.fields.baked import BakedField

    field = BakedField.load(path)
    (x, y, z), radius = field.bounds.centre, field.bounds.radius
    density, rows = field.values[:, 0], len(field.values)
    return [
        f"baked object: {rows:,} of {field.side}^3 voxels, {path.stat().st_size / 2**20:.1f} MiB",
        f"bounds: sphere of radius {radius:.3g} around ({x:.3g}, {y:.3g}, {z:.3g}), y up",
        f"density: {float(density.median()):.3g} a world unit in the median, {float(density.max()):.3g} at most"
        if rows
        else "density: none, the object is empty",
        "`hyperplanes render` and `export` take it as --checkpoint, with --views for the poses",
    ]


def recorded_diagnostics(folder: Path) -> Diagnostics | None:
    """The last diagnostics that the training of a checkpoint recorded beside its weights."""
    from hyperplanes.adaptation.diagnostics import Diagnostics
    from hyperplanes.utilities.files.checkpoints import read_json

    if not (folder / "diagnostics.json").exists():
        return None
    return Diagnostics.of_json(read_json(folder / "diagnostics.json"), folder / "diagnostics.json")


def _is_checkpoint(path: Path) -> bool:
    """Whether this is a checkpoint, or the name of a packaged one."""
    from hyperplanes.adaptation.checkpoints import checkpoint_folder
    from hyperplanes.utilities.files.checkpoints import CheckpointError

    try:
        return (checkpoint_folder(path) / "model.json").exists()
    except CheckpointError:
        return False


def _parts(folder: Path) -> list[Path]:
    """The checkpoints and data sets in a folder such as `demo` writes; empty for a folder that is a data set."""
    if not folder.is_dir() or (folder / MANIFEST).exists():
        return []
    names = ("*/model.json", f"*/{MANIFEST}", f"first/*/{MANIFEST}")
    return sorted({path.parent for name in names for path in folder.glob(name)})


def run(arguments: Arguments) -> int:
    """Describe it; exit code 1 if a check of a data set fails."""
    console = Console()
    if not _is_checkpoint(arguments.path) and (parts := _parts(arguments.path)):
        out, codes = arguments.out or Path("runs/inspect") / arguments.path.resolve().name, []
        for part in parts:
            console.say(f"{part}:")
            inner = part.relative_to(arguments.path)
            codes.append(_inspect(replace(arguments, path=part, out=out / inner), console))
        return max(codes)
    return _inspect(arguments, console)


def _inspect(arguments: Arguments, console: Console) -> int:
    is_baked = arguments.path.suffix == ".safetensors" and arguments.path.is_file()
    if is_baked or _is_checkpoint(arguments.path):
        if arguments.checksums:
            raise ValueError(f"--checksums: expected a data set, got {arguments.path}, a model or a baked file")
        for line in baked_lines(arguments.path) if is_baked else checkpoint_lines(arguments.path):
            console.say(line)
        return 0
    from data_gen.datasets.inspect import inspect
    from hyperplanes.commands.inputs.scene import refuse_sources
    from hyperplanes.data.packaged import locate_scene, remedy_for
    from hyperplanes.utilities.files.reading import DataError

    if not locate_scene(arguments.path).exists():
        raise DataError(
            arguments.path,
            "a data set, posed images, a checkpoint or a baked file, or a model or scene of the package (small, "
            "small-paper, cars-64, example-car)",
            "nothing",
            remedy_for(arguments.path),
        )
    out = arguments.out or Path("runs/inspect") / arguments.path.resolve().name
    refuse_sources(out, arguments.path)
    found = inspect(arguments.path, out, arguments.objects, checksums=arguments.checksums)
    for line in found.lines():
        console.say(line)
    return int(found.has_problems)
