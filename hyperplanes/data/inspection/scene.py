"""From where one object was photographed: what the views cover, what they have in common, and which are the worst.

All directions are seen from the middle of the bounds, in a world with y up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from statistics import median

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from hyperplanes.data.formats.scenes.sparse_points import SparsePoints
from hyperplanes.data.inspection.silhouettes import CoarseHull, masks_tell, small_masks, with_object
from hyperplanes.data.pictures.bounds import cut_off, empty_masks, inverted
from hyperplanes.data.upright import guess_up, upright
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.poses import fibonacci_sphere
from hyperplanes.utilities.images.sizes import scaled_size
from hyperplanes.utilities.messages.errors import listed
from hyperplanes.views import Views

__all__ = ["COVERAGE_ANGLE", "WORST", "SceneReport", "ViewReport", "angles_to", "describe_scene", "stand_upright"]

COVERAGE_ANGLE = 30.0  # degrees: a side of the object is shown where a camera stands within them
COVERAGE_DIRECTIONS = 2000
MASK_SIZE, HULL_SIDE = 96, 48  # pixels, and voxels of the hull, at which masks are compared with it
MIN_VIEWS = 8  # for this hull
FACING = 0.2  # cosine between a surface and what sees it
STEEP = 70.0  # degrees of elevation above which azimuth says little
MAX_OVERLAP_DEFICIT = 0.15  # of intersection over union below the median: a mask that fits the others' hull badly
MIN_RELATIVE_SHARPNESS = 0.5  # of the sharpness of the nearest views
LONELY = 1.5  # times the usual angle to the nearest view
LARGE_ERROR = 2.0  # times the median reprojection error
SHARPNESS_SIZE = 256  # pixels along the longer side, on which sharpness is judged
WORST = 5


@dataclass(frozen=True)
class ViewReport:
    """One view.

    Attributes:
        name: of its picture.
        direction: (azimuth, elevation) in degrees in which it stands; azimuth 0 is z, 90 is x.
        neighbour: degrees to the view that stands nearest.
        agreement: of its mask with the silhouette of all masks' hull (intersection over union), or None.
        error: reprojection error in pixels, or None.
        cut: whether the border of the picture cuts the object off.
        faults: what is wrong with it, in words.
    """

    name: str
    direction: tuple[float, float]
    neighbour: float
    agreement: float | None
    error: float | None
    cut: bool
    faults: tuple[str, ...] = ()


@dataclass(frozen=True)
class SceneReport:
    """What a set of views covers.

    Attributes:
        views: one each, in their order.
        covered: share of all directions with a view within COVERAGE_ANGLE degrees.
        above: share of those more than 45 degrees above the horizon.
        below: share of those more than 45 degrees below it.
        gap: the widest gap in azimuth, in degrees, and the views on both sides of it; None of fewer than three views.
        shown: how many views show a place of the hull's surface, in the median, or None without masks.
        rarely_shown: share of that surface that fewer than three views show, or None.
        sparse: points of a reconstruction, or None.
        masked: whether the views have masks.
        inverted: how many of these seem to show the background.
        contradicted: whether pictures and poses contradict each other (`conventions.check_conventions`).
        empty: how many masks show nothing.
    """

    views: tuple[ViewReport, ...]
    covered: float
    above: float
    below: float
    gap: tuple[float, str, str] | None
    shown: float | None
    rarely_shown: float | None
    sparse: SparsePoints | None = None
    masked: bool = True
    inverted: int = 0
    contradicted: bool = False
    empty: int = 0

    @property
    def worst(self) -> list[ViewReport]:
        """Some views, the worst first: the wrong ones, those with most faults, then those whose masks fit least."""
        wrong = self.wrong
        return sorted(self.views, key=lambda view: (view not in wrong, -len(view.faults), view.agreement or 0.0))[
            :WORST
        ]

    @property
    def wrong(self) -> list[ViewReport]:
        """The views whose masks fit the hull of all less than half as well as usual: their pose or mask is wrong."""
        fits = {view: view.agreement for view in self.views if view.agreement is not None}
        usual = median(fits.values()) if fits else 0.0
        return [view for view, fit in fits.items() if fit < usual / 2]

    @property
    def is_sound(self) -> bool:
        """Whether no view has a fault."""
        return not any(view.faults for view in self.views)

    def lines(self) -> list[str]:
        """The report for people, a line a fact."""
        elevations = [view.direction[1] for view in self.views]
        lines = [
            f"coverage: {self.covered:.0%} of all directions have a view within {COVERAGE_ANGLE:.0f} degrees "
            f"({self.above:.0%} of those from above, {self.below:.0%} of those from below); the views stand "
            f"{_elevation(min(elevations))} to {_elevation(max(elevations))} the horizon"
        ]
        if self.gap is not None and self.gap[0] > 2 * COVERAGE_ANGLE:
            width, left, right = self.gap
            lines.append(f"gap: nothing was seen from {width:.0f} degrees around between {left} and {right}")
        apart = [view.neighbour for view in self.views]
        overlap = (
            f"overlap: neighbouring views stand {median(apart):.0f} degrees apart (median), {max(apart):.0f} at most"
        )
        if self.shown is not None and self.rarely_shown is not None:
            overlap += (
                f"; a place of the surface faces {self.shown:.0f} views (median), {self.rarely_shown:.0%} of it fewer "
                "than three"
            )
        lines.append(overlap)
        if self.sparse is not None:
            lines.append(_sparse_line(self.sparse))
        if cut := sum(view.cut for view in self.views):
            lines.append(f"cut off: {cut} of {len(self.views)} images do not show the object whole")
        said = [f"{view.name} ({', '.join(view.faults)})" for view in self.worst if view.faults]
        if not said and (least := self.worst[0]).agreement is not None:
            said = [f"none stands out; the mask of {least.name} fits the hull of all least, by {least.agreement:.0%}"]
        lines += [f"worst views: {'; '.join(said)}"] if said else []
        lines.append(f"expect: {self.expectation()}")
        return lines

    def expectation(self) -> str:
        """What pictures made of these views will be like, in words."""
        if not self.masked:
            return "poor pictures: there are no masks, which packaged models need; --learn-background makes rough ones"
        if self.inverted:
            return (
                f"poor pictures: {self.inverted} of {len(self.views)} masks seem to show the background; invert them, "
                "white is the object"
            )
        if self.empty:
            return (
                f"poor pictures: {self.empty} of {len(self.views)} masks show nothing; leave these views out or "
                "correct their masks"
            )
        if self.contradicted:
            return "poor pictures: poses and images contradict each other; see the conventions above"
        if wrong := self.wrong:
            names = listed([view.name for view in wrong])
            return f"poor pictures: the pose or the mask is wrong of {names}; correct it, or leave the view out"
        unseen = [side for side, share in (("above", self.above), ("below", self.below)) if share < 0.25]
        if self.covered < 0.25:
            text = "good pictures only from near where the views stand; other sides are guessed"
        elif unseen:
            text = f"good pictures from where the views stand; what is seen from {' and '.join(unseen)} is guessed"
        elif self.covered > 0.75:
            text = "good pictures from all sides"
        else:
            text = f"good pictures from where the views stand; {1 - self.covered:.0%} of the directions are guessed"
        if len(self.views) < MIN_VIEWS:
            text += f"; {len(self.views)} views are few, 20 or more show details"
        apart = median(view.neighbour for view in self.views)
        if apart > COVERAGE_ANGLE:
            text += f"; views {apart:.0f} degrees apart share little, details will be soft"
        return text


def describe_scene(views: Views, sparse: SparsePoints | None = None) -> SceneReport:
    """Look at where views stand and how they agree.

    Args:
        views: all views of one object, two or more.
        sparse: points of a reconstruction.
    """
    views = stand_upright(views)
    written = views.names or tuple(map(str, range(len(views))))
    names = tuple(PurePosixPath(name).name for name in written)
    # where the views stand, and how far the nearest other is
    axes = _directions(views)
    apart = torch.rad2deg(torch.acos((axes @ axes.T).clamp(-1, 1)))
    apart.fill_diagonal_(torch.inf)
    nearests = apart.amin(1)
    azimuth, elevation = _angles(axes)
    # how each mask fits the hull of all, how sharp each picture is, how well each is posed
    hull = _hull(views)
    agreement = None
    if hull is not None:
        agreement = CoarseHull(hull.centres(), hull).overlap(*small_masks(views, MASK_SIZE, len(views)))
    middle = None if agreement is None else float(agreement.median())
    sharp = _sharpness(views, apart)
    cut = cut_off(views.masks) if views.masks is not None else torch.zeros(len(views), dtype=torch.bool)
    background = inverted(views.masks) if views.masks is not None else torch.zeros_like(cut)
    empty = empty_masks(views.masks) if views.masks is not None else torch.zeros_like(cut)
    cut &= ~background
    errors: Mapping[str, float] = {} if sparse is None else sparse.errors
    usual = median(errors.values()) if errors else None
    reports = []
    for index, name in enumerate(names):
        fit = None if agreement is None else float(agreement[index])
        faults = ["the mask seems to show the background"] if background[index] else []
        faults += ["the mask is empty"] if empty[index] else []
        if not faults and fit is not None and middle is not None and fit < middle - MAX_OVERLAP_DEFICIT:
            faults.append(f"mask and the hull of all masks agree by {fit:.0%}, in the median {middle:.0%}")
        if float(sharp[index]) < MIN_RELATIVE_SHARPNESS:
            faults.append(f"blurred, {float(sharp[index]):.0%} as sharp as the views beside it")
        error = errors.get(written[index])
        if error is not None and usual is not None and error > max(1.0, LARGE_ERROR * usual):
            faults.append(f"reprojection error {error:.1f} pixels, in the median {usual:.1f}")
        nearest = float(nearests[index])
        if nearest > max(COVERAGE_ANGLE, LONELY * float(nearests.median())):
            faults.append(f"no other within {nearest:.0f} degrees")
        direction = float(azimuth[index]), float(elevation[index])
        reports.append(ViewReport(name, direction, nearest, fit, error, bool(cut[index]), tuple(faults)))
    # how much of all directions, from above and from below, some view covers
    every = torch.linalg.inv(fibonacci_sphere(COVERAGE_DIRECTIONS, 1.0).double())[:, :3, 3]
    near = angles_to(axes, every) < COVERAGE_ANGLE
    up = torch.rad2deg(torch.asin(every[:, 1].clamp(-1, 1)))
    shown = None if hull is None else _shown(views, hull)
    return SceneReport(
        tuple(reports),
        float(near.double().mean()),
        float(near[up > 45].double().mean()),
        float(near[up < -45].double().mean()),
        _gap(azimuth, elevation, names),
        None if shown is None else float(shown.median()),
        None if shown is None else float((shown < 3).double().mean()),
        sparse,
        views.masks is not None,
        int(background.sum()),
        empty=int(empty.sum()),
    )


def stand_upright(views: Views) -> Views:
    """The views in a world with y up, as the files say or the cameras were held."""
    return upright(views, views.up or guess_up(views.cameras) or "y")


def angles_to(axes: Float[Tensor, "view 3"], directions: Float[Tensor, "direction 3"]) -> Float[Tensor, " direction"]:
    """Degrees from each direction to the nearest view, all unit vectors."""
    return torch.rad2deg(torch.acos((directions @ axes.T).amax(1).clamp(-1, 1)))


def _directions(views: Views) -> Float[Tensor, "view 3"]:
    """Unit vectors from the middle of the bounds to the cameras."""
    eyes = camera.centres(views.cameras).double()
    return normalize(eyes - eyes.new_tensor(views.bounds.centre), dim=-1)


def _angles(axes: Float[Tensor, "view 3"]) -> tuple[Tensor, Tensor]:
    """Azimuth, 0 to 360 from z over x, and elevation in degrees."""
    azimuth = torch.rad2deg(torch.atan2(axes[:, 0], axes[:, 2])) % 360
    return azimuth, torch.rad2deg(torch.asin(axes[:, 1].clamp(-1, 1)))


def _elevation(degrees: float) -> str:
    return f"{abs(degrees):.0f} degrees {'above' if degrees >= 0 else 'below'}"


def _gap(azimuth: Tensor, elevation: Tensor, names: tuple[str, ...]) -> tuple[float, str, str] | None:
    """The widest gap in azimuth between views that do not look steeply up or down."""
    level = (elevation.abs() < STEEP).nonzero()[:, 0]
    if len(level) < 3:
        return None
    order = level[azimuth[level].argsort()]
    around = azimuth[order]
    widths = (around.roll(-1) - around) % 360
    widest = int(widths.argmax())
    return float(widths[widest]), names[int(order[widest])], names[int(order[(widest + 1) % len(order)])]


def _hull(views: Views) -> Occupancy | None:
    """The hull of all masks but for what only one of them rules out; None without masks."""
    if not masks_tell(views):
        return None
    views = with_object(views)
    hull = carve(
        *small_masks(views, MASK_SIZE, len(views)), views.bounds, HULL_SIDE, votes=2 if len(views) >= MIN_VIEWS else 1
    )
    return hull if hull.occupied.any() else None


def _shown(views: Views, hull: Occupancy) -> Float[Tensor, " place"]:
    """How many views each voxel of the hull's surface faces, within their pictures; what hides it is not looked for."""
    surface = hull.surface()
    places = surface.centres()
    steps = torch.cat([torch.eye(3), -torch.eye(3)])
    free = ~torch.stack([hull.contains(places + step * hull.voxel) for step in steps], 1)
    normals = normalize(free.float() @ steps, dim=-1)
    eyes = camera.centres(views.cameras)
    height, width = views.size
    count = torch.zeros(len(places))
    for eye, matrix in zip(eyes, camera.projection_matrices(views.cameras), strict=True):
        seen = places @ matrix[:, :3].T + matrix[:, 3]
        front = seen[:, 2] > 0
        column, row = (seen[:, :2] / torch.where(front, seen[:, 2], 1.0)[:, None]).unbind(-1)
        inside = front & (column > 0) & (row > 0) & (column < width - 1) & (row < height - 1)
        facing: Bool[Tensor, " place"] = (normalize(eye - places, dim=-1) * normals).sum(-1) > FACING
        count += inside & facing
    return count


def _sharpness(views: Views, apart: Tensor) -> Float[Tensor, " view"]:
    """Sharpness of each picture in the median of the three views beside it.

    Of small grey pictures, the mean absolute Laplacian over the mean absolute gradient, within the mask: blur takes
    from the one more than from the other, distance and contrast hardly matter.
    """
    size = [max(3, side) for side in scaled_size(views.size, SHARPNESS_SIZE)]
    grey = interpolate(views.images.mean(1, keepdim=True), size, mode="area")
    inside = torch.ones_like(grey) if views.masks is None else interpolate(views.masks, size, mode="area")
    inside = 1 - torch.nn.functional.max_pool2d(1 - inside, 3, 1, 1)[:, :, 1:-1, 1:-1]  # away from the outline
    middle = grey[:, :, 1:-1, 1:-1]
    across, down = grey[:, :, 1:-1, 2:] - grey[:, :, 1:-1, :-2], grey[:, :, 2:, 1:-1] - grey[:, :, :-2, 1:-1]
    laplace = grey[:, :, 1:-1, 2:] + grey[:, :, 1:-1, :-2] + grey[:, :, 2:, 1:-1] + grey[:, :, :-2, 1:-1] - 4 * middle
    gradient = ((across.abs() + down.abs()) * inside).flatten(1).sum(1)
    ratio = (laplace.abs() * inside).flatten(1).sum(1) / gradient.clamp_min(1e-6)
    beside = apart.topk(min(3, len(views) - 1), largest=False).indices
    usual = ratio[beside].median(1).values
    return torch.where((gradient > 1e-3) & (usual > 1e-3), ratio / usual.clamp_min(1e-3), torch.ones_like(ratio))


def _sparse_line(sparse: SparsePoints) -> str:
    """One line about the points of a reconstruction."""
    if sparse.error is None:
        return f"points: {len(sparse.places):,} of a sparse reconstruction"
    line = f"reprojection error: {sparse.error:.2f} pixels (mean, {len(sparse.places):,} points)"
    if not sparse.errors or not math.isfinite(sparse.error):
        return line
    worst = max(sparse.errors, key=lambda name: sparse.errors[name])
    return f"{line}, {sparse.errors[worst]:.2f} in the worst view ({PurePosixPath(worst).name})"
