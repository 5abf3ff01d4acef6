"""The canonical frame of an object: the one in which objects of its class are aligned in the training data.

As in NOCS (Wang et al. 2019, "Normalized Object Coordinate Space"), which predicts it; here held-out views decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from hyperplanes.adaptation.alignment.finding_symmetry import find_symmetry
from hyperplanes.adaptation.alignment.rotation import Rotation
from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.network import HyperPlanesNetwork
from hyperplanes.geometry.kernels.threads import map_long_parts
from hyperplanes.geometry.symmetry.reflections import Symmetry
from hyperplanes.views import Views

__all__ = ["Placed", "find_rotation", "to_canonical_frame"]

FOLDS = 2  # views that are held out, one at a time; a third one finds no more
MIN_VIEWS, MAX_VIEWS = FOLDS, 15  # numbers of views for which a frame is looked for
HELD_OUT_SIZE = 64  # pixels of a held-out view along its longer side
HELD_OUT_PIXELS = 1024  # that are compared
GAIN = 0.75  # dB on held-out views that a rotation must gain over no rotation, if that is possible
MIN_SQUARED_ERROR = 1e-4  # of squared errors; smaller ones, as of empty views, say nothing
MAX_ALIGNED_PLANES = 2  # of symmetry: an object with more looks the same after each of the rotations
QUARTER = math.pi / 2
ALIGNED = math.radians(0.5)  # a plane that is further from orthogonal to an axis is rotated


@dataclass(frozen=True)
class Placed:
    """The views of an object in its canonical frame.

    Attributes:
        views: the rotated views.
        symmetry: of the rotated object.
        rotation: from the frame of the scene.
    """

    views: Views
    symmetry: Symmetry | None
    rotation: Rotation

    def context(self, network: HyperPlanesNetwork, *, carved: bool = True) -> SupportContext:
        """What `HyperPlanes.prepare` makes of the rotated views and their reflections."""
        return network.prepare(self.views, carved=carved, symmetry=self.symmetry)

    def in_scene(self, field: AdaptedField) -> AdaptedField:
        """A field of these views in the frame of the scene."""
        return self.rotation.inverse.field(field)


def to_canonical_frame(network: HyperPlanesNetwork, support: Views) -> Placed:
    """The views of an object in its canonical frame, if the model looks for one, and the symmetry of the object.

    Args:
        network: the model.
        support: the views.
    """
    symmetry = find_symmetry(network, support)
    rotation = find_rotation(network, support, symmetry)
    return Placed(rotation.views(support), rotation.symmetry(symmetry, support.bounds), rotation)


@torch.no_grad()
def find_rotation(network: HyperPlanesNetwork, support: Views, symmetry: Symmetry | None) -> Rotation:
    """The rotation that aligns an object with those of its class in training.

    A vertical plane of symmetry leaves four rotations: after each it is orthogonal to the x or to the z axis. With the
    right one, the model renders held-out views best.

    Args:
        network: the model.
        support: the views of the object.
        symmetry: of the object.

    Returns:
        `config.azimuth` if that is known. Otherwise the one of the four with the highest mean PSNR on held-out views;
        if the plane is orthogonal to an axis already, a rotation must gain at least GAIN over none. The rotation by 0
        if the object has no such plane or more than MAX_ALIGNED_PLANES, and with fewer than MIN_VIEWS or more than
        MAX_VIEWS views.
    """
    config = network.config
    if config.azimuth is not None:
        return Rotation(config.azimuth)
    if (
        not config.symmetric
        or symmetry is None
        or symmetry.order > MAX_ALIGNED_PLANES
        or not MIN_VIEWS <= len(support) <= MAX_VIEWS
    ):
        return Rotation()
    x, y, z = symmetry.plane.normal
    if abs(y) > math.hypot(x, z):
        return Rotation()
    smallest = (math.atan2(z, x) + QUARTER / 2) % QUARTER - QUARTER / 2
    smallest = smallest if abs(smallest) > ALIGNED else 0.0
    rotations = [Rotation(smallest + turns * QUARTER) for turns in range(4)]
    # the same views are held out, one at a time, for each rotation
    views = network.to_own(support).resized(HELD_OUT_SIZE)
    placed = [Placed(each.views(views), each.symmetry(symmetry, views.bounds), each) for each in rotations]
    trials = [(each, held_out) for each in placed for held_out in range(FOLDS)]
    found = map_long_parts(lambda trial: _quality(network, *trial), trials, views.images.device)
    qualities = [sum(found[start : start + FOLDS]) / FOLDS for start in range(0, len(found), FOLDS)]
    if not smallest:
        qualities[0] += GAIN
    return rotations[max(range(len(rotations)), key=qualities.__getitem__)]


def _quality(network: HyperPlanesNetwork, placed: Placed, held_out: int) -> float:
    """PSNR of some pixels of a view, by the field of the other views; 0 if these do not show the object."""
    views, near_far = placed.views, network.config.sampling.near_far
    shown = views[[index for index in range(len(views)) if index != held_out]]
    if shown.masks is not None and not shown.masks.any():
        return 0.0
    generator = torch.Generator().manual_seed(0)
    rays, truth = views[[held_out]].sample_rays(HELD_OUT_PIXELS, generator=generator, near_far=near_far)
    context = replace(placed, views=shown).context(network)
    field = network.field(context, network.adapted_weights(context))
    error = float((field.trace(rays, differentiable=False).colour - truth).square().mean())
    return -10 * math.log10(max(error, MIN_SQUARED_ERROR))
