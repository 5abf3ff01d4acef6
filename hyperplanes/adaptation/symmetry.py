"""Reflections of views: a symmetric object is seen from twice as many sides as it was photographed from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from hyperplanes.adaptation.base import Adapter, Renderable, hull
from hyperplanes.adaptation.hull_blend import HullBlend
from hyperplanes.geometry.cameras import camera_directions
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.mirror_symmetry import more_symmetric_plane, most_symmetric_plane
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.poses import farthest_first
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.reflections import Plane, reflected_cameras
from hyperplanes.rendering.footprint import footprint
from hyperplanes.views import Views, join_views

__all__ = ["HANDICAP", "UNKNOWN", "Reflecting", "possible_planes", "reflected", "symmetry_plane", "with_reflections"]

FEWEST = 2  # views that planes are judged by: a single one contradicts none of them
FEWEST_TO_SEARCH, FEWEST_TO_REFINE = 5, 10
MOST = 8
SIZE = 64  # pixels of these along the longer side, at most
LOST = 0.05  # share of the object's pixels that the hull with reflections may miss
TOLERANCE = 1.75  # times the squared error without reflections, by which the views still show the same object
FLOOR = 3e-3  # of that error in a pixel of the object; smaller ones are those of the hull's voxels

SIDE = 96  # voxels an axis of the hull in which parts that are not symmetric are looked for
SHOWN = 0.9  # opacity of a mask from which on a pixel shows the object
REACH = 4  # voxels, by which these parts go on where other ones hide their beginning
UNKNOWN = 0.97  # opacity where a reflection is known to be wrong: nothing is carved, and its colour does not count
HANDICAP = 0.05  # penalty of reflections as planes: light falls from one side, and writing is reversed

VERTICAL = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
AXES = (*VERTICAL, (0.0, 1.0, 0.0))
"""Normals of planes that are tried."""


def reflected(views: Views, plane: Plane) -> Views:
    """The views of the mirror image of an object: the same pictures, flipped, by cameras that are reflected.

    Args:
        views: of the object.
        plane: of the reflection.
    """
    masks = None if views.masks is None else views.masks.flip(3)
    cameras = reflected_cameras(views.cameras, plane)
    return Views(views.images.flip(3), cameras, masks, views.bounds, views.names, views.up)


@torch.no_grad()
def with_reflections(support: Views, plane: Plane | None) -> Views:
    """The views, and after them their reflections in the same order.

    Few things are symmetric in all of their parts. What views show, and the visual hull of views and reflections does
    not hold, is such a part. Where it would be in a reflection, the opacity is UNKNOWN.

    Args:
        support: of an object that is symmetric about the plane, but for some parts.
        plane: of the symmetry; None leaves the views as they are.
    """
    if plane is None:
        return support
    mirrored = reflected(support, plane)
    if support.masks is None or mirrored.masks is None:
        return join_views(support, mirrored)
    parts = _asymmetric_parts(support, join_views(support, mirrored))
    if parts.occupied.any():
        wrong = footprint(parts, mirrored.cameras)[:, None]
        mirrored = replace(mirrored, masks=torch.where(wrong, UNKNOWN, mirrored.masks))
    return join_views(support, mirrored)


@torch.no_grad()
def symmetry_plane(support: Views) -> Plane | None:
    """The plane about which an object looks symmetric, if there is one.

    If an object is symmetric, the visual hull of its views and their reflections still shows the views. If not, this
    hull is too small, or it has the colours of another part of the object. Silhouettes and colours are compared; no
    weights are needed. The planes through the middle of the scene that are orthogonal to its axes are tried first. Then
    the best of these is compared with one near to it (`more_symmetric_plane`) or, where none will do, the vertical
    plane about which the hull of the views is most nearly symmetric is tried (`most_symmetric_plane`).

    Args:
        support: views with masks; MOST of them, those farthest apart, are looked at.

    Returns:
        The plane by which `HullBlend` shows the views best, if its squared error is at most TOLERANCE times that
        without reflections; None with fewer than FEWEST views, or without masks. Other planes than those across the
        axes need FEWEST_TO_SEARCH views, whose hull is near enough to the object, those near to one FEWEST_TO_REFINE.
    """
    if support.masks is None or len(support) < FEWEST or not support.masks.any():
        return None
    centre = support.bounds.centre
    chosen = farthest_first(camera_directions(support.cameras, centre).cpu(), 0, min(MOST, len(support)))
    views = support[sorted(chosen)].resized(SIZE)
    assert views.masks is not None
    floor = FLOOR * float((views.masks >= SHOWN).sum())
    most = TOLERANCE * (_error(views, views, torch.ones_like(views.masks, dtype=torch.bool)) + floor) - floor

    def best_of(errors: dict[Plane, float]) -> Plane | None:
        return min((plane for plane in errors if errors[plane] <= most), key=lambda plane: errors[plane], default=None)

    errors = _errors(_planes(support.bounds, AXES), views)
    found = best_of(errors)
    if len(support) < (FEWEST_TO_SEARCH if found is None else FEWEST_TO_REFINE):
        return found
    voxels = carve(support.masks, support.cameras, support.bounds, SIDE)
    if voxels.occupied.any():
        more = most_symmetric_plane(voxels) if found is None else more_symmetric_plane(voxels, found)
        errors |= _errors([more], views)
    return best_of(errors)


def _errors(planes: Sequence[Plane], support: Views) -> dict[Plane, float]:
    """The squared errors by which views are shown together with their reflections, of planes that lose few pixels."""
    assert support.masks is not None
    shown, errors = support.masks >= SHOWN, dict[Plane, float]()
    for plane in planes:
        both = join_views(support, reflected(support, plane))
        held = _held(both, support)
        if held is not None and float((shown & ~held).sum()) <= LOST * float(shown.sum()):
            errors[plane] = _error(support, both, held | ~shown)
    return errors


def possible_planes(view: Views) -> list[Plane]:
    """The planes through the middle of a scene that are orthogonal to x or z, which a single view does not contradict.

    Args:
        view: with a mask; y is up, as models are trained.
    """
    assert view.masks is not None
    shown = view.masks >= SHOWN
    found = []
    for plane in _planes(view.bounds, VERTICAL):
        held = _held(join_views(view, reflected(view, plane)), view)
        if held is not None and float((shown & ~held).sum()) <= LOST * float(shown.sum()):
            found.append(plane)
    return found


@dataclass(frozen=True)
class Reflecting:
    """Another method that is shown the views of an object that looks symmetric together with their reflections.

    Attributes:
        adapter: the method.
    """

    adapter: Adapter

    def adapt(self, support: Views) -> Renderable:
        """What the method makes of views and reflections."""
        return self.adapter.adapt(with_reflections(support, symmetry_plane(support)))


def _planes(bounds: Sphere, normals: Sequence[tuple[float, float, float]]) -> list[Plane]:
    """The planes through the middle of a scene that have these normals."""
    return [Plane(normal, sum(a * b for a, b in zip(normal, bounds.centre, strict=True))) for normal in normals]


def _held(views: Views, support: Views) -> Bool[Tensor, "view 1 height width"] | None:
    """The pixels of support views that the hull of other views may show; None where there is no hull."""
    assert views.masks is not None
    found = carve(views.masks, views.cameras, views.bounds, SIDE)
    return footprint(found, support.cameras)[:, None] if found.occupied.any() else None


def _error(support: Views, shown: Views, among: Bool[Tensor, "view 1 height width"]) -> float:
    """The squared error of some pixels of support views by the hull of the views that are shown, and their colours."""
    found = HullBlend().adapt(shown).render(support.cameras)
    return float((found.images - support.images).square().mean(1, keepdim=True)[among].sum())


def _asymmetric_parts(support: Views, both: Views) -> Occupancy:
    """The voxels of the hull of views that lie where these show what their hull with reflections does not hold."""
    assert support.masks is not None
    found, held = hull(support, SIDE), _held(both, support)
    missed = support.masks >= SHOWN
    if held is not None:
        missed &= ~held
    points, occupied = found.centres().to(support.images), found.occupied.clone()
    where = ImagePlanes(missed.to(support.images), support.cameras, background=0.0).lookup(points).colours
    occupied[found.occupied] = where.amax(1)[:, 0] > 0.5
    # up to where they meet the others: there they stand before or behind something that is held
    grown = replace(found, occupied=occupied).dilated(REACH)
    return replace(grown, occupied=grown.occupied & found.occupied)
