"""Render meshes into a data set of posed images, with any number of cameras per object.

The meshes are procedural (--class, any number of objects) or yours (--meshes, a folder with GLB, glTF, OBJ, PLY, STL,
OFF or DAE files at any depth). An object that cannot be drawn is skipped with a warning and listed in the data set's
manifest. After an interruption, the same command resumes and gives the same bytes.

Example:
    hyperplanes generate --class car --count 70 --resolution 64 --seed 0 --out data/cars
    hyperplanes generate --meshes my-models --up z --resolution 128 --out data/mine
    hyperplanes generate --meshes ShapeNetCore.v2 --split-file all.csv --rig paper-128 --out data/shapenet
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from data_gen import SUPERSAMPLE
from hyperplanes.commands.options import (
    Exists,
    OptionalFile,
    OptionalFolder,
    OptionalInt,
    OptionalName,
    OptionalNumber,
    optional,
)
from hyperplanes.commands.output.console import Console
from hyperplanes.utilities.messages.formatting import counted, format_duration

if TYPE_CHECKING:
    from data_gen.datasets.generate import GenerationReport, MeshFolder, Procedural

__all__ = ["Arguments", "remarks", "run", "source_of", "summary"]

BROUGHT = {"Classes": "data_gen.shapes"}
"""Entry point groups whose names are classes."""

RESUMES = True  # the same command continues an interrupted one


@dataclass(frozen=True)
class Arguments:
    """What to render.

    Attributes:
        out: The folder to write: new, empty, or one in which the same command was interrupted.
        class_name: Procedural objects of this class: car, chair, plane, lamp, or random (arbitrary compositions of
            primitives); or a class of another installed package.
        meshes: A folder of mesh files, instead of --class.
        meshes_class: Class of the meshes, if their tree does not state it; some layouts name folders by it.
        count: Number of procedural objects, including the held-out ones; 70 when not given.
        seed: Seed of procedural shapes and of random rigs and lights.
        resolution: Pixels along a side of the square images; when not given, 200 in the layout hyperplanes-200, else
            that of the rig's data set, else 64.
        views: Cameras per object, alternately support and query; when not given, that of the rig's data set, else 50.
        held_out: Objects of each class for the test split: a count, or a fraction below 1. When not given, a seventh;
            for mesh files the split that their tree states, else a fifth.
        rig: Camera positions: the same for all objects, random, a circle, a spiral, or as in one of the paper's two
            data sets or SRN's, with its distance, lens and resolution.
        distance: Distance of the cameras from the object's centre, in radii of the object; when not given, that of the
            layout or the rig's data set, else 3.
        field_of_view: Field of view of the cameras in degrees; when not given, that of the layout or the rig's data
            set, at any distance, else such that the object just fits.
        lighting: Lights: fixed in the world (studio), at the camera (headlight), or random for each object.
        layout: Layout of the files: native, or that of another project's loader.
        up: The axis that points up in OBJ, PLY, STL and OFF files, which do not state it; in glTF it is y, and COLLADA
            declares its own.
        up_of: Exceptions, for files of any format: a file, a folder or a pattern, and its axis: scans=z 'old/*.glb=z'.
        split_file: ShapeNet's official all.csv, which assigns the models of the tree to splits.
        channels: Channels to write for every view; more than rgba needs the native layout.
        workers: Number of processes; one per core when not given.
        engine: Worker processes of this machine, or a Ray cluster.
        timeout: Seconds that an object may take; slower ones are skipped with a warning.
        supersample: Samples along a side of a pixel, each of them shaded.
        renderer: pyrender-egl, pyrender-osmesa or embree; when not given, the best that works here.
        verify: Compare all files with their checksums at the end; files of an interrupted call always are.
    """

    out: Path
    class_name: Annotated[str | None, optional("NAME", name="class")] = None
    meshes: Annotated[OptionalFolder, Exists("a folder of meshes", "give the folder", folder=True)] = None
    meshes_class: Annotated[str | None, optional("NAME", name="class-name")] = None
    count: OptionalInt = None
    seed: int = 0
    resolution: OptionalInt = None
    views: OptionalInt = None
    held_out: OptionalNumber = None
    rig: Annotated[str, tyro.conf.arg(metavar="{fixed,random,hemisphere,orbit,spiral,paper-128,paper-200,srn}")] = (
        "fixed"
    )
    distance: Annotated[float | None, optional("RADII")] = None
    field_of_view: Annotated[float | None, optional("DEGREES")] = None
    lighting: Literal["studio", "headlight", "random"] = "studio"
    layout: Annotated[str, tyro.conf.arg(metavar="{native,srn,learnit-128,hyperplanes-200}")] = "native"
    up: Literal["y", "z"] = "y"
    up_of: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[PATTERN=AXIS [...]]")] = ()
    split_file: Annotated[OptionalFile, Exists("ShapeNet's official all.csv")] = None
    channels: tuple[Literal["rgba", "depth", "normals", "coordinates", "mesh"], ...] = ("rgba",)
    workers: OptionalInt = None
    engine: Literal["local", "ray"] = "local"
    timeout: float = 300.0
    supersample: int = SUPERSAMPLE
    renderer: OptionalName = None
    verify: bool = False


COUNT = 70  # procedural objects


def source_of(arguments: Arguments) -> Procedural | MeshFolder:
    """The source of objects.

    Raises:
        ValueError: both or none of --class and --meshes, an option of the other one, or an unknown class.
    """
    from data_gen.datasets.generate import MeshFolder, Procedural
    from data_gen.shapes import check_class

    if (arguments.class_name is None) == (arguments.meshes is None):
        found = "none" if arguments.meshes is None else "both"
        raise ValueError(f"expected --class NAME or --meshes FOLDER, found {found}; `hyperplanes generate --help`")
    if arguments.meshes is not None:
        if arguments.count is not None:
            raise ValueError("count: expected with --class, found with --meshes, all of which are rendered")
        return MeshFolder(arguments.meshes, arguments.up, arguments.split_file, arguments.up_of, arguments.meshes_class)
    if arguments.split_file is not None:
        raise ValueError("split_file: expected with --meshes and a ShapeNetCore tree, found with --class")
    if arguments.meshes_class is not None or arguments.up_of or arguments.up != "y":
        given = {"--class-name": arguments.meshes_class, "--up-of": arguments.up_of, "--up": arguments.up != "y"}
        named = ", ".join(option for option, value in given.items() if value)
        raise ValueError(f"{named}: expected with --meshes, found with --class; leave it out")
    name = str(arguments.class_name)
    check_class(name)
    return Procedural(name, COUNT if arguments.count is None else arguments.count, arguments.seed)


def summary(report: GenerationReport, out: Path) -> str:
    """One line about what was written."""
    splits = ", ".join(f"{count} {split}" for split, count in report.splits.items() if count)
    reused = f", {report.reused} of them from before" if report.reused else ""
    if report.changed:
        reused += f", {len(report.changed)} made again, for their files have changed ({_some(report.changed)})"
    speed = (
        f" in {format_duration(report.seconds)}, {report.images_per_second:.0f} images/s"
        if report.images_per_second
        else ""
    )
    return f"{out}: {counted(report.written, 'object')} ({splits}{reused}){speed}"


def remarks(report: GenerationReport, out: Path) -> list[str]:
    """One line about each set of objects or files that the user should check, and where they are listed."""
    others = [name for name in report.warned if name not in set(report.incomplete)]
    explained = "; the text is in the warnings of each object, under objects"
    found = {
        ("not in the split file, so trained on", "not_in_split_file"): report.unlisted,
        ("drawn without a texture or another file that they name", f"with_lost_files{explained}"): report.incomplete,
        ("drawn with other warnings", f"with_warnings{explained}"): others,
    }
    too_few = "one more object is needed, because one alone is not held out"
    remedy = "repair what was skipped, or choose another --held-out" if report.skipped else too_few
    lines = [
        f"{'fewer' if report.splits[split] else 'no'} objects in the split {split}: {report.splits[split]} of {count}; "
        + remedy
        for split, count in report.requested.items()
        if report.splits[split] < count
    ]
    lines += [
        f"{what}: {len(names)} of {counted(report.written, 'object')} ({_some(names)}), "
        f"listed in {out / 'manifest.json'} under {key}"
        for (what, key), names in found.items()
        if names
    ]
    if report.duplicates:
        lines.append(
            f"left out, as the same objects are taken in another format: {len(report.duplicates)} of the files "
            f"({_some(report.duplicates)}), listed in {out / 'manifest.json'} under skipped"
        )
    return lines


def _some(names: list[str]) -> str:
    """The first few names."""
    return ", ".join(names[:3]) + ", ..." * (len(names) > 3)


def run(arguments: Arguments) -> int:
    """Generate the data set and say what was skipped."""
    from data_gen.datasets.generate import GenerationConfig, check, generate
    from data_gen.datasets.manifest import verify
    from data_gen.rendering.renderers import find_renderer

    console = Console()
    source = source_of(arguments)
    names = {field.name for field in fields(GenerationConfig)} & {field.name for field in fields(Arguments)}
    given: dict[str, Any] = {name: getattr(arguments, name) for name in names}
    config = GenerationConfig(**given)
    check(source, config)  # first, because it takes seconds to find a renderer
    renderer = find_renderer(arguments.renderer)
    console.say(f"renderer: {renderer.name} ({renderer.detail})")
    for line in renderer.advice:
        console.say(f"a faster one: {line}")
    config = replace(config, renderer=renderer.name)
    with console.bar("rendering") as bar:
        report = generate(source, arguments.out, config, progress=bar.show)
    for name, reason in report.skipped:
        console.warn(f"skipped {name}: {reason}")
    console.say(summary(report, arguments.out))
    for line in remarks(report, arguments.out):
        console.warn(line)
    if not arguments.verify:
        return 0
    verification = verify(arguments.out)
    for line in verification.lines():
        console.say(line)
    return int(not verification.intact)
