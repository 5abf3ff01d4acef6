"""Body styles of cars, and the measures that the parts of one car share.

Metres, y up, front along +z, wheels standing on y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["STYLES", "CarFrame", "Style", "sample_frame"]


@dataclass(frozen=True)
class Style:
    """Proportions of a body; every pair is the range a value is drawn from.

    Attributes:
        length: metres.
        width: metres, without mirrors.
        height: metres, ground to roof.
        glass: where glass begins and ends as fractions of the length from the tail: foot of the rear window, rear end
            of the roof, front end of the roof, foot of the windscreen.
        belt: height of the window sills as a fraction of the height.
        deck: height of the tail's lid as a fraction of the height.
        nose: height of the bonnet's front edge as a fraction of the height.
        clearance: metres under the floor.
        wheel: outer radius of the tyres in metres.
        roof: width of the roof as a fraction of the body's.
    """

    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]
    glass: tuple[float, float, float, float]
    belt: float
    deck: float
    nose: float
    clearance: float
    wheel: tuple[float, float]
    roof: float


STYLES: dict[str, Style] = {
    "sedan": Style(
        (4.5, 5.0), (1.78, 1.9), (1.42, 1.52), (0.15, 0.31, 0.56, 0.71), 0.62, 0.66, 0.5, 0.2, (0.32, 0.35), 0.74
    ),
    "coupe": Style(
        (4.2, 4.6), (1.78, 1.88), (1.3, 1.38), (0.1, 0.34, 0.52, 0.68), 0.64, 0.66, 0.5, 0.17, (0.33, 0.36), 0.7
    ),
    "hatchback": Style(
        (3.7, 4.2), (1.68, 1.8), (1.45, 1.56), (0.015, 0.14, 0.6, 0.76), 0.6, 0.62, 0.52, 0.19, (0.3, 0.33), 0.76
    ),
    "wagon": Style(
        (4.5, 4.9), (1.78, 1.88), (1.45, 1.55), (0.012, 0.075, 0.57, 0.71), 0.6, 0.62, 0.5, 0.2, (0.32, 0.35), 0.77
    ),
    "suv": Style(
        (4.4, 4.9), (1.85, 2.0), (1.7, 1.88), (0.012, 0.06, 0.58, 0.7), 0.6, 0.62, 0.54, 0.28, (0.37, 0.42), 0.8
    ),
    "van": Style(
        (4.6, 5.3), (1.85, 2.0), (1.9, 2.2), (0.008, 0.022, 0.74, 0.88), 0.54, 0.56, 0.44, 0.22, (0.33, 0.36), 0.86
    ),
    "pickup": Style(
        (5.0, 5.5), (1.85, 2.0), (1.72, 1.85), (0.4, 0.435, 0.6, 0.72), 0.62, 0.58, 0.56, 0.3, (0.38, 0.43), 0.79
    ),
    "sports": Style(
        (4.1, 4.5), (1.85, 1.98), (1.14, 1.24), (0.08, 0.36, 0.49, 0.67), 0.69, 0.72, 0.52, 0.13, (0.31, 0.335), 0.66
    ),
}
"""Body styles by name."""


@dataclass(frozen=True)
class CarFrame:
    """Measures of one car that its parts share, in metres; z from the tail at -length / 2 to the nose."""

    style: str
    length: float
    width: float
    height: float
    floor: float
    belt: float
    deck: float
    nose: float
    cowl: float
    roof: float
    glass: np.ndarray
    wheel: float
    axles: tuple[float, float]

    def half_width(self, z: float | np.ndarray) -> np.ndarray:
        """Half of the body's width at z: full amidships, drawn in at both ends."""
        at = np.array([0, 0.015, 0.06, 0.16, 0.84, 0.94, 0.985, 1]) - 0.5
        blunt = 0.96 if self.style in ("van", "suv", "pickup") else 0.9
        share = np.array([blunt - 0.05, blunt, 0.97, 1, 1, 0.965, blunt - 0.02, blunt - 0.1])
        return np.asarray(np.interp(z, at * self.length, share * self.width / 2))

    def top(self, z: float | np.ndarray) -> np.ndarray:
        """Height of the silhouette at z, seen from the side."""
        tail, rear, front, cowl = self.glass
        half = self.length / 2
        bonnet = 0.45 * cowl + 0.55 * half
        at = [-half, -half + 0.06, tail, rear, (rear + front) / 2, front, cowl, bonnet, half - 0.12, half]
        lid = self.deck
        highs = [lid - 0.1, lid - 0.01, lid, self.height - 0.03, self.height, self.height - 0.04, self.cowl]
        highs += [self.cowl * 0.7 + self.nose * 0.3 + 0.02, self.nose, self.nose - 0.12]
        return np.asarray(np.interp(z, np.maximum.accumulate(np.array(at)), highs))

    def arch(self, z: np.ndarray) -> np.ndarray:
        """Height of the wheel arches over the ground at z; 0 away from them."""
        radius = 1.16 * self.wheel
        rise = [np.sqrt(np.maximum(0, radius**2 - (z - axle) ** 2)) for axle in self.axles]
        return np.max([np.where(r > 0, self.wheel + r, 0) for r in rise], axis=0)


def sample_frame(rng: np.random.Generator, name: str) -> CarFrame:
    """Draw the measures of a car of the named style."""
    style = STYLES[name]
    length, width, height = rng.uniform(*style.length), rng.uniform(*style.width), rng.uniform(*style.height)
    glass = (np.array(style.glass) + rng.uniform(-0.012, 0.012, 4) * (np.array(style.glass) > 0.05) - 0.5) * length
    wheel = rng.uniform(*style.wheel)
    overhang = rng.uniform(0.17, 0.2), rng.uniform(0.16, 0.19)
    belt = (style.belt + rng.uniform(-0.02, 0.02)) * height
    return CarFrame(
        style=name,
        length=length,
        width=width,
        height=height,
        floor=style.clearance,
        belt=belt,
        deck=style.deck * height + rng.uniform(-0.01, 0.02),
        nose=(style.nose + rng.uniform(-0.02, 0.03)) * height,
        cowl=belt + rng.uniform(0.01, 0.05),
        roof=style.roof,
        glass=glass,
        wheel=wheel,
        axles=(-length / 2 + overhang[0] * length, length / 2 - overhang[1] * length),
    )
