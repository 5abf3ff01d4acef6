"""A data set of few-shot tasks, and the two functions that read a single scene."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hyperplanes.data.formats.catalogue import SPLITS
from hyperplanes.data.formats.recognise import find_catalogue, read_posed, read_posed_task
from hyperplanes.data.pictures.posed import PosedTask
from hyperplanes.data.upright import guess_up, upright, upright_task
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.arguments import checked
from hyperplanes.utilities.files import DataError, malformed
from hyperplanes.utilities.lru_cache import LRUCache
from hyperplanes.views import Task, Views

__all__ = ["Dataset", "Datasets", "locate_scene", "open_dataset", "open_datasets", "read_task", "read_views"]

DEFAULT_BUDGET = 2 * 2**30
EXAMPLES = Path(__file__).parent.parent / "examples"  # a folder a scene, by its name


class Dataset:
    """The objects of a folder, read when asked for and kept as 8-bit pictures while there is room.

    Args:
        folder: a data set, a folder of posed scenes, or one of them, in a layout that `find_catalogue` knows.
        budget: bytes of decoded pictures to keep in memory; the least recently used go first.
        legacy: principal points of learnit's and the authors' layouts at W / 2 at integer pixel centres, as the code
            that was published with these data has them, instead of at the middle of the pictures.

    Raises:
        DataError: nothing that is known lies there, or an object that is listed twice.
    """

    def __init__(self, folder: str | Path, budget: int = DEFAULT_BUDGET, *, legacy: bool = False) -> None:
        self.folder = Path(folder)
        with malformed(self.folder, "a data set or posed images"):
            self._catalogue = find_catalogue(self.folder, legacy=legacy)
        _check_apart(self.folder, self._catalogue.splits)
        self._cache: LRUCache[PosedTask] = LRUCache(budget)
        self._lock = threading.Lock()

    @property
    def manifest(self) -> dict[str, Any]:
        """What manifest.json says; empty where the layout has none."""
        return self._catalogue.manifest

    @property
    def skipped(self) -> tuple[str, ...]:
        """A line about each split of which some objects are missing."""
        return self._catalogue.skipped

    @property
    def layout(self) -> str:
        """The name of the layout."""
        return self._catalogue.layout

    @checked
    def names(self, split: str = "all") -> list[str]:
        """The names of the objects of a split.

        Args:
            split: "train", "val", "test" or "all".

        Returns:
            The names in the order of the data set.

        Raises:
            ValueError: another split.
        """
        if split == "all":
            return [name for part in SPLITS for name in self._catalogue.splits[part]]
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, all, got {split!r}")
        return list(self._catalogue.splits[split])

    def class_of(self, name: str) -> str:
        """The class of one object, as `generate` writes it into manifest.json; empty where that does not state it."""
        objects = self.manifest.get("objects")
        record = objects.get(name) if isinstance(objects, dict) else None
        stated = record.get("class") if isinstance(record, dict) else None
        return stated if isinstance(stated, str) else ""

    @checked
    def task(self, name: str) -> Task:
        """The support and query views of one object, as float images over white.

        Args:
            name: one of `names()`.

        Returns:
            New tensors at every call; only the 8-bit pictures are kept. As `posed`, it raises DataError.
        """
        return self.posed(name).task()

    @checked
    def posed(self, name: str) -> PosedTask:
        """The support and query pictures of one object, 8 bits, shared between calls: not to be changed.

        Args:
            name: one of `names()`.

        Returns:
            The pictures with their cameras. A UserWarning names what was left out, turned or scaled.

        Raises:
            DataError: no such object, or anything wrong with its files.
        """
        with self._lock:
            if (cached := self._cache.get(name)) is not None:
                return cached
        if not any(name in names for names in self._catalogue.splits.values()):
            known = self.names()
            some = ", ".join(known[:3]) + (", ..." if len(known) > 3 else "")
            raise DataError(self.folder, f"one of its {len(known)} objects ({some})", repr(name), "check the name")
        with malformed(f"{self.folder}, {name}", "an object with posed images"):
            task = self._catalogue.read(name)
        warn_of(task.notes, self.folder / name if len(self) > 1 else self.folder)
        with self._lock:
            self._cache.add(name, task)
        return task

    def __len__(self) -> int:
        """The number of objects in all splits."""
        return sum(map(len, self._catalogue.splits.values()))

    def __iter__(self) -> Iterator[Task]:
        """The tasks of all splits, one after the other."""
        return (self.task(name) for name in self.names())


def _check_apart(folder: Path, splits: Mapping[str, Sequence[str]]) -> None:
    """Check that every object is in one split, once: what is trained on may not be judged by."""
    seen: dict[str, str] = {}
    for split, names in splits.items():
        for name in names:
            if name in seen:
                both = f"{name} in {seen[name]} and in {split}" if seen[name] != split else f"{name} twice in {split}"
                raise DataError(folder, "every object in one split", both, "take it out of one of them")
            seen[name] = split


@checked
def open_dataset(path: str | Path, budget: int = DEFAULT_BUDGET, *, legacy: bool = False) -> Dataset:
    """A data set in any layout, or a single posed scene presented as one with one test task.

    Args:
        path: a folder, or a transforms file. "example-car" comes with the package.
        budget: as in `Dataset`.
        legacy: as in `Dataset`.

    Returns:
        The data set; objects are read when asked for.
    """
    return Dataset(locate_scene(path), budget, legacy=legacy)


class Datasets:
    """Several data sets as one; the name of an object is that of its data set's folder, a slash, and its own.

    Args:
        parts: data sets by the name that their objects get.
    """

    def __init__(self, parts: Mapping[str, Dataset]) -> None:
        self.parts = dict(parts)

    @property
    def skipped(self) -> tuple[str, ...]:
        """As `Dataset.skipped`, of all data sets."""
        return tuple(line for data in self.parts.values() for line in data.skipped)

    @checked
    def names(self, split: str = "all") -> list[str]:
        """The names of the objects of a split of all data sets, one after the other."""
        return [f"{part}/{name}" for part, data in self.parts.items() for name in data.names(split)]

    def class_of(self, name: str) -> str:
        """The class of one object; the name of its data set where that does not state it."""
        part, _, own = name.partition("/")
        return self.parts[part].class_of(own) or part

    @checked
    def task(self, name: str) -> Task:
        """One object; as `Dataset.task`.

        Raises:
            DataError: no such data set or object, or anything wrong with its files.
        """
        part, _, own = name.partition("/")
        if part not in self.parts:
            known = ", ".join(self.parts)
            raise DataError(Path(part), f"one of the data sets {known}", repr(name), "check the name")
        return replace(self.parts[part].task(own), name=name)


def open_datasets(
    paths: Sequence[str | Path], budget: int = DEFAULT_BUDGET, *, legacy: bool = False
) -> Dataset | Datasets:
    """One data set, or several as one.

    Args:
        paths: as in `open_dataset`.
        budget: as in `Dataset`, for all of them together.
        legacy: as in `Dataset`.

    Returns:
        The data set, or `Datasets` of several.

    Raises:
        ValueError: no folder, or two of the same name.
    """
    if not paths:
        raise ValueError("data: expected at least one folder, got none")
    if len(paths) == 1:
        return open_dataset(paths[0], budget, legacy=legacy)
    names = [Path(path).resolve().name for path in paths]
    if len(set(names)) < len(names):
        raise ValueError(f"data: expected folders of different names, got {', '.join(names)}; rename one")
    share = budget // len(paths)
    return Datasets({name: open_dataset(path, share, legacy=legacy) for name, path in zip(names, paths, strict=True)})


@checked
def read_views(path: str | Path, downscale: int | None = None, *, up: str | None = None) -> Views:
    """All posed images of one scene, over white.

    Args:
        path: a transforms*.json, or a folder that holds some, an SRN object's folder, a COLMAP model, a scene in the
            layout of LLFF, IDR or NSVF, or the .npz of one object. Of a folder with transforms_train, _val and _test
            files, all are read. "example-car" comes with the package.
        downscale: reduce the images by this factor, averaging pixels; None reduces photographs of more than a megapixel
            to at most one.
        up: the direction that points up in the world of the files, which is turned so that it is y, as models expect:
            an axis such as "z" or "-y", three numbers such as "0,0.1,1", or "auto": from how the cameras are held, y
            where they do not tell. None leaves the world as it is, which is right where y is up, as `generate` writes
            it.

    Returns:
        The views in the order of the files; masks where the files have alpha. Where pictures were left out, turned or
        scaled, a UserWarning says which. As `recognise.read_posed`, it raises DataError, and ValueError for another
        `up`.
    """
    path = locate_scene(path)
    with malformed(path, "posed images of one scene"):
        scene = read_posed(path, downscale)
        views = scene.views()
    warn_of(scene.notes, path)
    return views if up is None else upright(views, _up_of(up, views))


def locate_scene(path: str | Path) -> Path:
    """The path, or where a bare name stands for nothing else, the scene of that name that comes with the package.

    Args:
        path: of posed images, or such as "example-car".
    """
    path = Path(path)
    packaged = EXAMPLES / path.name
    return packaged if len(path.parts) == 1 and not path.exists() and packaged.is_dir() else path


@checked
def read_task(path: str | Path, downscale: int | None = None, *, up: str | None = None) -> Task:
    """The support and query views of one scene.

    Args:
        path: a folder with transforms_train.json and transforms_test.json, or one transforms.json (whose
            train_filenames and test_filenames decide, otherwise views alternate), or another layout of one scene.
            "example-car" comes with the package.
        downscale: as in `read_views`.
        up: as in `read_views`.

    Returns:
        The task; its name is the folder's. It warns and raises as `read_views`.
    """
    path = locate_scene(path)
    with malformed(path, "posed images of one scene"):
        task = read_posed_task(path, downscale)
        made = task.task()
    warn_of(task.notes, path)
    return made if up is None else upright_task(made, _up_of(up, made.support, made.query))


def _up_of(up: str, *parts: Views) -> str:
    if up != "auto":
        return up
    return parts[0].up or guess_up(camera.concatenate([part.cameras for part in parts])) or "y"


def warn_of(notes: Sequence[str], path: str | Path) -> None:
    """A UserWarning for each note of a reading."""
    for note in notes:
        warnings.warn(f"{path}: {note}", stacklevel=3)
