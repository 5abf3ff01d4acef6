"""Write one object as images, a turntable, a mesh, points, splats or an HTML page, from a few posed images of it.

The mesh is the surface on which the density crosses a level (marching cubes). By default it is a GLB file with a
texture, which Blender, Windows, slide shows and three.js open. The page is one HTML file that a browser opens without
any other file. It draws baked voxels, and the mouse or a finger turns them.

Example:
    hyperplanes export --checkpoint small --views scene --out chair
    hyperplanes export --checkpoint small --views scene --out chair --what mesh --voxels 192
    hyperplanes export --checkpoint small --views scene --out chair --what page --all-views
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

from hyperplanes.commands.inputs.fields import adapt_to, bake_field, load_source, refuse_of_baked, render_views
from hyperplanes.commands.inputs.scene import read_object, refuse_sources
from hyperplanes.commands.options import ObjectArguments, OptionalInt, check_orbit, optional
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.output.writing import writes_to
from hyperplanes.utilities.messages.formatting import counted

if TYPE_CHECKING:
    from hyperplanes.adaptation.base import AdaptedField
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.fields.baked import BakedField
    from hyperplanes.views import Views

__all__ = ["Arguments", "run"]


@dataclass(frozen=True)
class Arguments(ObjectArguments):
    """The options of `export`.

    Attributes:
        what: The outputs to write, one or more.
        frames: Frames of the turntable.
        size: Pixels along the longer side of the turntable. By default as many as the images have.
        turntable: The file format of the turntable. mp4 and webm need `pip install 'hyperplanes[video]'`. The turntable
            is rendered from baked voxels if `render --representation auto` would use them.
        mesh_format: The file format of the mesh. glb has a texture and normals; ply and obj have a colour per vertex.
        faces: Most faces of a mesh with a texture.
        texture: Approximate number of pixels along the longer side of the texture.
        voxels: Voxels along each side of the grid from which the mesh is extracted.
        level: Density at the surface of the mesh. By default the level whose silhouettes and depth agree best with the
            rendered ones; then parts that no camera of a support view sees into are filled as well.
        page_voxels: Voxels along each side of the grid for the page and the splats. By default 1.4 per pixel of the
            images, at least 64 and at most 256.
        fit: Gradient steps that fit these voxels to the support views; splats take 1.6 times as many. With 0, they keep
            the field's colours and densities.
        points: Most points of the cloud.
        splat_format: ply, which viewers of Gaussian splats read, or splat, which is smaller and has no view-dependent
            colour.
    """

    what: tuple[Literal["images", "turntable", "mesh", "page", "splats", "points"], ...] = (
        "images",
        "turntable",
        "mesh",
    )
    frames: Annotated[int, range(1, 100_000)] = 48
    size: OptionalInt = None
    turntable: Literal["webp", "gif", "mp4", "webm"] = "webp"
    mesh_format: Literal["ply", "glb", "obj"] = "glb"
    faces: Annotated[int, range(100, 10_000_000)] = 10_000
    texture: Annotated[int, range(16, 8193)] = 1024
    voxels: int = 128
    level: Annotated[float | None, optional("DENSITY")] = None
    page_voxels: OptionalInt = None
    fit: Annotated[int, range(10_000)] = 100
    points: Annotated[int, range(1, 100_000_001)] = 100_000
    splat_format: Literal["ply", "splat"] = "ply"


BELONGS = {
    **dict.fromkeys(("frames", "size", "turntable"), ("--what turntable",)),
    **dict.fromkeys(("mesh_format", "voxels", "level"), ("--what mesh",)),
    **dict.fromkeys(("faces", "texture"), ("--what mesh --mesh-format glb",)),
    "page_voxels": ("--what page", "--what splats"),
    "fit": ("--what turntable", "--what page", "--what splats"),
    "points": ("--what points",),
    "splat_format": ("--what splats",),
}
"""The outputs to which each option applies."""

GOOD_OVERLAP = 0.9
GOOD_DEPTH = 0.9


@writes_to(
    lambda arguments: arguments.out,
    check=lambda arguments: refuse_sources(arguments.out / "images", arguments.views),
)
def run(arguments: Arguments) -> int:
    """Adapt to the views and write the requested outputs."""
    from hyperplanes.adaptation.base import AdaptedField
    from hyperplanes.data.devices import choose_device
    from hyperplanes.export.baking import BakedScene, default_side
    from hyperplanes.export.images import save_images
    from hyperplanes.export.page import page_of, save_page, turning_picture

    _check(arguments)
    console, device, out = Console(), choose_device(arguments.device), arguments.out
    source = load_source(arguments.checkpoint, device, reflections=not arguments.no_reflections)
    given = {
        "--steps": arguments.steps != 0,
        "--learn-background": arguments.learn_background,
        "--refine-poses": arguments.refine_poses,
        "--page-voxels": arguments.page_voxels is not None,
        "--no-reflections": arguments.no_reflections,
        # splats are fitted even if the voxels are from a baked file
        "--fit": arguments.fit != Arguments.fit and "splats" not in arguments.what,
    }
    refuse_of_baked(source, given)
    task, _ = read_object(arguments, source, console)
    refuse_sources(out / "images", arguments.views, task)
    shown, query = task.support.to(device), task.query.to(device)
    field, _ = adapt_to(source, shown, task.name, console, steps=arguments.steps)
    made: dict[int, BakedField] = {}

    def voxels(adapted: AdaptedField, views: Views, side: int) -> BakedField:
        if side not in made:  # the page uses the voxels of the turntable
            made[side] = bake_field(adapted, views, side, fit=arguments.fit, console=console)
        return made[side]

    if "images" in arguments.what:
        paths = save_images(render_views(field, query.cameras, console).images, out / "images", query.names)
        console.say(f"{out / 'images'}: {counted(len(paths), 'picture')} of the {_compared_with(arguments)} poses")
    if "turntable" in arguments.what:
        _write_turntable(field, shown, arguments, console, make=voxels)
    if "mesh" in arguments.what:
        solid = field if isinstance(field, AdaptedField) else field.adapted
        _write_mesh(solid, shown, query, arguments, console, adaptable=not isinstance(source, BakedScene))
    if "points" in arguments.what:
        _write_points(field, shown, arguments, console)
    if {"page", "splats"} & set(arguments.what):
        if isinstance(field, AdaptedField):
            baked = voxels(field, shown, arguments.page_voxels or default_side(shown.size))
        else:
            baked = field.field
        if "page" in arguments.what:
            page = page_of(baked, shown, picture=turning_picture(baked, shown))
            path = save_page(page, out / "page.html", task.name)
            console.say(f"{path}: {path.stat().st_size / 1e6:.1f} MB; open it in a browser")
        if "splats" in arguments.what:
            _write_splats(baked, shown, query, arguments, console)
    return 0


def _check(arguments: Arguments) -> None:
    """Refuse wrong options before anything is read."""
    from hyperplanes.export.baking import coarsening
    from hyperplanes.export.images import require_encoder
    from hyperplanes.export.surfaces.mesh import check_voxels
    from hyperplanes.utilities.messages.errors import rename_errors

    if not arguments.what:
        raise ValueError("--what: expected at least one of images, turntable, mesh, page, splats, points, got none")
    _refuse_unused(arguments)
    if "turntable" in arguments.what:
        check_orbit(arguments.frames, arguments.size)
        require_encoder(arguments.turntable)
    if arguments.level is not None and not arguments.level > 0:
        raise ValueError(f"--level: expected a density above 0, got {arguments.level:g}")
    if "mesh" in arguments.what:
        with rename_errors("voxels", "--voxels"):
            check_voxels(arguments.voxels)
    if arguments.page_voxels is not None:
        with rename_errors("side", "--page-voxels"):
            coarsening(arguments.page_voxels)


def _refuse_unused(arguments: Arguments) -> None:
    """Refuse options of outputs that are not written."""
    written = {f"--what {each}" for each in arguments.what}
    if "mesh" in arguments.what:
        written.add(f"--what mesh --mesh-format {arguments.mesh_format}")
    for name, wanted in BELONGS.items():
        given, option = getattr(arguments, name), name.replace("_", "-")
        if given != getattr(Arguments, name) and written.isdisjoint(wanted):
            raise ValueError(f"--{option}: expected {' or '.join(wanted)} as well, got {given} alone; leave it out")


def _compared_with(arguments: Arguments) -> str:
    """The kind of views that the outputs are compared with: "support" with `--all-views`, otherwise "query"."""
    return "support" if arguments.all_views else "query"


def _write_turntable(
    field: AdaptedField | BakedScene,
    shown: Views,
    arguments: Arguments,
    console: Console,
    *,
    make: Callable[[AdaptedField, Views, int], BakedField],
) -> None:
    """Write an animation of an orbit, of the field or of the voxels that `make` makes of it."""
    from hyperplanes.export.animation import choose_representation
    from hyperplanes.export.images import encode_animation, orbit_cameras, to_pixels
    from hyperplanes.utilities.files.writing import write_whole

    path = arguments.out / f"turntable.{arguments.turntable}"
    cameras = orbit_cameras(shown, arguments.frames, size=arguments.size)
    # without fitting, voxels show less detail than the field
    drawing = choose_representation(field, shown, cameras, "auto" if arguments.fit else "field", make=make)
    pictures = render_views(drawing, cameras, console)
    write_whole(path, encode_animation(to_pixels(pictures.images), arguments.turntable))
    console.say(f"{path}: {arguments.frames} frames")


def _write_points(field: AdaptedField | BakedScene, shown: Views, arguments: Arguments, console: Console) -> None:
    """Write the points that the support views show."""
    from hyperplanes.adaptation.base import AdaptedField
    from hyperplanes.export.surfaces.points import point_cloud, save_points
    from hyperplanes.utilities.messages.errors import rename_errors

    bounds = (field if isinstance(field, AdaptedField) else field.adapted).occupancy.bounds
    plain = field.without_residuals() if isinstance(field, AdaptedField) else field
    pictures = render_views(plain, shown.cameras, console)
    with rename_errors("count", "--points"):
        cloud = point_cloud(pictures, shown.cameras, bounds, arguments.points)
    path = save_points(cloud, arguments.out / "points.ply")
    console.say(f"{path}: {len(cloud):,} points with normals and colours, of {counted(len(shown), 'view')}")


def _write_splats(baked: BakedField, shown: Views, query: Views, arguments: Arguments, console: Console) -> None:
    """Write the splats of baked voxels, and print the PSNR of both."""
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.export.splats import SPLAT_STEPS, fit_splats, save_splats, splats_of
    from hyperplanes.export.voxel_fitting import VOXEL_STEPS, render_guide
    from hyperplanes.geometry.distortion import DistortedCamera
    from hyperplanes.utilities.images.metrics import psnr

    splats, quality = splats_of(baked), ""
    straight = not isinstance(shown.cameras, DistortedCamera)
    if straight and arguments.fit:
        with console.bar("fitting splats") as bar:
            steps = arguments.fit * SPLAT_STEPS // VOXEL_STEPS
            guide = render_guide(BakedScene(baked), shown, size=shown.size)
            splats = fit_splats(
                splats, shown, guide=guide, steps=steps, on_step=lambda done: bar.show(done, steps, "steps")
            )
    if straight:
        asked = query[:8].to("cpu")
        pictures = splats.render(asked.cameras), BakedScene(baked).render(asked.cameras).images
        ours, voxels = (float(psnr(part.clamp(0, 1), asked.images).mean()) for part in pictures)
        quality = f"; {ours:.2f} dB PSNR on {len(asked)} {_compared_with(arguments)} views, the voxels {voxels:.2f} dB"
    path = save_splats(splats, arguments.out / f"splats.{arguments.splat_format}")
    console.say(f"{path}: {len(splats.means):,} splats, {path.stat().st_size / 1e6:.1f} MB{quality}")


def _write_mesh(
    solid: AdaptedField, shown: Views, query: Views, arguments: Arguments, console: Console, *, adaptable: bool
) -> None:
    """Write the mesh, and print how it agrees with the field's pictures, with a warning if it agrees badly.

    `adaptable` is false for a baked file. That refuses `--steps`, so the warning does not advise them.
    """
    from hyperplanes.export.surfaces.mesh import density_grid, extract_mesh, save_mesh
    from hyperplanes.export.surfaces.mesh_filling import fill_hidden
    from hyperplanes.export.surfaces.mesh_level import agreement, choose_level
    from hyperplanes.export.surfaces.texture import save_textured, texture_surface
    from hyperplanes.utilities.messages.errors import rename_errors

    density, level = density_grid(solid, arguments.voxels), arguments.level
    if level is None:
        level = choose_level(solid, density, shown.cameras)
        density = fill_hidden(density, level, solid.occupancy.bounds, shown.cameras)
    with rename_errors("level", "--level"):
        surface = extract_mesh(solid, level=level, density=density)
    path = arguments.out / f"mesh.{arguments.mesh_format}"
    if arguments.mesh_format == "glb":
        textured = texture_surface(surface, solid, shown, faces=arguments.faces, size=arguments.texture)
        surface = replace(surface, vertices=textured.vertices, faces=textured.faces)
        save_textured(textured, path)
        height, width = textured.texture.shape[:2]
        console.say(f"{path}: {len(textured.faces):,} faces, a texture of {width}x{height}")
    else:
        save_mesh(surface, path)
        console.say(f"{path}: {len(surface.vertices):,} vertices, {len(surface.faces):,} faces")
    found = agreement(surface, solid, query.cameras)
    console.say(
        f"{path}: its silhouettes overlap the rendered ones of {len(query)} {_compared_with(arguments)} views by "
        f"{found.overlap:.1%} (intersection over union), and the depths agree on {found.depth:.1%} of the pixels that "
        f"both cover; density at the surface: {level:.3g}"
    )
    more = ", or --steps 100" if adaptable else ""
    if found.overlap < GOOD_OVERLAP:
        several = "more --voxels, another --level" if adaptable else "more --voxels, or another --level"
        console.warn(f"{path}: parts are missing or too large; {several}{more}")
    elif found.depth < GOOD_DEPTH:
        console.warn(f"{path}: walls are missing or lie too far out; another --level{more}")
