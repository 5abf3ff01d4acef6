"""What adapting to an object needs of its support views, and does not depend on weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from hyperplanes.adaptation.base import hull
from hyperplanes.adaptation.reflections import handicaps, with_reflections
from hyperplanes.fields import Target
from hyperplanes.fields.rig import Rig
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.reflections import Symmetry
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.hypernetwork import HyperNetwork, Observed
from hyperplanes.rendering.footprint import footprint
from hyperplanes.views import Views

__all__ = ["SupportContext", "arrange", "live_pixels", "observe", "prepare_context", "trained_on"]


MOST_REFLECTED = 15  # given views, up to which gradient steps take rays of their reflections, too


@dataclass(frozen=True)
class SupportContext:
    """The support side of one object, computed once.

    Attributes:
        views: the support views as the field takes them: in the order of the model's rig, one a plane, or as given.
        planes: the same as the field looks them up; None for a field that reads no image.
        occupancy: the visual hull of all support masks.
        hyperplanes: indices of the views that the hypernetwork reads.
        volume: what the planes show on a grid over the scene, for a hypernetwork that reads it.
        symmetry: of the object, by which the views after the first ones are reflections of these
            (`reflections.images_by`); None where all of them are views that were given.
    """

    views: Views
    planes: ImagePlanes | VisibilityPlanes | None
    occupancy: Occupancy
    hyperplanes: Int[Tensor, " k"]
    volume: Float[Tensor, "channel x y z"] | None = None
    symmetry: Symmetry | None = None

    @property
    def given(self) -> Views:
        """The views without their reflections."""
        return self.views if self.symmetry is None else self.views[: len(self.views) // self.symmetry.images]

    def mask_views(self, views: Int[Tensor, " masked"]) -> SupportContext:
        """The same object, of which some views show the field nothing.

        Args:
            views: their indices.
        """
        return self if self.planes is None else replace(self, planes=self.planes.mask_views(views))


def arrange(support: Views, target: Target, rig: Rig) -> Views:
    """The support views as a field takes them.

    Raises:
        ValueError: no view, or a rig that has not been set.
    """
    if not len(support):
        raise ValueError("support: expected at least one view, got none")
    return target.arrange(support, rig)


def prepare_context(
    support: Views,
    target: Target,
    rig: Rig,
    hypernetwork: HyperNetwork | None,
    hull_resolution: int,
    *,
    carved: bool = True,
    masks_repeated: bool = False,
    symmetry: Symmetry | None = None,
) -> SupportContext:
    """The support side of one object.

    Args:
        support: the views, where the weights are.
        target: the network that looks colours up in them.
        rig: where its planes stand.
        hypernetwork: what reads some of them, if there is one.
        hull_resolution: voxels an axis of the visual hull, at least.
        carved: if False, a single occupied voxel replaces the hull. For a hypernetwork that reads the hull it is carved
            in any case.
        masks_repeated: where there are fewer views than planes, each view is shown at one plane alone.
        symmetry: of the object: reflections of the views count as views, too.
    """
    given, support = len(support), with_reflections(support, symmetry)
    views, device = arrange(support, target, rig), support.images.device

    # the visual hull, of all views and not only of those that are planes
    reads_volume = hypernetwork is not None and hypernetwork.reads_volume
    if carved or reads_volume:
        occupancy = hull(support, target.hull_resolution(hull_resolution, support))
    else:
        occupancy = full(support.bounds, 1, device)

    # what the field looks colours up in
    planes = target.planes_of(views, occupancy)
    if isinstance(planes, VisibilityPlanes) and symmetry is not None:
        planes = planes.with_handicaps(handicaps(given, symmetry))
    if masks_repeated and len(support) < len(views):
        planes = planes.mask_views(rig.repeated(support).to(device))

    # what the hypernetwork reads: a volume of all views, or images of some of them
    if reads_volume:
        return SupportContext(
            views, planes, occupancy, torch.arange(len(views), device=device), target.volume_of(planes), symmetry
        )
    chosen = torch.arange(0, device=device)
    if hypernetwork is not None:
        chosen = target.choose_hyperplanes(views, rig, hypernetwork.views, hypernetwork.choice)
    return SupportContext(views, planes, occupancy, chosen, symmetry=symmetry)


def observe(contexts: Sequence[SupportContext], resolution: int = 0) -> Observed:
    """What a hypernetwork reads of some objects, in one batch (HyperPlanes, Eq. 7: I_1..I_k and d_1..d_k).

    Args:
        contexts: the objects; they may have different numbers of HyperPlanes, and pictures of different sizes.
        resolution: pixels a side that pictures are resized to; 0 takes the size of the first object's.
    """
    if contexts[0].volume is not None:
        return Observed(volume=torch.stack([each.volume for each in contexts if each.volume is not None]))
    read = [each.views[each.hyperplanes] for each in contexts]
    directions = [camera.viewing_directions(each.cameras) for each in read]
    size = (resolution, resolution) if resolution else read[0].size
    images = [_resized(each.images, size) for each in read]
    # objects of fewer HyperPlanes are padded with zeros, which `present` says are no images
    present = [torch.ones(len(each), dtype=torch.bool, device=each.device) for each in directions]
    return Observed(*(pad_sequence(part, batch_first=True) for part in (images, directions, present)))


def trained_on(context: SupportContext, support: Views) -> Views:
    """Where rays come from: the support views, in their order, or a few and their reflections about one plane.

    Rays of reflections about several planes show 0.3 dB less (17 lamps from 3 and 5 views, 100 steps). Many views show
    an object well enough, and what is not quite symmetric would be learned wrongly (docs/image-based-measurements.md).

    Args:
        context: of the object.
        support: the views, without reflections.
    """
    few = context.symmetry is not None and len(support) <= MOST_REFLECTED
    return context.views[: 2 * len(support)] if few else support


def live_pixels(occupancy: Occupancy, views: Views) -> Int[Tensor, " pixel"]:
    """Flat indices (view, row, column) of the pixels whose rays meet something."""
    return footprint(occupancy, views.cameras).flatten().nonzero()[:, 0]


def _resized(images: Float[Tensor, "view 3 height width"], size: tuple[int, int]) -> Tensor:
    """Images of that size, by the mean of the pixels that one covers where there are more."""
    return images if images.shape[2:] == size else torch.nn.functional.interpolate(images, size, mode="area")
