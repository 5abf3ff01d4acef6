"""What a data set holds, in numbers."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from hyperplanes.data.dataset import Dataset
from hyperplanes.data.formats.catalogue import SPLITS
from hyperplanes.data.inspection.checks import check_duplicates, check_gaze, check_masks, check_poses, check_splits
from hyperplanes.data.inspection.conventions import Conventions, check_conventions
from hyperplanes.data.inspection.silhouettes import with_object
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import carve
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.views import Task, join_views

__all__ = ["Description", "ObjectDescription", "describe"]

HULL_SIDE = 48


@dataclass(frozen=True)
class ObjectDescription:
    """One object of a data set.

    Attributes:
        name: of the object.
        support: number of support views.
        query: number of query views.
        size: (height, width) in pixels.
        field_of_view: horizontal, in degrees.
        distance: smallest and largest distance of a camera from the centre of the bounds.
        bounds: centre and radius of the sphere that holds the scene.
        extent: side lengths of the box around the visual hull, or None without masks.
        coverage: mean opacity of the pixels, or None without masks.
        conventions: whether pictures and poses agree.
        problems: what else is wrong with it, a sentence each.
        checks: what else was looked at, or could not be, a sentence each.
        notes: what the reading left out, turned or scaled.
    """

    name: str
    support: int
    query: int
    size: tuple[int, int]
    field_of_view: float
    distance: tuple[float, float]
    bounds: tuple[tuple[float, float, float], float]
    extent: tuple[float, float, float] | None
    coverage: float | None
    conventions: Conventions
    problems: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def consistent(self) -> bool:
        """Whether nothing is known to be wrong with it."""
        return self.conventions.consistent and not self.problems


@dataclass(frozen=True)
class Description:
    """A data set.

    Attributes:
        layout: its name.
        splits: how many objects are in each split.
        objects: the objects that were looked at.
        skipped: what the generator left out: names and reasons.
        broken: objects that cannot be read: names and messages.
        unlisted: how many training objects the official split file did not name.
    """

    layout: str
    splits: dict[str, int]
    objects: tuple[ObjectDescription, ...]
    skipped: tuple[tuple[str, str], ...]
    broken: tuple[tuple[str, str], ...]
    unlisted: int = 0

    def lines(self) -> list[str]:
        """The description for people, a line a fact."""
        count = ", ".join(f"{number} {split}" for split, number in self.splits.items() if number) or "none"
        lines = [f"layout: {self.layout}", f"objects: {sum(self.splits.values())} ({count})"]
        if self.objects:
            first = self.objects[0]
            (x, y, z), radius = first.bounds
            lines += [
                f"views: {first.support} support, {first.query} query, {first.size[1]} x {first.size[0]} pixels",
                f"cameras: {first.field_of_view:.1f} degrees, {first.distance[0]:.3g} to {first.distance[1]:.3g} away",
                f"bounds: sphere of radius {radius:.3g} around ({x:.3g}, {y:.3g}, {z:.3g})",
            ]
            if first.extent is not None and first.coverage is not None:
                box = " x ".join(f"{side:.3g}" for side in first.extent)
                lines.append(f"visual hull: {box}, {first.coverage:.0%} of the pixels covered")
            elif first.coverage is None:
                lines.append("masks: none; the packaged models need them (RGBA images, or a folder masks/)")
            else:
                lines.append("visual hull: empty, no point is shown by all masks; check poses, masks and bounds")
            wrong = [one for one in self.objects if not one.consistent]
            shown = (wrong or self.objects)[0]
            lines += [shown.conventions.line(), *shown.problems, *shown.checks]
            if wrong:
                names = ", ".join(one.name for one in wrong)
                lines.append(f"wrong: {len(wrong)} of {len(self.objects)} objects looked at: {names}")
            lines += [f"{one.name}: {note}" for one in self.objects for note in one.notes]
        if self.unlisted:
            lines.append(f"not in the split file, so trained on: {self.unlisted}, named in the manifest")
        lines += [f"skipped by the generator: {name}: {reason}" for name, reason in self.skipped]
        return lines + [f"cannot be read: {name}: {message}" for name, message in self.broken]


def describe(path: str | Path | Dataset, objects: int = 8) -> Description:
    """Look at a data set.

    Args:
        path: a data set in any layout, or a posed scene.
        objects: how many to look at, spread evenly over all.

    Returns:
        What was found; objects that cannot be read are listed in it and do not stop it.

    Raises:
        ValueError: fewer than one object to look at.
    """
    if objects < 1:
        raise ValueError(f"objects: expected at least 1 to look at, got {objects}")
    data = path if isinstance(path, Dataset) else Dataset(path)
    names = data.names()
    chosen = np.linspace(0, len(names) - 1, min(objects, len(names))).round().astype(int)
    found, broken = [], []
    for name in (names[index] for index in chosen):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # the notes are listed
                found.append(_object(data, name))
        except DataError as error:
            broken.append((name, str(error)))
    splits = {split: len(data.names(split)) for split in SPLITS}
    stated = data.manifest.get("skipped", [])
    skipped = tuple(
        (str(one.get("name")), str(one.get("reason")))
        for one in (stated if isinstance(stated, list) else [])
        if isinstance(one, dict)
    )
    absent = data.manifest.get("not_in_split_file", {})
    count = absent.get("count", 0) if isinstance(absent, dict) else 0
    unlisted = count if isinstance(count, int) else 0
    return Description(data.layout, splits, tuple(found), skipped, tuple(broken), unlisted)


def _object(data: Dataset, name: str) -> ObjectDescription:
    posed = data.posed(name)
    task = posed.task()
    views = task.support
    eyes = camera.centres(views.cameras)
    distance = (eyes - eyes.new_tensor(views.bounds.centre)).norm(dim=-1)
    focal = camera.intrinsics(views.cameras)[0, 0, 0]
    extent = coverage = None
    if views.masks is not None:
        coverage = float(views.masks.mean())
        shown = with_object(views)
        assert shown.masks is not None
        hull = carve(shown.masks, shown.cameras, shown.bounds, HULL_SIDE)
        points = hull.centres()
        if len(shown) and len(points):
            x, y, z = (points.amax(0) - points.amin(0) + hull.voxel).tolist()
            extent = (x, y, z)
    return ObjectDescription(
        name,
        len(views),
        len(task.query),
        views.size,
        float(torch.rad2deg(2 * torch.atan(views.size[1] / 2 / focal))),
        (float(distance.min()), float(distance.max())),
        (views.bounds.centre, views.bounds.radius),
        extent,
        coverage,
        check_conventions(views),
        *_checked(task),
        posed.notes,
    )


def _checked(task: Task) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is wrong, and what was looked at besides."""
    halves = task.support, task.query
    parts = [join_views(*halves)] if task.support.size == task.query.size else halves
    outcomes = [each for each in (check_gaze(task.support), check_splits(*halves)) if each is not None]
    checks = (check_duplicates, check_poses, check_masks)
    problems = [line for part in parts for check in checks if (line := check(part))]
    problems += [line for fine, line in outcomes if not fine]
    return tuple(problems), tuple(line for fine, line in outcomes if fine)
