"""Published numbers of the paper, and published settings of the paper, of its code and of learnit.

The numbers are those of HyperPlanes (arXiv 2402.01524), by the labels of its LaTeX source. A setting that a source does
not state has no `Fact`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = [
    "CODE",
    "CROSS",
    "LEARNIT",
    "PAPER",
    "SHAPENET",
    "SINGLE",
    "SOURCES",
    "TARGET",
    "TIME",
    "Fact",
    "PublishedTable",
    "Source",
]


@dataclass(frozen=True)
class PublishedTable:
    """A table as it is printed in the paper.

    Attributes:
        label: the label of the table in the LaTeX source.
        columns: the headings of the columns.
        rows: the numbers by the heading of the row, in the order of the columns: PSNR in dB, unless the row names
            another quantity.
        deviations: the standard deviations of these numbers, if the paper has them.
    """

    label: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[float, ...]]
    deviations: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def value(self, row: str, column: str) -> float | None:
        """A number; None if the paper has no such row or column."""
        return self._find(self.rows, row, column)

    def deviation(self, row: str, column: str) -> float | None:
        """The standard deviation of a number; None if the paper has none."""
        return self._find(self.deviations, row, column)

    def _find(self, rows: Mapping[str, tuple[float, ...]], row: str, column: str) -> float | None:
        return rows[row][self.columns.index(column)] if row in rows and column in self.columns else None


SHAPENET = PublishedTable(
    "tab:shapenet",
    ("Chairs", "Cars", "Lamps"),
    {
        "Standard": (12.49, 11.45, 15.47),
        "MV Matched": (16.40, 22.39, 20.79),
        "MV Shuffled": (10.76, 11.30, 13.88),
        "MV Meta": (18.85, 22.80, 22.35),
        "SV Meta": (16.54, 22.10, 20.95),
        "HyperPlanes": (24.34, 27.80, 25.95),
    },
)

_TUNED = ("MultiPlaneNeRF", "HyperPlanes-0", "HyperPlanes-10", "HyperPlanes-100")

CROSS = PublishedTable(
    "tab:cross",
    _TUNED,
    {
        "Cars on Cars": (24.91, 28.48, 29.31, 29.89),
        "Cars on Chairs": (22.15, 18.58, 20.21, 23.13),
        "Cars on Planes": (21.32, 20.26, 21.58, 25.03),
        "Chairs on Cars": (24.41, 24.64, 26.14, 27.57),
        "Chairs on Chairs": (24.26, 22.95, 25.07, 27.08),
        "Chairs on Planes": (20.84, 18.36, 21.49, 26.03),
        "Planes on Cars": (24.19, 13.57, 22.35, 25.35),
        "Planes on Chairs": (21.69, 13.15, 16.77, 21.12),
        "Planes on Planes": (24.27, 26.94, 28.08, 28.58),
    },
)

TARGET = PublishedTable(
    "tab:multiplane_vs_nerf",
    ("NeRF", "MultiPlaneNeRF", "PointMultiPlaneNeRF"),
    {"PSNR": (19.78, 23.96, 24.35), "SSIM": (0.881, 0.912, 0.927)},
    {"PSNR": (0.22, 0.19, 0.27), "SSIM": (0.002, 0.001, 0.002)},
)

TIME = PublishedTable(
    "tab:time",
    ("HyperPlanes-0", "HyperPlanes-10", "HyperPlanes-100"),
    {"seconds": (25.41, 27.13, 41.3)},
    {"seconds": (0.14, 0.12, 0.14)},
)

SINGLE = PublishedTable(
    "tab:single_inference",
    ("MultiPlaneNeRF", "Autoencoder", "HyperPlanes-0", "HyperPlanes-10", "HyperPlanes-100"),
    {
        "Train Cars": (26.21, 28.14, 30.12, 30.12, 30.12),
        "Train Chairs": (25.28, 23.90, 28.30, 28.30, 28.30),
        "Train Planes": (25.28, 24.83, 30.12, 30.12, 30.12),
        "Test Cars": (24.79, 20.86, 28.48, 29.31, 29.89),
        "Test Chairs": (24.26, 17.17, 22.95, 25.07, 27.08),
        "Test Planes": (24.26, 14.18, 26.94, 28.08, 28.58),
    },
)


@dataclass(frozen=True)
class Fact:
    """The statement of a source about a setting.

    Attributes:
        entry: the dotted name of the setting in this project, such as "model.network.depth". Names that begin with
            "fine_tuning." or "views." are settings of an evaluation.
        value: the value of the setting in this project, or a description if no value expresses it.
        where: the place in the source.
        size: pixels along a side of the images that it applies to; 0 for all.
    """

    entry: str
    value: object
    where: str
    size: int = 0


@dataclass(frozen=True)
class Source:
    """A publication or a repository.

    Attributes:
        name: the heading of its column.
        where: the place where it can be found.
        facts: the facts by the kind of method: "HyperPlanes", "fine-tuning" or "learned initialisations".
    """

    name: str
    where: str
    facts: Mapping[str, tuple[Fact, ...]]

    def fact(self, kind: str, entry: str, size: int) -> Fact | None:
        """The fact about a setting of a kind of method at a size of images; None if the source states nothing."""
        found = (each for each in self.facts.get(kind, ()) if each.entry == entry and each.size in (0, size))
        return next(found, None)


PAPER = Source(
    "the paper",
    "arXiv 2402.01524",
    {
        "HyperPlanes": (
            Fact("model.target", "point_multiplane", "Eq. 6"),
            Fact("model.network.depth", 8, "Appendix B, target network: layer depth"),
            Fact("model.network.width", 256, "Appendix B, target network: layer width"),
            Fact("model.network.planes", 25, "Appendix B: ImagePlanes"),
            Fact("model.sampling.coarse", 64, "Appendix B, target network: samples"),
            Fact("model.sampling.fine", 128, "Appendix B, target network: importance"),
            Fact("model.hypernetwork.views", 5, "Appendix B: HyperPlanes", 128),
            Fact("model.hypernetwork.views", 25, "Appendix B: HyperPlanes", 200),
            Fact("model.hypernetwork.encoder", "convnet", "Appendix B: encoder", 128),
            Fact("model.hypernetwork.encoder", "resnet101", "Appendix B: encoder", 200),
            Fact("model.hypernetwork.normalisation", "batch", "Appendix B: convolutions and batch normalization", 128),
            Fact("model.hypernetwork.depth", 3, "Appendix B, hypernetwork: layer depth", 128),
            Fact("model.hypernetwork.depth", 10, "Appendix B, hypernetwork: layer depth", 200),
            Fact("model.hypernetwork.width", 256, "Appendix B, hypernetwork: layer width"),
            Fact("model.hypernetwork.activation", "relu", "Appendix B, hypernetwork"),
            Fact("model.hypernetwork.layers", ("colour", "density"), "Appendix A, selection of updated layers"),
            Fact("model.hypernetwork.see_weights", True, "Eq. 7"),
            Fact("model.hypernetwork.weights_seen", "all", "Eq. 7: theta"),
            Fact("model.hypernetwork.see_directions", True, "Eq. 7"),
            Fact("training.optimiser", "adam", "Algorithm 1"),
            Fact("training.tasks", 1, "Appendix B: a batch of one task"),
            Fact("training.rays", 512, "Appendix B, target network: rand"),
            Fact("training.learning_rate", 1e-4, "Appendix B, target network"),
            Fact("training.hypernetwork_learning_rate", 1e-4, "Appendix B, hypernetwork and encoder"),
        ),
        "fine-tuning": (Fact("fine_tuning.trainable", "hypernetwork", "section 3, fine-tuning: the target is frozen"),),
        "learned initialisations": (Fact("views.steps", 2000, "section 4.1: 2000 fine-tuning steps"),),
    },
)
"""The settings that the paper states."""

CODE = Source(
    "its code",
    "github.com/gmum/HyperPlanes at 8c4de8d",
    {
        "HyperPlanes": (
            Fact("model.target", "a tri-plane of an encoder, in place of ImagePlanes", "fewshot/hypermaml.py"),
            Fact("model.network.depth", "2048-512-512, then 256-256", "nerf/models/multiplane_maml.py"),
            Fact("model.network.width", "2048 to 256; heads of 256", "nerf/models/multiplane_maml.py"),
            Fact("model.coarse_network", True, "nerf/nerf_maml_utils.py: network_fn and network_fine"),
            Fact("model.order", "file", "run_hyperplanes_new.py: the first 25 of 50 views are the support"),
            Fact("model.sampling.coarse", 64, "configs: N_samples"),
            Fact("model.sampling.fine", 128, "configs: N_importance"),
            Fact("model.sampling.placement", "samples", "nerf/nerf_maml_utils.py: render_rays"),
            Fact("model.hypernetwork.views", 5, "config_parser.py: img2embed, at both sizes"),
            Fact("model.hypernetwork.choice", "first", "fewshot/hypermaml.py: imgs[:img2embed]"),
            Fact("model.hypernetwork.encoder", "convnet", "configs: Conv4", 128),
            Fact("model.hypernetwork.encoder", "resnet101", "configs: ResNet", 200),
            Fact("model.hypernetwork.depth", 3, "config_parser.py: hm_hn_len, at both sizes"),
            Fact("model.hypernetwork.width", 256, "config_parser.py: hm_hn_width"),
            Fact("model.hypernetwork.activation", "relu", "hypernetwork.py"),
            Fact(
                "model.hypernetwork.layers",
                "colour, density and the last hidden one",
                "run_hyperplanes_new.py: layers2update",
            ),
            Fact("training.optimiser", "adam", "nerf/nerf_maml_utils.py"),
            Fact("training.tasks", 1, "configs: batch_size"),
            Fact("training.rays", 512, "configs: N_rand, of one random query view"),
            Fact("training.learning_rate", 1e-4, "configs: lrate"),
            Fact("training.hypernetwork_learning_rate", 1e-4, "config_parser.py: hn_rate, encoder_rate"),
            Fact("training.final_rate_factor", 1.0, "run_hyperplanes_new.py: lrate_decay is never read"),
        ),
        "fine-tuning": (
            Fact("fine_tuning.trainable", "hypernetwork and target", "run_hyperplanes_new_eval.py"),
            Fact("fine_tuning.rays", 512, "fewshot/hypermaml.py: N_rand, of one random support view"),
            Fact("fine_tuning.optimiser", "adam", "run_hyperplanes_new_eval.py"),
            Fact("fine_tuning.learning_rate", 1e-4, "config_parser.py: hn_rate, encoder_rate, lrate"),
            Fact("fine_tuning.final_rate_factor", 1.0, "run_hyperplanes_new_eval.py: no schedule"),
        ),
    },
)
"""The settings of the authors' code."""

LEARNIT = Source(
    "learnit",
    "github.com/tancik/learnit at b5635b3, Experiments/shapenet.ipynb; what that leaves open: "
    "github.com/sanowar-raihan/nerf-meta at 85418c0, configs/shapenet/cars.json, a reimplementation",
    {
        "learned initialisations": (
            Fact("model.target", "simplified_nerf", "Model: use_viewdirs = False"),
            Fact("model.network.depth", 5, "Model: depth = 6, the output layer among them"),
            Fact("model.network.width", 256, "Model: width"),
            Fact("model.network.point_frequencies", 20, "Model: 2 ** linspace(0, 8, 20)"),
            Fact("model.coarse_network", False, "one model"),
            Fact("model.sampling.coarse", 128, "N_samples"),
            Fact("model.sampling.fine", 0, "one pass"),
            Fact("model.initialisation.inner_steps", 32, "inner_update_steps"),
            Fact("model.initialisation.inner_rate", 0.5, "inner_step_size"),
            Fact("model.initialisation.test_rays", 64, "train_single_model: batch_size; tto_batchsize"),
            Fact("training.steps", 100_000, "max_iters"),
            Fact("training.tasks", 1, "one object an iteration"),
            Fact("training.rays", 128, "batch_size"),
            Fact("training.optimiser", "adam", "optix.adam"),
            Fact("training.learning_rate", "5e-4; the reimplementation 5e-5", "lr; meta_lr"),
            Fact("training.final_rate_factor", 1.0, "no schedule"),
            Fact("views.steps", 2000, "the reimplementation: tto_steps"),
            Fact("views.shown", 1, "test_time_views; tto_views"),
        ),
    },
)
"""The settings of learnit (Tancik et al. 2021), whose methods the first table compares HyperPlanes with."""

SOURCES = (PAPER, CODE, LEARNIT)
