"""The numbers of the HyperPlanes paper (arXiv 2402.01524), by the labels of its LaTeX source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["CROSS", "SHAPENET", "SINGLE", "TARGET", "TIME", "PublishedTable"]


@dataclass(frozen=True)
class PublishedTable:
    """A table as it is printed in the paper.

    Attributes:
        label: of the table in the LaTeX source.
        columns: their headings.
        rows: the numbers by the heading of the row, in the order of the columns; PSNR in dB unless a row says another.
        deviations: standard deviations of the same, where the paper has them.
    """

    label: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[float, ...]]
    deviations: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def value(self, row: str, column: str) -> float | None:
        """A number; None where the paper has no such row or column."""
        return self._find(self.rows, row, column)

    def deviation(self, row: str, column: str) -> float | None:
        """Its standard deviation; None where the paper has none."""
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
