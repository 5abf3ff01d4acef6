"""Inspect a data set: contact sheet, cameras around the visual hull, counts, bounds, and the conventions check.

For a single scene also the coverage and overlap of its views, the worst of them, and the quality to expect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.datasets.contact_sheet import contact_sheet
from data_gen.datasets.manifest import Verification, verify
from hyperplanes.utilities.files.encoding import encode_png
from hyperplanes.utilities.files.reading import read_json
from hyperplanes.utilities.files.writing import write_whole

__all__ = ["Inspection", "inspect"]

_OBJECTS, _VIEWS, _FRUSTUM = 8, 10, 0.35
_LONGEST, _TRIED = 320, 96  # pixels of pictures for coverage, and for the trial of a model
_POINTS = 5000  # points of a sparse reconstruction that are drawn
_EDGES = [0, 1, 2, 3, 4, 1, 5, 0, 2, 5, 0, 3, 5, 0, 4, 5]  # of a frustum, from corner to corner; 5 is a gap


@dataclass(frozen=True)
class Inspection:
    """The findings and the written files.

    Attributes:
        description: `hyperplanes.data.inspection.describe.Description` of the data set.
        files: the pictures that were written.
        verification: result of the checksums, if requested.
        scene: coverage of the views of a single scene, one fact per line.
    """

    description: Any
    files: tuple[Path, ...]
    verification: Verification | None
    scene: tuple[str, ...]

    @property
    def has_problems(self) -> bool:
        """Whether an object cannot be read, its poses contradict its pictures, or a file has changed."""
        objects = self.description.objects
        damaged = self.verification is not None and not self.verification.intact
        return damaged or bool(self.description.broken) or not all(one.consistent for one in objects)

    def lines(self) -> list[str]:
        """Everything as text, one fact per line."""
        checked = [] if self.verification is None else self.verification.lines()
        return [*self.description.lines(), *self.scene, *checked, *(f"wrote {path}" for path in self.files)]


def inspect(path: str | Path, out: str | Path, objects: int = _OBJECTS, *, checksums: bool = False) -> Inspection:
    """Describe and draw a data set; on a single scene with masks, also try the packaged model `small`.

    Args:
        path: a data set in any layout, or a posed scene.
        out: the folder for contact_sheet.png and cameras.png, and coverage.png of a single scene.
        objects: number of objects to inspect.
        checksums: also compare every file with its checksum in the manifest.

    Returns:
        The description and the files. A data set that cannot be opened is a DataError.
    """
    from hyperplanes.data import open_dataset
    from hyperplanes.data.inspection.describe import describe
    from hyperplanes.data.inspection.picture import draw_coverage
    from hyperplanes.data.inspection.scene import describe_scene
    from hyperplanes.data.packaged import locate_scene

    data, out = open_dataset(path), Path(out)
    description = describe(data, objects)
    files, scene = [], []
    verification = verify(path) if checksums else None
    names = [one.name for one in description.objects]
    if names:
        pictures, labels = _pictures(data, names)
        support = len(data.posed(names[0]).support)
        drawings = {"contact_sheet.png": encode_png(contact_sheet(pictures, min(_VIEWS, support), labels))}
        views = _all_views(data, names[0])
        sparse = _sparse(locate_scene(path), data.posed(names[0])) if len(data) == 1 else None
        drawings["cameras.png"] = _cameras(views, support, names[0], sparse)
        if len(data) == 1 and len(views) > 1:
            contradicted = not description.objects[0].conventions.consistent
            report = replace(describe_scene(views, sparse), contradicted=contradicted)
            scene = [*report.lines(), *_trial(views)]
            drawings["coverage.png"] = draw_coverage(report, views)
        for name, drawing in drawings.items():
            files.append(out / name)
            write_whole(files[-1], drawing)
    return Inspection(description, tuple(files), verification, tuple(scene))


def _all_views(data: Any, name: str) -> Any:
    """All views of an object, reduced, in a world with y up, support first."""
    from hyperplanes.data.inspection.scene import stand_upright
    from hyperplanes.views import join_views

    posed = data.posed(name)
    small = posed.downscaled(max(1, -(-max(posed.support.rgba.shape[2:]) // _LONGEST))).task()
    return stand_upright(join_views(small.support, small.query))


def _sparse(folder: Path, posed: Any) -> Any:
    """The points of a reconstruction beside a scene, in the world with y up; with `capture`'s reprojection errors."""
    from hyperplanes.capture.sparse_model import SparseModel
    from hyperplanes.data.formats.scenes.sparse_points import read_sparse_points
    from hyperplanes.data.upright import guess_up, y_up_from

    if not folder.is_dir() and folder.suffix != ".json":
        return None
    folder = folder if folder.is_dir() else folder.parent
    found, path = read_sparse_points(folder), folder / "capture" / "poses" / "model.npz"
    if found is None:
        return None
    if not found.errors and path.is_file() and (folder / "transforms.json").is_file():
        frames = read_json(folder / "transforms.json", folder).get("frames", [])
        model = SparseModel.load(path)
        if len(model) == len(frames):
            errors = dict(zip((frame["file_path"] for frame in frames), model.errors_of_cameras(), strict=True))
            found = replace(found, error=model.reprojection_error, errors=errors)
    turn = y_up_from(posed.support.up or guess_up(posed.support.cameras) or "y")[:3, :3].numpy()
    return replace(found, places=(found.places - np.asarray(posed.support.origin)) @ turn.T)


def _trial(views: Any) -> list[str]:
    """One line on how well the packaged model renders left-out views; none if it cannot be tried."""
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.evaluation.suitability import held_out_psnr

    if views.masks is None or len(views) < 8:
        return []
    found = held_out_psnr(HyperPlanes.from_pretrained("small"), views.resized(_TRIED))
    if found is None:
        return []
    return [
        f"tried: in one forward pass `small` shows four views that it was not given at {found[0]:.1f} dB (64 pixels), "
        f"the nearest view copied has {found[1]:.1f}; 20 is a blurred likeness, 30 is hard to tell from a photograph"
    ]


def _pictures(data: Any, names: list[str]) -> tuple[list[np.ndarray], list[str]]:
    """Views of each object in a row; objects whose views differ in size from the first one's are left out."""
    first = data.posed(names[0]).support
    pictures, labels = [], []
    for name in names:
        shown = data.posed(name).support
        if shown.rgba.shape[2:] != first.rgba.shape[2:]:
            continue
        chosen = np.linspace(0, len(shown) - 1, min(_VIEWS, len(first))).round().astype(int)
        pictures += list(shown.rgba.permute(0, 2, 3, 1).numpy()[chosen])
        labels += [name if not column else Path(shown.names[view]).stem for column, view in enumerate(chosen)]
    return pictures, labels


def _cameras(views: Any, support: int, title: str, sparse: Any) -> bytes:
    """PNG of the frusta of support (blue) and query (orange) cameras around the hull, or around the bounds.

    Args:
        views: in a world with y up, support first.
        support: number of support views.
        title: of the picture.
        sparse: points of a reconstruction, in the same world, or None; those far away are left out.
    """
    from hyperplanes.utilities.images.plots import encode_figure, new_figure

    figure = new_figure(8, 8)
    axes: Any = figure.add_subplot(projection="3d")
    halves = ((slice(support), "tab:blue", "support"), (slice(support, None), "tab:orange", "query"))
    frusta = _frusta(views)
    for half, colour, label in halves:
        count = len(frusta[half])
        if not count:
            continue
        # one line with gaps: a line per edge would take most of the drawing time
        broken = np.concatenate([frusta[half], np.full((count, 1, 3), np.nan)], axis=1)
        line = broken[:, _EDGES].reshape(-1, 3)
        axes.plot(line[:, 0], -line[:, 2], line[:, 1], color=colour, linewidth=0.6)
        axes.plot([], [], [], color=colour, label=f"{count} {label} cameras")
    points, shown = _solid(views)
    axes.scatter(points[:, 0], -points[:, 2], points[:, 1], s=2, c="0.35", label=shown)
    if sparse is not None:
        reach = np.abs(frusta[:, 0] - views.bounds.centre).max()
        points = sparse.places[(np.abs(sparse.places - views.bounds.centre) < reach).all(1)]
        points = points[:: max(1, len(points) // _POINTS)]
        axes.scatter(
            points[:, 0], -points[:, 2], points[:, 1], s=1, c="tab:green", label="points of the reconstruction"
        )
    axes.set(xlabel="x", ylabel="-z", zlabel="y", title=title)
    axes.set_aspect("equal")
    axes.legend(loc="upper left")
    return encode_figure(figure, "png")


def _frusta(views: Any) -> np.ndarray:
    """(view, 5, 3): each camera's centre and the corners of its picture at a fraction of its distance."""
    from hyperplanes.geometry import cameras as camera

    height, width = views.size
    matrices = camera.intrinsics(views.cameras).double().numpy()
    poses = camera.camera_from_world(views.cameras).double().numpy()
    eyes = camera.centres(views.cameras).double().numpy()
    depth = _FRUSTUM * views.bounds.radius
    pixels = np.array(
        [[-0.5, -0.5, 1], [width - 0.5, -0.5, 1], [width - 0.5, height - 0.5, 1], [-0.5, height - 0.5, 1]]
    )
    local = depth * pixels @ np.linalg.inv(matrices).transpose(0, 2, 1)
    return np.concatenate([eyes[:, None], local @ poses[:, :3, :3] + eyes[:, None]], axis=1)


def _solid(views: Any) -> tuple[np.ndarray, str]:
    """Points on the visual hull's surface, or on the bounding sphere where there are no masks."""
    from hyperplanes.geometry import carve
    from hyperplanes.geometry.cameras import fibonacci_sphere

    if views.masks is not None:
        return carve(views.masks, views.cameras, views.bounds, 40).surface_centres.numpy(), "visual hull"
    sphere = np.linalg.inv(fibonacci_sphere(400, views.bounds.radius).numpy())[:, :3, 3]
    return sphere + np.array(views.bounds.centre), "bounds"
