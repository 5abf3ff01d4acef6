"""The steps of the demonstration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from hyperplanes.evaluation import Score
from hyperplanes.experiments.demonstration.report import compile_kernels, describe_count, write_first_page, write_report
from hyperplanes.experiments.demonstration.settings import MODELS, TUNED_METHODS, DemoSettings
from hyperplanes.experiments.engine import OnScore, Runner
from hyperplanes.experiments.paper.experiment import Cell
from hyperplanes.experiments.paper.scales import Scale
from hyperplanes.experiments.workspace import Workspace
from hyperplanes.methods import at_steps
from hyperplanes.utilities.files.writing import write_json

__all__ = ["Demonstration"]


class Demonstration:
    """The demonstration: the packaged model, data, trainings, evaluations and two pages.

    Args:
        settings: the settings of the demonstration.
        out: the folder for all results.
        make_runner: makes a `Runner` from a workspace and a scale.
        begin: called before each piece of work.
        say: prints a line.
        evaluating: makes, from the title of a row, a context for its evaluation, which yields a function that is called
            with each score.
    """

    def __init__(
        self,
        settings: DemoSettings,
        out: Path,
        make_runner: Callable[[Workspace, Scale], Runner],
        begin: Callable[[], None],
        say: Callable[[str], None],
        evaluating: Callable[[str], AbstractContextManager[OnScore]],
    ) -> None:
        self.settings, self.out, self.say, self.evaluating = settings, out, say, evaluating
        classes = [*settings.first, "meshes"]
        first = Workspace(out / "first", {name: name for name in classes}, begin)
        self.packaged = make_runner(first, settings.packaged_scale(out))
        places = {settings.class_name: "data", settings.unseen_class: "unseen"} | {name: name for name in MODELS}
        self.runner = make_runner(Workspace(out, places, begin), settings.scale)

    def steps(self) -> dict[str, Callable[[], object]]:
        """The functions of the steps by name, in their order. Each does only what was not done before."""
        table, seed = self.settings.table, self.settings.seed
        return {
            "packaged model": self.show_packaged,
            "data": lambda: [self.runner.data.folder(name) for name in table.classes],
            "train": partial(self.runner.train_all, table, seed, [table, self.settings.fine_tuning]),
            **{f"evaluate {c.row}": partial(self.evaluate, c) for c in table.cells},
            "fine-tuning": self.tune,
            "report": self.report,
        }

    def show_packaged(self) -> None:
        """Evaluate the packaged model and write first.html."""
        settings, page = self.settings, self.out / "first.html"
        names = ("first", "first_resolution", "first_counts", "seed", "frames")
        meshes = "" if settings.meshes is None else self.packaged.data.name("meshes")
        deciding = {name: getattr(settings, name) for name in names} | {"meshes": meshes}
        self.packaged.workspace.make(page.name, deciding, [page], lambda: self._show_packaged(page))

    def _show_packaged(self, page: Path) -> None:
        experiment, scores = self.settings.packaged, {}
        with ThreadPoolExecutor(1) as beside:
            # compile kernels while other processes render the data
            ready = beside.submit(compile_kernels, self.packaged.device)
            for name in sorted(experiment.classes, key=lambda name: name != "meshes"):  # first, as they may be invalid
                self.packaged.data.folder(name)
            ready.result()
        for row in experiment.rows:
            cells = [cell for cell in experiment.cells if cell.row == row]
            found = [self.packaged.score(experiment, cell, self.settings.seed) for cell in cells]
            scores[row] = Score(row, tuple(each for score in found for each in score.objects))
            self.say(f"{describe_count(row, self.settings.first_counts[-1])}: {scores[row].mean('psnr'):.2f} dB")
        write_first_page(page, self.packaged, self.settings, scores)
        self.say(f"the first page: {page.resolve().as_uri()}")

    def evaluate(self, cell: Cell) -> None:
        """Evaluate a row of the table; workers, if any, continue with the next rows and the chart of fine-tuning."""
        for experiment in (self.settings.table, self.settings.fine_tuning):
            self.runner.start(experiment, self.settings.seed)
        with self.evaluating(cell.row) as on_score:
            self.runner.score(self.settings.table, cell, self.settings.seed, on_score)

    def tune(self) -> None:
        """Evaluate PSNR over fine-tuning steps and write tuning.json, by method and number of steps."""
        path = self.out / "tuning.json"
        self.runner.workspace.make("fine-tuning", self._deciding, [path], lambda: self._tune(path))

    def _tune(self, path: Path) -> None:
        found: dict[str, float] = {}
        for cell in self.settings.fine_tuning.cells:
            found[cell.row] = self.runner.score(self.settings.fine_tuning, cell, self.settings.seed).mean("psnr")
            self.say(f"{cell.row}: {found[cell.row]:.2f} dB")
        steps = self.settings.tuning
        write_json(path, {m: {str(n): found[row] for n in steps for row in at_steps(m, [n])} for m in TUNED_METHODS})

    def report(self) -> None:
        """Write the page, its picture and metrics.json."""
        outputs = [self.out / name for name in ("metrics.json", "report.html", "overview.png")]
        shown = {"exhibits": self.settings.exhibits, "frames": self.settings.frames}
        work = partial(write_report, self.out, self.runner, self.settings)
        self.runner.workspace.make("report", {**self._deciding, **shown}, outputs, work)

    @property
    def _deciding(self) -> Mapping[str, object]:
        """The settings on which evaluations depend: data, trainings, and the numbers of fine-tuning steps."""
        settings, runner, table = self.settings, self.runner, self.settings.table
        return {
            "data": [runner.data.name(name) for name in table.classes],
            "trainings": [runner.trainings.name(table, each, settings.seed) for each in table.trainings],
            "rows": settings.rows,
            "tuning": settings.tuning,
            "tuned_objects": settings.tuned_objects,
        }
