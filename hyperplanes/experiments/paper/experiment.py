"""The parts of an experiment of the paper: trainings, cells, and the table or figure of these cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from hyperplanes.experiments.paper.published import PublishedTable

__all__ = ["ALL_PLANES", "Cell", "Experiment", "Split", "Trained"]

Split = Literal["test", "train", "all"]
"""The objects of a class that are evaluated."""

ALL_PLANES = 25  # support views per object in all of the paper's experiments but one


@dataclass(frozen=True)
class Trained:
    """One training.

    Attributes:
        on: the class of the training objects.
        method: the method, as in `train --method`.
        changes: changed entries of the configuration by their dotted names, such as "model.hypernetwork.views".
        planes: the number of planes of the target network; more than 25 only if support and query views are one set.
        reference: the training whose result this one reads, as "mv_matched" reads that of "mv_meta".
        packaged: the name of a packaged model, which is not trained; otherwise empty.
    """

    on: str
    method: str = "hyperplanes"
    changes: Mapping[str, object] = field(default_factory=dict)
    planes: int = ALL_PLANES
    reference: Trained | None = None
    packaged: str = ""


@dataclass(frozen=True)
class Cell:
    """One number of a table.

    Attributes:
        row: the heading of its row.
        column: the heading of its column.
        trained: the training of the model.
        method: the method, as in `evaluate --method`.
        on: the class of the objects that it is evaluated on.
        split: the objects of this class that are evaluated.
        quantity: the name of a number of `evaluation.ObjectScore`.
        trainable: what fine-tuning optimises. The paper optimises the hypernetwork while theta is frozen.
        views: the number of support views; None for as many as the model has planes.
        query: the number of query views, if the support views are those of the other views that are farthest apart
            (`data.support.FarthestSupport`). With None, the support views are the first ones of the data set, and
            all query views are evaluated.
        orbit: the number of views on a circle around each object that are written to files, if the experiment keeps
            pictures.
    """

    row: str
    column: str
    trained: Trained
    method: str
    on: str
    split: Split = "test"
    quantity: str = "psnr"
    trainable: Literal["hypernetwork", "weights"] = "hypernetwork"
    views: int | None = None
    query: int | None = None
    orbit: int = 0


@dataclass(frozen=True)
class Experiment:
    """A table or a figure of the paper.

    Attributes:
        name: its name for `reproduce`.
        title: its title.
        where: its labels in the paper's LaTeX source.
        size: pixels along a side of the paper's images: 128 or 200.
        epochs: the epochs of the paper's trainings by class, or one number for all classes.
        runs: the number of the paper's runs with different seeds; None if the paper does not state it.
        cells: the cells, row by row.
        figure: "bars" of the table, "curves" of the trainings, "boxes" over seeds and objects, or "steps": PSNR over
            the numbers of steps in the headings of the columns.
        published: the paper's numbers; None if the paper has only a picture.
        notes: notes on what the paper states in words, does not state, or states inconsistently.
        objects: the number of objects per class that are evaluated; None for all.
        published_rows: the headings of the paper's rows by the headings used here, if these differ.
        pictures: the rows for which a figure shows a view by every method, beside the truth.
        keep_pictures: whether the rendered query views of all cells are written to files.
    """

    name: str
    title: str
    where: str
    size: int
    epochs: Mapping[str, int] | int
    runs: int | None
    cells: tuple[Cell, ...]
    figure: Literal["bars", "curves", "boxes", "steps"]
    published: PublishedTable | None = None
    notes: tuple[str, ...] = ()
    objects: int | None = None
    published_rows: Mapping[str, str] = field(default_factory=dict)
    pictures: tuple[str, ...] = ()
    keep_pictures: bool = False

    def of(self, headings: Sequence[str]) -> Experiment:
        """The experiment with some of its rows and columns; without headings, all of them.

        Args:
            headings: headings of rows, of columns or of both.

        Returns:
            The experiment with the cells in these rows and these columns. If there are no headings of one kind, all
            rows or all columns are kept.

        Raises:
            ValueError: an unknown heading, or headings of rows and columns that have no cell in common.
        """
        known = [*self.rows, *self.columns]
        if unknown := [each for each in headings if each not in known]:
            listed = ", ".join(map(repr, known))
            raise ValueError(f"--only: expected headings of {self.name}, {listed}, got {unknown[0]!r}")
        rows = [each for each in headings if each in self.rows] or self.rows
        columns = [each for each in headings if each in self.columns] or self.columns
        kept = tuple(cell for cell in self.cells if cell.row in rows and cell.column in columns)
        if not kept:
            raise ValueError(f"--only: expected headings with a common cell, got {', '.join(map(repr, headings))}")
        return replace(self, cells=kept, pictures=tuple(each for each in self.pictures if each in rows))

    def published_value(self, row: str, column: str) -> float | None:
        """The paper's number for a cell; None if it has none."""
        return None if self.published is None else self.published.value(self.published_row(row), column)

    def published_deviation(self, row: str, column: str) -> float | None:
        """The standard deviation of the paper's number; None if it has none."""
        return None if self.published is None else self.published.deviation(self.published_row(row), column)

    def published_row(self, row: str) -> str:
        """The heading of the paper's row for a row of this experiment; empty if the paper has none."""
        return self.published_rows.get(row, "") if self.published_rows else row

    @property
    def trainings(self) -> list[Trained]:
        """The different trainings, in the order of the cells."""
        found: list[Trained] = []
        for cell in self.cells:
            if cell.trained not in found:
                found.append(cell.trained)
        return found

    @property
    def classes(self) -> list[str]:
        """The classes of all training and evaluated objects."""
        return list(dict.fromkeys(each for cell in self.cells for each in (cell.trained.on, cell.on)))

    @property
    def rows(self) -> list[str]:
        """The headings of the rows, in their order."""
        return list(dict.fromkeys(cell.row for cell in self.cells))

    @property
    def columns(self) -> list[str]:
        """The headings of the columns, in their order."""
        return list(dict.fromkeys(cell.column for cell in self.cells))

    def epochs_of(self, class_name: str) -> int:
        """The epochs of the paper's training on a class."""
        return self.epochs if isinstance(self.epochs, int) else self.epochs[class_name]
