"""Measure PSNR by the number of support views, for a model, variants of it, and baselines without learning.

    python -m benchmarks views --checkpoint small --data data/cars data/chairs --json FILE
    python -m benchmarks views --suite procedural random --objects 10 --json FILE
    python -m benchmarks views --suite srn --inputs 64 128 --objects 10 --json FILE

Of every held-out object, some query views are reserved for evaluation. The support views are chosen from all other
views, such that they are as far apart as possible. The methods are: copying the nearest view; blending the support
views on the visual hull (if there are masks), without and with their reflections; the model, with one row for each of
--methods that changes or omits a part of it; and fine-tuning. Each row also has the gain over `hull_blend`, the gain of
gradient steps over as many from random weights, and the gain by residual correction, each with the 95 % interval over
the objects (paired, Student's t).

With --inputs, only these views are support views, and all others are query views. In SRN's protocol, which pixelNeRF
and Splatter Image use, an object has 251 views on a spiral; the support views are view 64, or views 64 and 128.

The suites are the data sets that all models are evaluated on. Their objects are in no training data.
"""

from __future__ import annotations

import argparse
import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import pad

from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.view_tables import OF_CORRECTION
from hyperplanes.adaptation import HullBlend, HyperPlanes, NearestView
from hyperplanes.adaptation.alignment.canonical_frame import to_canonical_frame
from hyperplanes.adaptation.alignment.rotation import RotatedField, Rotation
from hyperplanes.adaptation.base import AdaptedField, Adapter, Pictures, Renderable
from hyperplanes.adaptation.checkpoints import find_checkpoint
from hyperplanes.adaptation.correction.residuals import corrected_field
from hyperplanes.adaptation.correction.stacking import StackedField
from hyperplanes.adaptation.fine_tuned import FineTuned, FromScratch
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.adaptation.symmetry.detection import ReflectedHullBlend
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.data import open_dataset
from hyperplanes.data.support import FarthestSupport, FewerQueries, SupportByPosition
from hyperplanes.data.wrapper import TaskWrapper
from hyperplanes.evaluation import ObjectScore, Score, evaluate, merge_seeds
from hyperplanes.evaluation.comparison import compare
from hyperplanes.export.images import to_pixels
from hyperplanes.utilities.files.encoding import encode_png
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Task, Tasks, Views

__all__ = ["METHODS", "adapters", "add_data_options", "main", "suite_folders"]

QUERY = 3  # default number of query views per object
QUANTITIES = ("psnr", "psnr_foreground", "ssim", "adapt_seconds", "render_seconds")


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks views", description=__doc__)
    add_data_options(parser)
    parser.add_argument("--counts", type=positive, nargs="+", help="numbers of support views (default: 1 3 5 10 25)")
    parser.add_argument("--steps", type=int, nargs="*", default=[], help="numbers of gradient steps, for fine-tuning "
                        "and for the same field from random weights")  # fmt: skip
    parser.add_argument("--seeds", type=positive, default=1, help="number of seeds of the steps; rows have the mean")
    parser.add_argument("--coarse", action="store_true", help="also take the steps without refining the feature grid")
    parser.add_argument("--objects", type=positive, default=3, help="number of objects per data set")
    parser.add_argument("--inputs", type=int, nargs="+", metavar="VIEW", help="instead of --counts: indices of the "
                        "support views, from 0")  # fmt: skip
    parser.add_argument("--query", type=positive, help="query views per object (default: 3; with --inputs, all)")
    parser.add_argument(
        "--methods",
        nargs="*",
        choices=METHODS,
        default=["nearest_view", "hull_blend", "swapped"],
        help="methods other than the model itself",
    )
    parser.add_argument(
        "--rotated", type=float, default=0.0, metavar="DEGREES", help="rotate all scenes about their vertical axes"
    )
    parser.add_argument("--pictures", type=Path, metavar="FILE", help="PNG file for the best, the median and the worst "
                        "view of each data set, by the largest number of support views; the columns are the true image "
                        "and the numbers of views, ascending")  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="one count and two objects, to check that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    if chosen.counts and chosen.inputs:
        parser.error("--counts, --inputs: expected one of the two")
    chosen.counts = chosen.counts or [1, 3, 5, 10, 25]
    folders = suite_folders(parser, chosen)
    if chosen.quick:
        chosen.counts, chosen.objects, chosen.query = [3], 2, 1
    if chosen.inputs:
        chosen.counts = [len(chosen.inputs)]
    opened = [(suite, path, *_opened(path, chosen)) for suite, path in folders]
    model, rows, sheet = HyperPlanes.from_pretrained(find_checkpoint(Path(chosen.checkpoint))), [], []
    for suite, path, data, names, counts in opened:
        seen: dict[int, list[tuple[Tensor, Tensor]]] = {}  # by count, the true image and the picture of every view
        for count in counts:
            shown = _Rotated(_tasks(data, count, chosen), chosen.rotated)
            steps = chosen.steps if count > 1 else []  # fine-tuning needs more than one view
            made = seen.setdefault(count, [])
            about: Row = {"data": path.resolve().name, "views": count, "objects": len(names)}
            about |= {"suite": suite} if suite else {}
            about |= {"rotated": chosen.rotated} if chosen.rotated else {}
            by_seed = [
                adapters(model, shown, names, chosen.methods, steps, coarse=chosen.coarse, seed=seed)
                for seed in range(chosen.seeds)
            ]
            for row in _measured(by_seed, shown, names, made):
                rows.append(about | row)
                print(rows[-1], flush=True)
        sheet += _best_median_worst(seen)
    finish("views", rows, chosen.json)
    if chosen.pictures is not None:
        widest = max(row.shape[2] for row in sheet)
        sheet = [pad(row, (0, widest - row.shape[2]), value=1.0) for row in sheet]
        write_whole(chosen.pictures, encode_png(to_pixels(torch.cat(sheet, 1)[None])[0], small=True))
    return 0


def _tasks(data: Tasks, count: int, chosen: argparse.Namespace) -> Tasks:
    """The objects with the views of --inputs, or else with the `count` views that are farthest apart."""
    if not chosen.inputs:
        return FarthestSupport(data, count, chosen.query or QUERY)
    inputs = SupportByPosition(data, tuple(chosen.inputs))
    return FewerQueries(inputs, chosen.query) if chosen.query else inputs


def _opened(path: Path, chosen: argparse.Namespace) -> tuple[Tasks, list[str], list[int]]:
    """A data set, the objects to evaluate, and the numbers of support views that all of them have.

    Raises:
        DataError: there is no held-out object, or some object has too few views for all of --counts.
    """
    data = open_dataset(path)
    names = sorted(data.names("test"))[: chosen.objects]
    if not names:
        raise DataError(path, "objects in the test split", "none", "generate it with --held-out")
    if chosen.inputs:
        return data, names, chosen.counts
    shown = FarthestSupport(data, max(chosen.counts), chosen.query or QUERY)
    most = min(len(shown.task(name).support) for name in names)
    counts = [count for count in chosen.counts if count <= most]
    if not counts:
        raise DataError(path, f"{min(chosen.counts)} views to show", f"{most}", "choose smaller --counts or --query")
    for count in chosen.counts:
        if count > most:
            print(f"{path}: no rows of {count} views, there are {most} to show", flush=True)
    return data, names, counts


def _measured(
    by_seed: Sequence[Mapping[str, Adapter]], shown: Tasks, names: list[str], made: list[tuple[Tensor, Tensor]]
) -> Iterator[Row]:
    """Evaluate the methods one after the other.

    Args:
        by_seed: the methods by the names of their rows, for every seed.
        shown: the tasks.
        names: of the objects.
        made: a list to which the query views and the pictures of one forward pass are appended.

    Yields:
        The row of each method; for a method with gradient steps, the mean over the seeds.
    """
    scores: dict[str, Score] = {}
    for method in sorted(by_seed[0], key=_after_its_references):
        without_steps = method == "one_step" or method in METHODS
        tried = [each[method] for each in (by_seed[:1] if without_steps else by_seed)]
        keep = partial(_keep, made) if method == "one_step" else None
        score = merge_seeds([evaluate(method, each, shown, names, keep) for each in tried])
        row: Row = {"name": method}
        row |= {"seeds": len(tried)} if len(tried) > 1 else {}
        row |= {each: score.mean(each) for each in QUANTITIES if each in score.quantities}
        row["worst"] = min(each.psnr for each in score.objects)
        corrected = (name if method == "one_step" else f"{method}_{name}" for name in OF_CORRECTION)
        for reference in ("hull_blend", f"scratch_{method.removesuffix('_steps')}", *corrected):
            row |= _above(score, scores[reference]) if reference in scores else {}
        scores[method] = score
        yield row


def _keep(made: list[tuple[Tensor, Tensor]], _: ObjectScore, task: Task, pictures: Pictures, field: Renderable) -> None:
    """Append the query views of an object and their pictures to a list."""
    made.extend(zip(task.query.images, pictures.images, strict=True))


def add_data_options(parser: argparse.ArgumentParser) -> None:
    """Add the options --checkpoint, --data, --suite and --root; `suite_folders` reads the last three."""
    parser.add_argument("--checkpoint", default="small", help="a folder, or the name of a packaged model")
    parser.add_argument("--data", type=Path, nargs="+", help="data sets, or single scenes")
    parser.add_argument("--suite", choices=SUITES, nargs="+", help="instead of --data: suites in the folder --root")
    parser.add_argument("--root", type=Path, default=Path("data"), help="folder with the data sets of the suites")


def suite_folders(parser: argparse.ArgumentParser, chosen: argparse.Namespace) -> list[tuple[str, Path]]:
    """The data sets of --data, or of --suite and --root, each with the name of its suite ("" for --data).

    Wrong options and missing folders are reported by the parser, which exits.
    """
    if (chosen.data is None) == (chosen.suite is None):
        parser.error("--data, --suite: expected one of the two")
    if chosen.suite is None:
        return [("", path) for path in chosen.data]
    folders = [(suite, chosen.root / name) for suite in chosen.suite for name in SUITES[suite]]
    for suite, path in folders:
        if not path.exists():
            parser.error(f"--root: expected {path}, found nothing there; make it by\n  {made_by(suite, path)}")
    return folders


SUITES: dict[str, dict[str, str]] = {
    "procedural": {
        f"{kind}s": f"--class {kind} --count 320 --held-out 20 --resolution 128 --rig random --seed 1300"
        for kind in ("car", "chair", "plane", "lamp")
    },
    "random": {"random-unseen": "--class random --count 12 --held-out 10 --resolution 128 --rig random --seed 9001"},
    "cc0": {
        f"cc0/{kind}": f"--meshes MESHES/{kind} --resolution 128 --rig random --seed 5 --held-out 0.99"
        for kind in ("cars", "chairs", "lamps", "planes", "spacecraft")  # no training data contains spacecraft
    },
    "srn": {
        f"srn/{kind}s": f"--class {kind} --count 12 --held-out 10 --rig srn --seed 1300"
        for kind in ("car", "chair", "plane", "lamp")
    }
    | {
        f"srn/cc0-{kind}": f"--meshes MESHES/{kind} --rig srn --seed 5 --held-out 0.99"
        for kind in ("cars", "chairs", "lamps", "planes")
    },
    "posed": {"chair": ""},
}
"""The data sets of each suite, with the options of `hyperplanes generate` that make them."""


def made_by(suite: str, path: Path) -> str:
    """The command that makes a data set of a suite, or its source."""
    options = next(options for name, options in SUITES[suite].items() if path.as_posix().endswith(name))
    return f"hyperplanes generate {options} --out {path}" if options else "hand: chair of the NeRF synthetic scenes"


def _after_its_references(method: str) -> int:
    """A sort key for methods: those that others are compared with come first."""
    if method == "hull_blend":
        return 0
    return 1 if method.startswith("scratch_") or method.endswith(OF_CORRECTION) else 2


def _above(score: Score, reference: Score) -> Row:
    """The gain in PSNR over another method and, if there are several objects, its interval."""
    found, name = compare(score, reference), f"over_{reference.method}"
    row: Row = {name: found.mean}
    if found.low is not None and found.high is not None:
        row |= {f"{name}_low": found.low, f"{name}_high": found.high}
    return row


@dataclass(frozen=True)
class _Rotated(TaskWrapper):
    """Tasks whose scenes are rotated by an angle in degrees about their vertical axes."""

    degrees: float

    def change(self, task: Task) -> Task:
        rotation = Rotation(math.radians(self.degrees))
        return Task(rotation.views(task.support), rotation.views(task.query), task.name)


def _best_median_worst(seen: Mapping[int, Sequence[tuple[Tensor, Tensor]]]) -> list[Tensor]:
    """Three rows of images: the true image, then the pictures by increasing numbers of support views."""
    most = seen[max(seen)]
    order = sorted(range(len(most)), key=lambda view: -float(psnr(most[view][1][None], most[view][0][None])))
    chosen = (order[0], order[len(order) // 2], order[-1])
    return [torch.cat([most[view][0], *(seen[count][view][1] for count in sorted(seen))], 2) for view in chosen]


def adapters(
    model: HyperPlanes,
    shown: Tasks,
    names: list[str],
    wanted: list[str],
    steps: list[int],
    *,
    coarse: bool = False,
    seed: int = 0,
) -> Mapping[str, Adapter]:
    """The methods by the names of their rows.

    Methods that do not apply are omitted: `swapped` without a hypernetwork or another object, and `hull_blend` without
    masks.

    Args:
        model: the model.
        shown: the tasks.
        names: of the objects.
        wanted: names in METHODS.
        steps: numbers of gradient steps.
        coarse: also take the steps without refining the feature grid.
        seed: of the gradient steps.
    """
    found: dict[str, Adapter] = {}
    for name in wanted:
        needs_others = name == "swapped" and (model.hypernetwork is None or len(names) < 2)
        if not (needs_others or (name.startswith("hull_blend") and shown.task(names[0]).support.masks is None)):
            found[name] = METHODS[name](model, shown, names)
    found["one_step"] = model
    for each in steps:
        settings = FineTuning(seed=seed)
        found[f"{each}_steps"] = tuned = FineTuned(model, each, settings)
        if "uncorrected" in wanted:
            found[f"{each}_steps_uncorrected"] = FineTuned(model.without_residuals(), each, settings)
        if "residuals_alone" in wanted:
            alone = _changed(model, learned_correction=False)
            found[f"{each}_steps_residuals_alone"] = FineTuned(alone, each, settings)
        if "ungated" in wanted:
            found[f"{each}_steps_ungated"] = _Ungated(tuned)
        found[f"scratch_{each}"] = FromScratch(model, each, settings)
        if coarse:
            settings = replace(settings, cells=0)
            found[f"{each}_steps_coarse"] = FineTuned(model, each, settings)
            found[f"scratch_{each}_coarse"] = FromScratch(model, each, settings)
    return found


@dataclass(frozen=True)
class _FieldAlone:
    """A model whose pictures are rendered from its field alone, not averaged with those of `hull_blend`.

    Attributes:
        model: the model.
        updated: use the update of the hypernetwork; otherwise the field has the weights theta.
    """

    model: HyperPlanes
    updated: bool

    @torch.no_grad()
    def adapt(self, support: Views) -> AdaptedField:
        """The field."""
        model = self.model.eval()
        placed = to_canonical_frame(model, support)
        prepared = placed.context(model)
        parameters = model.theta + model.update(prepared) if self.updated else model.theta
        return placed.in_scene(model.rendering_field(prepared, parameters))


def _changed(model: HyperPlanes, **settings: Any) -> HyperPlanes:
    """The model with the same weights and other settings."""
    changed = copy.copy(model)
    changed.config = replace(model.config, **settings)
    return changed


@dataclass(frozen=True)
class _Ungated:
    """A model without its gating network: `hull_blend` has one weight per object, and none in fine-tuned fields."""

    model: HyperPlanes | FineTuned

    def adapt(self, support: Views) -> AdaptedField:
        """The field of the model without the gating network."""
        found = self.model.adapt(support).without_residuals()
        if isinstance(found, RotatedField):
            found = found.rotation.field(_ungated(found.unrotated))
        model = self.model.model if isinstance(self.model, FineTuned) else self.model
        return corrected_field(model, _ungated(found), support)


def _ungated(field: AdaptedField) -> AdaptedField:
    return replace(field, gate=None) if isinstance(field, StackedField) else field


@dataclass(frozen=True)
class _Unreflected:
    """A model that does not use reflections of the views."""

    model: HyperPlanes

    def adapt(self, support: Views) -> AdaptedField:
        """The field that the model makes of the views alone."""
        return self.model.adapt_to(self.model.prepare(support))


@dataclass(frozen=True)
class _Unrotated:
    """A model that does not rotate objects into their canonical frames."""

    model: HyperPlanes

    def adapt(self, support: Views) -> AdaptedField:
        """The field that the model makes in the frame of the scene."""
        return self.model.adapt_to(self.model.prepare(support, symmetry=self.model.find_symmetry(support)))


@dataclass(frozen=True)
class _Rendered:
    """A model whose pictures are rendered with other options, without residual correction.

    Attributes:
        model: the model.
        options: keyword arguments of `AdaptedField.render`.
    """

    model: HyperPlanes
    options: Mapping[str, Any]

    def adapt(self, support: Views) -> Renderable:
        """The field, which renders with these options."""
        return _RenderedField(self.model.adapt(support), self.options)


@dataclass(frozen=True)
class _RenderedField:
    field: AdaptedField
    options: Mapping[str, Any]

    def render(self, cameras: PinholeCamera) -> Pictures:
        return self.field.without_residuals().render(cameras, **self.options)


def _swapped(model: HyperPlanes, shown: Tasks, names: list[str]) -> Adapter:
    return Swapped(model, [shown.task(name).support for name in names])


METHODS = {
    "nearest_view": lambda *_: NearestView(),
    "hull_blend": lambda *_: HullBlend(),
    "hull_blend_reflected": lambda *_: ReflectedHullBlend(),
    "theta": lambda model, *_: _FieldAlone(model, updated=False),
    "swapped": _swapped,
    "unstacked": lambda model, *_: _FieldAlone(model, updated=True),
    "ungated": lambda model, *_: _Ungated(model),
    "unreflected": lambda model, *_: _Unreflected(model),
    "unrotated": lambda model, *_: _Unrotated(model),
    "no_learned_steps": lambda model, *_: _changed(model, learned_steps=0),
    "one_ray": lambda model, *_: _Rendered(model, {"antialias": False}),
    "uncorrected": lambda model, *_: model.without_residuals(),
    "residuals_alone": lambda model, *_: _changed(model, learned_correction=False),
    "single_precision": lambda model, *_: _Rendered(model, {"mixed_precision": False}),
}
