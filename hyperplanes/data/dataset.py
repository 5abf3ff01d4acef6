"""A data set of few-shot tasks, and functions that read a single scene."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hyperplanes.data.formats.catalogue import SPLITS
from hyperplanes.data.formats.recognise import find_catalogue, read_posed, read_posed_task
from hyperplanes.data.packaged import locate_scene
from hyperplanes.data.pictures.posed import PosedTask
from hyperplanes.data.upright import guess_up, upright, upright_task
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.files.reading import DataError, malformed
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.lru_cache import LRUCache
from hyperplanes.views import Task, Views

__all__ = ["Dataset", "Datasets", "open_dataset", "open_datasets", "read_task", "read_views"]

DEFAULT_BUDGET = 2 * 2**30


class Dataset:
    """The objects of a data set, read on demand. An LRU cache keeps their 8-bit images.

    Args:
        folder: a data set, a folder of posed scenes, or a single posed scene, in a layout that `find_catalogue`
            recognises.
        budget: size of the cache in bytes of decoded images.
        legacy: place the principal points of learnit's and the HyperPlanes authors' layouts at W / 2 at integer pixel
            centres, as the code published with these data does, instead of at the middle of the images.

    Raises:
        DataError: no known layout was found, an object is listed twice, or `legacy` was given for another layout.
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
        """The content of manifest.json. Without this file: the classes of the objects if known, otherwise empty."""
        return self._catalogue.manifest

    @property
    def skipped(self) -> tuple[str, ...]:
        """A message about each list of objects of which some were skipped."""
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
        """The class of one object, which `manifest` states; empty if it does not."""
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
            New tensors at every call, since only the 8-bit images are cached. Raises DataError as `posed` does.
        """
        return self.posed(name).task()

    @checked
    def posed(self, name: str) -> PosedTask:
        """The 8-bit support and query images of one object. Calls share them, so they must not be changed.

        Args:
            name: one of `names()`.

        Returns:
            The images with their cameras. A UserWarning names what was left out, rotated or scaled.

        Raises:
            DataError: no such object, or a file of it is missing or invalid.
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
    """Check that every object is in only one split, and once, so that none is used for training and evaluation."""
    seen: dict[str, str] = {}
    for split, names in splits.items():
        for name in names:
            if name in seen:
                both = f"{name} in {seen[name]} and in {split}" if seen[name] != split else f"{name} twice in {split}"
                raise DataError(folder, "every object in one split", both, "take it out of one of them")
            seen[name] = split


@checked
def open_dataset(path: str | Path, budget: int = DEFAULT_BUDGET, *, legacy: bool = False) -> Dataset:
    """A data set in any layout. A single posed scene becomes a data set with one test task.

    Args:
        path: a folder, or a transforms file. "example-car" comes with the package.
        budget: as in `Dataset`.
        legacy: as in `Dataset`.

    Returns:
        The data set, whose objects are read on demand. Raises DataError as `Dataset` does.
    """
    return Dataset(locate_scene(path), budget, legacy=legacy)


class Datasets:
    """Several data sets as one. The name of an object is DATASET/OBJECT.

    Args:
        parts: the data sets by their names.
    """

    def __init__(self, parts: Mapping[str, Dataset]) -> None:
        self.parts = dict(parts)

    @property
    def skipped(self) -> tuple[str, ...]:
        """The messages of `Dataset.skipped` of all data sets."""
        return tuple(line for data in self.parts.values() for line in data.skipped)

    @checked
    def names(self, split: str = "all") -> list[str]:
        """The names of the objects of a split of all data sets, one after the other."""
        return [f"{part}/{name}" for part, data in self.parts.items() for name in data.names(split)]

    def class_of(self, name: str) -> str:
        """The class of one object; the name of its data set if that does not state the class.

        Args:
            name: one of `names()`.

        Returns:
            The class. Raises DataError if there is no such data set.
        """
        data, own = self._find(name)
        return data.class_of(own) or name.partition("/")[0]

    @checked
    def task(self, name: str) -> Task:
        """One object; as `Dataset.task`.

        Args:
            name: one of `names()`.

        Returns:
            As `Dataset.task`. Raises DataError if there is no such data set.
        """
        data, own = self._find(name)
        return replace(data.task(own), name=name)

    def _find(self, name: str) -> tuple[Dataset, str]:
        """The data set of an object, and the name of the object in it; DataError if there is no such data set."""
        part, _, own = name.partition("/")
        if part not in self.parts:
            known = ", ".join(self.parts)
            raise DataError(Path(part), f"one of the data sets {known}", repr(name), "check the name")
        return self.parts[part], own


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
        ValueError: no folder, or two folders of the same name.
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
    """All posed images of one scene, composited over white.

    Args:
        path: a transforms*.json file, the .npz file of one object, or the folder of a scene in any layout that is
            read, such as nerfstudio's, SRN's, COLMAP's, LLFF's, IDR's or NSVF's. If a folder has the files
            transforms_train.json, _val and _test, all are read. "example-car" comes with the package.
        downscale: reduce the images by this factor, averaging pixels. None reduces photographs to at most a megapixel.
        up: the direction that points up in the world of the files. The scene is rotated so that it becomes y, as
            models expect. An axis such as "z" or "-y", three numbers such as "0,0.1,1", or "auto": the direction that
            the files state, otherwise the one that `guess_up` estimates from the cameras, otherwise y. None does not
            rotate the scene, which is right if y is up, as in data sets that `generate` writes.

    Returns:
        The views in the order of the files, with masks if the files have alpha. A UserWarning names images that were
        left out, rotated or scaled. Raises DataError as `recognise.read_posed` does, and ValueError for another `up`.
    """
    path = locate_scene(path)
    with malformed(path, "posed images of one scene"):
        scene = read_posed(path, downscale)
        views = scene.views()
    warn_of(scene.notes, path)
    return views if up is None else upright(views, _up_of(up, views))


@checked
def read_task(path: str | Path, downscale: int | None = None, *, up: str | None = None) -> Task:
    """The support and query views of one scene.

    Args:
        path: a folder with transforms_train.json and transforms_test.json; or one transforms.json, which is split by
            its train_filenames and test_filenames, or without these alternately; or another layout of one scene.
            "example-car" comes with the package.
        downscale: as in `read_views`.
        up: as in `read_views`.

    Returns:
        The task, named after the folder (or .npz file). Warns and raises as `read_views` does.
    """
    path = locate_scene(path)
    with malformed(path, "posed images of one scene"):
        task = read_posed_task(path, downscale)
        made = task.task()
    warn_of(task.notes, path)
    return made if up is None else upright_task(made, _up_of(up, made.support, made.query))


def _up_of(up: str, *parts: Views) -> str:
    """The up direction that `read_views` describes."""
    if up != "auto":
        return up
    return parts[0].up or guess_up(camera.concatenate([part.cameras for part in parts])) or "y"


def warn_of(notes: Sequence[str], path: str | Path) -> None:
    """Issue a UserWarning for each note of a reader."""
    for note in notes:
        warnings.warn(f"{path}: {note}", stacklevel=3)
