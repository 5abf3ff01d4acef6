"""What an experiment of the paper is made of: trainings, cells, and the table or figure that they fill."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from hyperplanes.experiments.published import PublishedTable

__all__ = ["ALL_PLANES", "Cell", "Experiment", "Split", "Trained"]

Split = Literal["test", "train", "all"]
"""Which objects of a class are evaluated."""

ALL_PLANES = 25  # support views of an object in all of the paper's experiments but one


@dataclass(frozen=True)
class Trained:
    """What is trained.

    Attributes:
        on: the class of its objects.
        method: as `train --method` names it.
        changes: entries of the configuration by their dotted names, such as "model.hypernetwork.views".
        planes: of the target network; more than 25 only where support and query views are one set.
        reference: the training whose result this one reads, as "mv_matched" does that of "mv_meta".
        packaged: the name of a model that comes with the package and is not trained here; empty where it is.
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
        row: its heading.
        column: its heading.
        trained: the model.
        method: as `evaluate --method` names it.
        on: the class of the objects that it is evaluated on.
        split: which of them.
        quantity: a number of `evaluation.ObjectScore`.
        trainable: what fine-tuning optimises; "hypernetwork" with theta frozen is the paper's way.
        views: support views that are shown; as many as the model has planes where None.
        query: query views that are kept back, where the views that are shown are chosen as far apart as all of them
            stand; all query views where None, and the first support views are shown.
        orbit: views on a circle around each object that are kept as files, where pictures are.
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
        name: what `reproduce` calls it.
        title: in words.
        where: its labels in the paper's LaTeX source.
        size: pixels a side of the paper's images: 128 or 200.
        epochs: of the paper's trainings, by class; a number for all of them.
        runs: with other seeds, in the paper; None where it does not say how many.
        cells: row by row.
        figure: "bars" of the table, "curves" of the trainings, "boxes" over seeds and objects, or "steps": PSNR over
            the numbers of steps in the columns' headings.
        published: the paper's numbers; None where the paper only has a picture.
        notes: what the paper says in words, leaves open or says twice.
        objects: evaluated a class; None for all.
        published_rows: headings of the paper's rows by ours, where ours say more.
        pictures: rows of which a view is shown by every method, beside the truth; none where empty.
        keep_pictures: whether the query views of all cells are kept as files, where a folder is an experiment's own.
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
        """The same with some rows and columns alone; all of them where no heading is given.

        Args:
            headings: of rows, columns or both.

        Returns:
            The cells whose row or column, or of headings of both kinds whose row and column, are among them.

        Raises:
            ValueError: a heading that the table has not, or headings of which no cell has two.
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
        """The paper's number beside a cell; None where it has none."""
        return None if self.published is None else self.published.value(self.published_row(row), column)

    def published_deviation(self, row: str, column: str) -> float | None:
        """Its standard deviation; None where the paper has none."""
        return None if self.published is None else self.published.deviation(self.published_row(row), column)

    def published_row(self, row: str) -> str:
        """The heading of the paper's row beside ours; empty where it has none."""
        return self.published_rows.get(row, "") if self.published_rows else row

    @property
    def trainings(self) -> list[Trained]:
        """What is trained, each once."""
        found: list[Trained] = []
        for cell in self.cells:
            if cell.trained not in found:
                found.append(cell.trained)
        return found

    @property
    def classes(self) -> list[str]:
        """The classes whose objects are needed."""
        return list(dict.fromkeys(each for cell in self.cells for each in (cell.trained.on, cell.on)))

    @property
    def rows(self) -> list[str]:
        """The headings of the rows in their order."""
        return list(dict.fromkeys(cell.row for cell in self.cells))

    @property
    def columns(self) -> list[str]:
        """The headings of the columns in their order."""
        return list(dict.fromkeys(cell.column for cell in self.cells))

    def epochs_of(self, class_name: str) -> int:
        """The paper's epochs on a class."""
        return self.epochs if isinstance(self.epochs, int) else self.epochs[class_name]
