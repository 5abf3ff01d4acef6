"""The data sets of an experiment: some are given, and the others are generated at its scale."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch

from hyperplanes.data import open_dataset
from hyperplanes.data.devices import TasksOnDevice
from hyperplanes.data.support import WithBounds
from hyperplanes.experiments.paper.scales import Scale
from hyperplanes.experiments.workspace import Workspace, unique_name
from hyperplanes.utilities.files.reading import folder_checksum
from hyperplanes.views import Tasks

__all__ = ["DataSets"]


class DataSets:
    """Data sets by class. Each is opened once; classes without a given data set are generated.

    Args:
        workspace: the folder in which data sets are generated.
        scale: the scale of the experiment, with the numbers of objects and views and the size of images.
        generate: called with the settings of a data set and its folder; it resumes an interrupted generation.
        device: the device of the views.
        given: folders of given data sets by class.
        legacy: as in `open_dataset`, for given data sets.
    """

    def __init__(
        self,
        workspace: Workspace,
        scale: Scale,
        *,
        generate: Callable[[Mapping[str, Any], Path], None],
        device: torch.device,
        given: Mapping[str, Path] | None = None,
        legacy: bool = False,
    ) -> None:
        self.workspace, self.scale, self.generate, self.device = workspace, scale, generate, device
        self.given, self.legacy = given or {}, legacy
        self.generated: dict[str, Path] = {}  # data sets that the parent of a worker process has generated
        self._tasks: dict[str, TasksOnDevice] = {}
        self._names: dict[str, str] = {}  # names of given data sets, whose checksums are computed once

    def tasks(self, class_name: str) -> Tasks:
        """The data set of a class; ValueError if none was given and the scale generates none."""
        if class_name not in self._tasks:
            folder = self.folder(class_name)
            data: Tasks = open_dataset(folder, legacy=self.legacy and class_name in self.given)
            if self.scale.bounds is not None:
                data = WithBounds(data, self.scale.bounds)
            self._tasks[class_name] = TasksOnDevice(data, self.device)
        return self._tasks[class_name]

    def folder(self, class_name: str) -> Path:
        """The folder of the data set of a class, which is generated if necessary; ValueError as for `tasks`."""
        if class_name in self.given:
            return self.given[class_name].resolve()
        if class_name in self.generated:
            return self.generated[class_name]
        settings = self._settings(class_name)
        work = partial(self.generate, settings)
        return self.workspace.folder("data", class_name, self.name(class_name), settings, work)

    def name(self, class_name: str) -> str:
        """A unique name of the data set of a class: the class, or the folder of a given one, with a checksum."""
        if class_name in self.given:
            if class_name not in self._names:
                folder = self.given[class_name].resolve()
                self._names[class_name] = f"{folder}-{folder_checksum(folder, self.workspace.out)}"
            return self._names[class_name]
        return unique_name(class_name, self._settings(class_name))

    def evaluated(self, class_name: str, split: str, most: int | None = None) -> list[str]:
        """The objects of a class that are evaluated, at most `most`; ValueError if there are none."""
        found = list(self.tasks(class_name).names(split))
        if not found:
            raise ValueError(f"data: expected {class_name} objects in the {split} split, got none")
        if split == "train" and self.scale.held_out:  # as many training objects as held-out objects
            found = found[: self.scale.held_out]
        return found[: self.scale.evaluated][:most]

    @property
    def reading(self) -> dict[str, Any]:
        """The settings of reading data sets that are not the defaults, as values for JSON."""
        bounds = {} if self.scale.bounds is None else {"bounds": asdict(self.scale.bounds)}
        return ({"legacy": True} if self.legacy else {}) | bounds

    def _settings(self, class_name: str) -> dict[str, Any]:
        scale = self.scale
        if scale.resolution is None:
            raise ValueError(
                f"data: expected --data {class_name}=FOLDER, because the scale {scale.name} needs the published data "
                "sets, got none; or give --scale small"
            )
        sizes = {name: getattr(scale, name) for name in ("resolution", "objects", "held_out", "views")}
        return {"class": class_name, **sizes, **scale.data.get(class_name, {})}
