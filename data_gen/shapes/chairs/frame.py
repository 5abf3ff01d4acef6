"""What the parts of a chair share: its measures and its materials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_gen.shapes.choices import one_of
from data_gen.shapes.materials import Colour, Material, brighten, plain, tint
from data_gen.shapes.patterns import print_of, weave, wood

__all__ = ["ChairFrame", "Palette", "sample_palette"]


@dataclass(frozen=True)
class ChairFrame:
    """Measures of a chair in metres; its seat is centred on x = z = 0, its back at negative z.

    Attributes:
        kind: "dining", "lounge", "office", "bar" or "rocking".
        width: of the seat.
        depth: of the seat.
        seat: height of the seat's upper side over the floor.
        thick: thickness of the seat.
        back: height of the back over the seat; 0 for none.
        lean: degrees by which the back reclines.
        round_seat: whether the seat is a disc.
    """

    kind: str
    width: float
    depth: float
    seat: float
    thick: float
    back: float
    lean: float
    round_seat: bool

    @property
    def under(self) -> float:
        """Height of the seat's lower side over the floor."""
        return self.seat - self.thick

    def at_back(self, x: float, share: float, forward: float = 0.0) -> tuple[float, float, float]:
        """Point of the back's plane: x across, `share` of the back's height over the seat, moved forward in metres."""
        rise = share * self.back
        z = -self.depth / 2 + 0.035 - rise * np.tan(np.radians(self.lean)) + forward
        return x, self.seat + rise, float(z)


@dataclass(frozen=True)
class Palette:
    """Materials of a chair: the frame's, the seat's and back's, and metal fittings."""

    frame: Material
    seat: Material
    metal: Material
    wooden: bool

    @property
    def sides(self) -> int:
        """Of the section of an upright: square where it is of wood."""
        return 4 if self.wooden else 8


_WOODS: tuple[Colour, ...] = (
    (196, 146, 92),
    (162, 104, 58),
    (118, 70, 40),
    (84, 52, 36),
    (208, 166, 112),
    (146, 74, 46),
    (60, 44, 38),
)
_DYES = (0.0, 0.02, 0.05, 0.09, 0.13, 0.2, 0.3, 0.38, 0.47, 0.54, 0.6, 0.64, 0.75, 0.9, 0.97)


def sample_palette(rng: np.random.Generator, kind: str) -> Palette:
    """Materials that go together for a chair of the kind."""
    colour = tint(rng, one_of(rng, _DYES), rng.uniform(0.35, 0.8), rng.uniform(0.4, 0.8), 0.05)
    level = int(rng.choice([52, 64, 128, 158]))
    metal = plain((level, level, min(255, level + 4)), "metal")
    timber = one_of(rng, _WOODS)
    wooden = kind != "office" and rng.random() < 0.72
    if wooden:
        painted = rng.random() < 0.18
        frame = plain(brighten(colour, 0.85), "painted") if painted else wood(rng, timber)
    else:
        frame = metal
    if kind in ("lounge", "office") or rng.random() < 0.55:
        choice = rng.random()
        if choice < 0.3:
            seat = weave(rng, colour)
        elif choice < (0.45 if kind == "office" else 0.7):
            other = brighten(colour, 0.5) if rng.random() < 0.5 else (226, 214, 188)
            seat = print_of(rng, colour, other)
        else:
            dark = kind == "office" and rng.random() < 0.3
            seat = plain(brighten((44, 46, 52), rng.uniform(0.8, 1.8)) if dark else colour, "leather")
    elif wooden:
        seat = wood(rng, timber, int(rng.integers(1, 5)))
    else:
        seat = plain(colour, "plastic")
    return Palette(frame, seat, metal, wooden)
