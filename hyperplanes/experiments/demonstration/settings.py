"""The demonstration as experiments: its trainings, its evaluations and its size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hyperplanes.experiments.paper.experiment import Cell, Experiment, Trained
from hyperplanes.experiments.paper.scales import Scale
from hyperplanes.methods import at_steps, describe_method
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.utilities.files.reading import folder_checksum
from hyperplanes.utilities.messages.shell import command_line

__all__ = ["MODELS", "PACKAGED_MODEL", "TUNED_METHODS", "DemoSettings", "describe_row"]

TUNED_METHODS = ("hyperplanes", "scratch")
"""Methods in the chart of PSNR over fine-tuning steps."""

MODELS = ("hyperplanes", "point_multiplane")
"""The models that are trained, each in a folder of its name."""

BASELINES = ("nearest_view", "hull_blend")
"""Methods without learned weights, in the tables of both pages."""

PACKAGED_MODEL = "small"
QUERY_VIEWS = 2  # of each object on the page of the packaged model
MAX_OBJECTS = 12  # objects on that page

TINY = {
    "model.network.depth": 2,
    "model.network.width": 16,
    "model.hypernetwork.views": 12,  # scaled from the paper's 50 views to 12: three HyperPlanes
    "model.hypernetwork.code": 8,
    "model.hypernetwork.depth": 1,
    "model.hypernetwork.width": 16,
    "model.sampling": RayMarching(steps=16),
    "model.hull_resolution": 16,
    "training.rays": 32,
    "training.warmup": 0,
    "training.checkpoint_every": 10,
}
"""Changes to networks that are too small to learn anything."""


@dataclass(frozen=True)
class DemoSettings:
    """The settings of the demonstration.

    Attributes:
        class_name: the class of the procedural objects.
        objects: the number of objects, including the held-out ones.
        held_out: the number of held-out objects.
        resolution: pixels along a side of the images.
        views: views per object, half support and half query views.
        preset: the preset that is trained.
        steps: the steps of every training.
        seed: the seed of the data, the trainings and the evaluation.
        exhibits: the number of objects in the report.
        frames: the frames of each turntable.
        unseen_objects: the number of evaluated objects of another class, on which no model is trained.
        fine_tuned: the numbers of fine-tuning steps in the rows of the table, a small one and a large one.
        tuning: the numbers of fine-tuning steps in the chart of fine-tuning.
        tuned_objects: the number of held-out objects in that chart.
        first: classes of which the packaged model renders one object each, before anything is trained.
        first_resolution: pixels along a side of their images.
        first_counts: the numbers of support views that it is given of each object.
        meshes: a folder of mesh files that it renders too.
        tiny: whether networks are too small to learn anything, to check that everything runs.
    """

    class_name: str = "car"
    objects: int = 155
    held_out: int = 5
    resolution: int = 64
    views: int = 50
    preset: str = "quick"
    steps: int = 800
    seed: int = 0
    exhibits: int = 5
    frames: int = 36
    unseen_objects: int = 2
    fine_tuned: tuple[int, int] = (10, 100)
    tuning: tuple[int, ...] = (0, 1, 3, 10, 30, 100)
    tuned_objects: int = 1
    first: tuple[str, ...] = ("car", "chair", "plane", "lamp")
    first_resolution: int = 128
    first_counts: tuple[int, ...] = (3, 10, 25)
    meshes: Path | None = None
    tiny: bool = False

    @property
    def unseen_class(self) -> str:
        """The class of the objects on which no model is trained."""
        return "car" if self.class_name == "chair" else "chair"

    @property
    def first_frames(self) -> int:
        """The number of frames of each turntable on the first page."""
        return max(1, self.frames // 2)

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that are evaluated on held-out objects of the training class."""
        few, many = self.fine_tuned
        tuned = (f"hyperplanes_{few}", f"hyperplanes_{many}", f"scratch_{many}")
        return (*BASELINES, "point_multiplane", "hyperplanes_swapped", "hyperplanes", *tuned)

    @property
    def rows(self) -> tuple[str, ...]:
        """All rows of the table: `methods`, and METHOD:CLASS for methods that are evaluated on the unseen class."""
        many = self.fine_tuned[1]
        unseen = (*BASELINES, "hyperplanes", f"hyperplanes_{many}", f"scratch_{many}")
        return (*self.methods, *(f"{method}:{self.unseen_class}" for method in unseen))

    @property
    def table(self) -> Experiment:
        """Every method on held-out objects of the training class, and some methods on objects of the unseen class."""
        return self._experiment([self._cell(row, *row.split(":")) for row in self.rows], keep_pictures=True)

    @property
    def fine_tuning(self) -> Experiment:
        """The experiment on PSNR after several numbers of fine-tuning steps."""
        rows = [row for method in TUNED_METHODS for row in at_steps(method, self.tuning)]
        return self._experiment([self._cell(row, row) for row in rows], objects=self.tuned_objects)

    @property
    def packaged(self) -> Experiment:
        """The packaged model on objects that it was not trained on: a row per number of views, a column per class."""
        rows = dict.fromkeys(BASELINES, self.first_counts[-1])
        rows |= {f"views_{count}": count for count in self.first_counts}
        cells = []
        for row, count in rows.items():
            method = row if row in BASELINES else "hyperplanes"
            for on in (*self.first, *(["meshes"] if self.meshes else [])):
                trained = Trained(on, packaged=PACKAGED_MODEL)
                orbit = self.first_frames if row == f"views_{self.first_counts[-1]}" else 0
                cells.append(Cell(row, on, trained, method, on, "all", views=count, query=QUERY_VIEWS, orbit=orbit))
        return self._experiment(cells, objects=MAX_OBJECTS - len(self.first), keep_pictures=True)

    def _cell(self, row: str, method: str, on: str = "") -> Cell:
        # either training has the architecture for random weights; PointMultiPlaneNeRF ends first
        trained = Trained(self.class_name, "hyperplanes" if method.startswith("hyperplanes") else "point_multiplane")
        return Cell(row, "", trained, method, on or self.class_name, trainable="weights")

    def _experiment(
        self, cells: Sequence[Cell], *, objects: int | None = None, keep_pictures: bool = False
    ) -> Experiment:
        size, cells = self.resolution, tuple(cells)
        named = Experiment("demonstration", "The demonstration", "", size, epochs=1, runs=1, cells=cells, figure="bars")
        return replace(named, objects=objects, keep_pictures=keep_pictures)

    @property
    def scale(self) -> Scale:
        """The scale of the trainings and of the data sets of both classes."""
        unseen = {"objects": self.unseen_objects, "held_out": self.unseen_objects}
        return Scale(
            name="demonstration",
            presets={self.resolution: self.preset},
            resolution=self.resolution,
            objects=self.objects,
            held_out=self.held_out,
            views=self.views,
            steps=self.steps,
            changes=TINY if self.tiny else {},
            data={self.class_name: {"seed": self.seed}, self.unseen_class: {"seed": self.seed, **unseen}},
        )

    def packaged_scale(self, out: Path) -> Scale:
        """The scale for the packaged model: one object per class with random cameras, and the mesh files.

        Args:
            out: the folder of the demonstration, whose files are not counted as mesh files.
        """
        drawn: dict[str, object] = {"rig": "random", "seed": self.seed, "views": self.views}
        data: dict[str, Mapping[str, object]] = dict.fromkeys(self.first, drawn)
        if self.meshes is not None:
            data["meshes"] = {**drawn, "meshes": str(self.meshes), "contents": folder_checksum(self.meshes, out)}
        return Scale(
            name="demonstration",
            presets={self.resolution: self.preset},
            resolution=self.first_resolution,
            objects=1,
            held_out=1,
            data=data,
        )

    def command(self, out: Path) -> str:
        """The command that makes, or resumes, a demonstration with these settings.

        Args:
            out: the folder of the demonstration.
        """
        usual = DemoSettings.quick_check() if self.tiny else DemoSettings()
        options = [] if self.class_name == usual.class_name else ["--class", self.class_name]
        for name in ("objects", "held_out", "resolution", "preset", "steps", "seed", "meshes"):
            if getattr(self, name) != getattr(usual, name):
                options += [f"--{name.replace('_', '-')}", getattr(self, name)]
        return command_line("hyperplanes", "demo", "--out", out, ["--quick-check"] * self.tiny, options)

    @classmethod
    def quick_check(cls, seed: int = 0) -> DemoSettings:
        """Settings of a demonstration that takes seconds and only checks that everything runs."""
        return cls(
            objects=4,
            held_out=2,
            resolution=24,
            views=12,
            steps=20,
            seed=seed,
            exhibits=1,
            frames=6,
            unseen_objects=1,
            fine_tuned=(1, 2),
            tuning=(0, 2, 5),
            tuned_objects=1,
            first=("car",),
            first_resolution=24,
            first_counts=(3,),
            tiny=True,
        )


def describe_row(row: str) -> str:
    """The description of a row of the table."""
    method, _, class_name = row.partition(":")
    return describe_method(method) + (f", on {class_name}s: a class never trained on" if class_name else "")
