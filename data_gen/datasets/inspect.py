"""Inspect a data set: contact sheet, cameras around the visual hull, counts, bounds, and the conventions check."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.datasets.contact_sheet import contact_sheet
from data_gen.datasets.manifest import Verification, verify
from hyperplanes.utilities.encoding import encode_png
from hyperplanes.utilities.files import write_whole

__all__ = ["Inspection", "inspect"]

_OBJECTS, _VIEWS, _FRUSTUM = 8, 10, 0.35


@dataclass(frozen=True)
class Inspection:
    """What was found and written.

    Attributes:
        description: `hyperplanes.data.inspection.describe.Description` of the data set.
        files: the pictures that were written.
        notes: what could not be done and why, one line each.
        verification: of the checksums, where it was requested.
    """

    description: Any
    files: tuple[Path, ...]
    notes: tuple[str, ...]
    verification: Verification | None = None

    @property
    def has_problems(self) -> bool:
        """Whether an object cannot be read, its poses contradict its pictures, or a file has changed."""
        objects = self.description.objects
        damaged = self.verification is not None and not self.verification.intact
        return damaged or bool(self.description.broken) or not all(one.consistent for one in objects)

    def lines(self) -> list[str]:
        """All of it as text, a line a fact."""
        checked = [] if self.verification is None else self.verification.lines()
        return [*self.description.lines(), *checked, *(f"wrote {path}" for path in self.files), *self.notes]


def inspect(path: str | Path, out: str | Path, objects: int = _OBJECTS, *, checksums: bool = False) -> Inspection:
    """Describe a data set, and draw it.

    Args:
        path: a data set in any layout, or a posed scene.
        out: the folder for contact_sheet.png and cameras.png.
        objects: how many objects to look at.
        checksums: compare every file with its checksum in the manifest, too.

    Returns:
        The description and the files. A data set that cannot be opened is a DataError; without matplotlib there is
        no cameras.png, and a note.
    """
    from hyperplanes.data import open_dataset
    from hyperplanes.data.inspection.describe import describe

    data, out = open_dataset(path), Path(out)
    description = describe(data, objects)
    files, notes = [], []
    verification = verify(path) if checksums else None
    names = [one.name for one in description.objects]
    if names:
        pictures, labels = _pictures(data, names)
        files.append(out / "contact_sheet.png")
        write_whole(files[0], encode_png(contact_sheet(pictures, min(_VIEWS, len(pictures)), labels)))
        try:
            drawing = _cameras(data.task(names[0]))
            files.append(out / "cameras.png")
            write_whole(files[1], drawing)
        except ImportError:
            notes.append("cameras.png: not drawn, matplotlib is not installed; pip install matplotlib")
    return Inspection(description, tuple(files), tuple(notes), verification)


def _pictures(data: Any, names: list[str]) -> tuple[list[np.ndarray], list[str]]:
    """Views of each object, a row each; objects of other sizes than the first are left to their own."""
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


def _cameras(task: Any) -> bytes:
    """PNG of the frusta of support (blue) and query (orange) cameras around the hull, or around the bounds."""
    import io

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 8), dpi=100)
    axes: Any = figure.add_subplot(projection="3d")
    for views, colour, label in ((task.support, "tab:blue", "support"), (task.query, "tab:orange", "query")):
        for index, corners in enumerate(_frusta(views)):
            for line in (corners[[0, 1, 2, 3, 4, 1]], corners[[0, 2]], corners[[0, 3]], corners[[0, 4]]):
                axes.plot(line[:, 0], -line[:, 2], line[:, 1], color=colour, linewidth=0.6)
            if index == 0:
                axes.plot([], [], [], color=colour, label=f"{len(views)} {label} cameras")
    points, shown = _solid(task.support)
    axes.scatter(points[:, 0], -points[:, 2], points[:, 1], s=2, c="0.35", label=shown)
    axes.set(xlabel="x", ylabel="-z", zlabel="y", title=task.name)
    axes.set_aspect("equal")
    axes.legend(loc="upper left")
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


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
        hull = carve(views.masks, views.cameras, views.bounds, 40)
        solid = np.pad(hull.occupied.numpy(), 1)
        inner = np.logical_and.reduce([np.roll(solid, step, axis) for step in (-1, 1) for axis in range(3)])
        cells = np.argwhere(solid & ~inner) - 1
        centre = np.array(views.bounds.centre)
        return (cells + 0.5) * hull.voxel - views.bounds.radius + centre, "visual hull"
    sphere = np.linalg.inv(fibonacci_sphere(400, views.bounds.radius).numpy())[:, :3, 3]
    return sphere + np.array(views.bounds.centre), "bounds"
