"""The ten experiments of the paper as data: their trainings, their evaluations, and their places in the paper."""

from __future__ import annotations

from collections.abc import Mapping

from hyperplanes.experiments.paper.experiment import ALL_PLANES, Cell, Experiment, Split, Trained
from hyperplanes.experiments.paper.published import CROSS, SHAPENET, SINGLE, TARGET, TIME
from hyperplanes.utilities.entry_points import load_entries
from hyperplanes.utilities.messages.errors import did_you_mean

__all__ = ["CLASS_OF_COLUMN", "EXPERIMENTS", "find_experiment", "find_experiments"]

CLASS_OF_COLUMN = {"Cars": "car", "Chairs": "chair", "Planes": "plane", "Lamps": "lamp"}
"""The names of the classes of `generate` by the paper's headings."""

EPOCHS_128 = {"car": 1000, "lamp": 1100, "chair": 700}
EPOCHS_200 = {"car": 2420, "plane": 2460, "chair": 1920}

LEARNED_COLUMNS = {
    "Standard": ("standard", "mv_meta"),
    "MV Matched": ("mv_matched", "mv_matched"),
    "MV Shuffled": ("mv_shuffled", "mv_meta"),
    "MV Meta": ("mv_meta", "mv_meta"),
    "SV Meta": ("sv_meta", "sv_meta"),
}
"""Methods of Tancik et al., each with the training that it needs. "standard" only needs its architecture."""
SUPPORT_COUNTS = (1, 3, 5, 25)
"""Numbers of support views in the table of learned initialisations; the paper does not state how many these had."""
TARGET_COLUMNS = {"NeRF": "nerf", "MultiPlaneNeRF": "multiplane", "PointMultiPlaneNeRF": "point_multiplane"}
TUNED_COLUMNS = {
    "HyperPlanes-0": "hyperplanes",
    "HyperPlanes-10": "hyperplanes_10",
    "HyperPlanes-100": "hyperplanes_100",
}
ALL_WEIGHTS = "HyperPlanes-100, all weights"
"""100 steps on theta + delta as in `render --steps 100`, with fewer rays at the scale `small`; not in the paper."""


ALL_READ: Mapping[str, object] = {"model.hypernetwork.views": 25}
"""25 HyperPlanes, as in the paper at 200x200 (tab:cross)."""


def _hyperplanes(on: str, changes: Mapping[str, object] | None = None, planes: int = ALL_PLANES) -> Trained:
    return Trained(on, changes=changes or {}, planes=planes)


def _tuned(row: str, trained: Trained, on: str, split: Split = "test") -> list[Cell]:
    cells = [Cell(row, column, trained, method, on, split) for column, method in TUNED_COLUMNS.items()]
    return [*cells, Cell(row, ALL_WEIGHTS, trained, "hyperplanes_100", on, split, trainable="weights")]


def _shapenet() -> Experiment:
    columns = {name: CLASS_OF_COLUMN[name] for name in SHAPENET.columns}
    cells: list[Cell] = []
    for views in SUPPORT_COUNTS:
        for name, (method, training) in LEARNED_COLUMNS.items():
            for column, on in columns.items():
                reference = Trained(on, "mv_meta") if training == "mv_matched" else None
                trained = Trained(on, training, reference=reference)
                cells.append(Cell(_with_views(name, views), column, trained, f"{method}_2000", on, views=views))
        for name, packaged in (("HyperPlanes", ""), ("small", "small")):
            for column, on in columns.items():
                trained = Trained(on, packaged=packaged)
                cells.append(Cell(_with_views(name, views), column, trained, "hyperplanes", on, views=views))
    published = {_with_views(name, 1): name for name in LEARNED_COLUMNS} | {
        _with_views("HyperPlanes", 25): "HyperPlanes"
    }
    return Experiment(
        "shapenet",
        "Hypernetwork against gradient-based updates",
        "tab:shapenet",
        128,
        EPOCHS_128,
        None,
        tuple(cells),
        "bars",
        SHAPENET,
        (
            "The paper gives HyperPlanes 25 support views and does not say how many the methods of Tancik et al. were "
            "given for their 2,000 steps. Their published notebook (tancik/learnit, Experiments/shapenet.ipynb, "
            "test_time_views = 1) evaluates every training with one, so the paper's numbers are beside 1 view, as a "
            "guess.",
            "small: the packaged model of any number of views, trained by this project on four procedural classes at "
            "128x128; not in the paper.",
        ),
        published_rows=published,
    )


def _with_views(name: str, views: int) -> str:
    return f"{name}, {views} view{'s' if views > 1 else ''}"


def _cross_class() -> Experiment:
    names = ("Cars", "Chairs", "Planes")
    cells: list[Cell] = []
    for source in names:
        on = _hyperplanes(CLASS_OF_COLUMN[source], ALL_READ)
        for target in names:
            row = f"{source} on {target}"
            for column in ("MultiPlaneNeRF", "PointMultiPlaneNeRF"):  # the latter is the field of HyperPlanes alone
                plain = Trained(CLASS_OF_COLUMN[source], TARGET_COLUMNS[column])
                cells.append(Cell(row, column, plain, TARGET_COLUMNS[column], CLASS_OF_COLUMN[target]))
            cells += _tuned(row, on, CLASS_OF_COLUMN[target])
    return Experiment(
        "cross-class",
        "Trained on one class, tested on each",
        "tab:cross",
        200,
        EPOCHS_200,
        5,
        tuple(cells),
        "bars",
        CROSS,
        (
            "The paper's MultiPlaneNeRF has 24.91 dB for cars and 24.27 for planes here, and 24.79 and 24.26 in "
            "tab:single_inference.",
            "PointMultiPlaneNeRF: the field of HyperPlanes as one set of weights for all objects, not in the paper. "
            "MultiPlaneNeRF and HyperPlanes differ in the field and in the hypernetwork; this column separates both.",
            f"{ALL_WEIGHTS}: not in the paper.",
        ),
    )


def _target() -> Experiment:
    cells = [
        Cell(row, column, _hyperplanes("car", {"model.target": target}), "hyperplanes", "car", quantity=quantity)
        for row, quantity in (("PSNR", "psnr"), ("SSIM", "ssim"))
        for column, target in TARGET_COLUMNS.items()
    ]
    return Experiment(
        "target",
        "Target network of HyperPlanes",
        "tab:multiplane_vs_nerf, fig:multiplane_vs_nerf, fig:multiplane_vs_nerf_full",
        128,
        40,
        5,
        tuple(cells),
        "curves",
        TARGET,
        ("The SSIM of the authors' code is computed column by column and is not comparable with scikit-image's.",),
    )


def _time() -> Experiment:
    cells = [
        Cell("seconds", column, _hyperplanes("car", ALL_READ), method, "car", quantity="image_seconds")
        for column, method in TUNED_COLUMNS.items()
    ]
    return Experiment(
        "time",
        "Seconds from the support views to the picture of one view",
        "tab:time",
        200,
        EPOCHS_200,
        None,
        tuple(cells),
        "bars",
        TIME,
        (
            "The paper's seconds are those of an A100, by dense sampling (25.41 s without fine-tuning); the caption of "
            "fig:single_update_vs_nerf says 10 s for adapting and rendering at 128x128.",
            "The deviation is over objects.",
        ),
    )


def _single_class() -> Experiment:
    cells: list[Cell] = []
    parts: dict[str, Split] = {"Train": "train", "Test": "test"}
    for part, split in parts.items():
        for name in ("Cars", "Chairs", "Planes"):
            row, on = f"{part} {name}", CLASS_OF_COLUMN[name]
            cells.append(Cell(row, "MultiPlaneNeRF", Trained(on, "multiplane"), "multiplane", on, split))
            cells.append(Cell(row, "Autoencoder", Trained(on, "autoencoder"), "autoencoder", on, split))
            cells += _tuned(row, _hyperplanes(on, ALL_READ), on, split)
    return Experiment(
        "single-class",
        "Trained and tested on one class",
        "tab:single_inference",
        200,
        EPOCHS_200,
        5,
        tuple(cells),
        "bars",
        SINGLE,
        (
            "On training objects the paper prints one number for 0, 10 and 100 steps; here they are fine-tuned.",
            f"{ALL_WEIGHTS}: not in the paper.",
            "pictures.png shows what fig:reconstruction, fig:reconstruction_big and fig:fine_tuning do.",
        ),
        pictures=("Test Cars", "Test Chairs", "Test Planes"),
    )


def _iterations() -> Experiment:
    cells: list[Cell] = []
    for name in ("Cars", "Chairs"):
        on = _hyperplanes(CLASS_OF_COLUMN[name])
        cells.append(Cell(f"{name}: HyperPlanes", "0", on, "hyperplanes", CLASS_OF_COLUMN[name]))
        for steps in (100, 300, 1000, 3000, 10_000, 36_000):
            cells.append(Cell(f"{name}: NeRF", str(steps), on, f"nerf_scratch_{steps}", CLASS_OF_COLUMN[name]))
    return Experiment(
        "iterations",
        "One forward pass of HyperPlanes against iterations of NeRF on the same object",
        "fig:single_update_vs_nerf",
        128,
        EPOCHS_128,
        3,
        tuple(cells),
        "steps",
        None,
        (
            "The paper has a picture and says: NeRF needs approximately 36000 epochs (63.7 minutes) to reach what one "
            "step of HyperPlanes does in 10 seconds, a speedup of 380, on two objects.",
            "NeRF is optimised on the same support views and evaluated on the same query views as HyperPlanes.",
        ),
        1,
    )


def _number_of_hyperplanes() -> Experiment:
    cells = [
        Cell(str(count), "PSNR", _hyperplanes("plane", {"model.hypernetwork.views": count}), "hyperplanes", "plane")
        for count in (1, 5, 10, 25)
    ]
    return Experiment(
        "hyperplanes",
        "Number of HyperPlanes",
        "fig:number_of_hyperplanes, fig:hyperplanes_full",
        200,
        40,
        5,
        tuple(cells),
        "boxes",
        None,
        (
            "The paper has a picture; the numbers of HyperPlanes in it are not in its source. It says: on average all "
            "are alike, few HyperPlanes vary more from run to run, and 25 are stable.",
        ),
    )


def _number_of_imageplanes() -> Experiment:
    cells = [
        Cell(str(count), "PSNR", _hyperplanes("plane", planes=count), "hyperplanes", "plane")
        for count in (25, 30, 35, 40, 45, 50)
    ]
    return Experiment(
        "imageplanes",
        "Number of ImagePlanes",
        "fig:imageplanes, fig:imageplanes_full",
        128,
        40,
        5,
        tuple(cells),
        "boxes",
        None,
        (
            "The paper has a picture and says that 25 are best. One caption says ShapeNet 128x128, the other 200x200.",
            "Above 25 the planes are the support views and the first query views, as support and query are one set in "
            "the paper: some of the evaluated views are then among the planes.",
        ),
    )


def _inputs() -> Experiment:
    without = {
        "W and VD": {},
        "without W": {"model.hypernetwork.see_weights": False},
        "without VD": {"model.hypernetwork.see_directions": False},
        "without W and VD": {"model.hypernetwork.see_weights": False, "model.hypernetwork.see_directions": False},
        "MultiPlaneNeRF": {"model.target": "multiplane"},
    }
    cells = [Cell(row, "PSNR", _hyperplanes("car", changes), "hyperplanes", "car") for row, changes in without.items()]
    return Experiment(
        "inputs",
        "Weights (W) and viewing directions (VD) as inputs of the hypernetwork",
        "fig:hypernetwork_comparison, fig:hypernetwork_comparison_full",
        128,
        40,
        5,
        tuple(cells),
        "curves",
        None,
        (
            "The paper has a picture and says that W and VD make a small difference and training more stable. One "
            "caption says planes at 200x200, the other cars at 128x128.",
        ),
    )


def _layers() -> Experiment:
    choices = {
        "colour and density": {"model.hypernetwork.layers": ("colour", "density"), "model.hypernetwork.update": "full"},
        "all layers": {"model.hypernetwork.layers": ("all",), "model.hypernetwork.update": "full"},
        "all layers, low rank": {"model.hypernetwork.layers": ("all",), "model.hypernetwork.update": "low_rank"},
    }
    cells = [
        Cell(row, "PSNR", _hyperplanes("plane", changes), "hyperplanes", "plane") for row, changes in choices.items()
    ]
    return Experiment(
        "layers",
        "Layers of the target that are updated",
        "fig:hypernetwork_generate_full",
        200,
        40,
        5,
        tuple(cells),
        "curves",
        None,
        (
            "The paper has a picture and says that updating the colour and opacity layers alone is far better.",
            "Low-rank updates of all layers: not in the paper.",
        ),
    )


EXPERIMENTS: dict[str, Experiment] = {
    each.name: each
    for each in (
        _shapenet(),
        _cross_class(),
        _target(),
        _time(),
        _single_class(),
        _iterations(),
        _number_of_hyperplanes(),
        _number_of_imageplanes(),
        _inputs(),
        _layers(),
    )
}
"""The experiments by the names that `hyperplanes reproduce` takes."""


def find_experiments() -> dict[str, Experiment]:
    """The tables of the paper, then those of other packages (entry points of the group `hyperplanes.tables`)."""
    return EXPERIMENTS | load_entries("hyperplanes.tables", EXPERIMENTS)


def find_experiment(name: str) -> Experiment:
    """One table or figure.

    Args:
        name: a name in `find_experiments()`.

    Raises:
        ValueError: an unknown name.
    """
    known = find_experiments()
    if name not in known:
        raise ValueError(f"table: expected one of {', '.join(known)}, got {name!r}{did_you_mean(name, known)}")
    return known[name]
