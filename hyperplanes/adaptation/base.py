"""The interface of methods: an adapter turns support views into a field that renders new views."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.fields.base import Field
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.inputs import as_points
from hyperplanes.geometry.kernels.threads import parallel_map
from hyperplanes.geometry.notebooks import show_views
from hyperplanes.geometry.occupancy import MIN_MASK_OPACITY, Occupancy, carve, full
from hyperplanes.geometry.rays import Rays
from hyperplanes.geometry.symmetry.reflections import Symmetry
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.footprint import pixels_across
from hyperplanes.rendering.images import Pictures
from hyperplanes.rendering.refinement import RefinedOccupancy, refine
from hyperplanes.rendering.renderer import FieldFunction, Sampler, render
from hyperplanes.rendering.scene import dtype_of, is_thread_safe, mapped
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.messages.errors import listed
from hyperplanes.utilities.tensors.cached_on import cached_on
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.views import Views

__all__ = [
    "AdaptedField",
    "Adapter",
    "Pictures",
    "Renderable",
    "attributes_of",
    "check_masks",
    "hull",
    "masks_problem",
    "no_masks_warning",
]

MARGIN_LOSS = 0.9  # `margin_loss` of `refine`: 2.4 % in one voxel
MAX_HAZY_SHARE = 0.5  # of the pixels of a mask: a larger share with an opacity of less than MIN_MASK_OPACITY is refused
MAX_MASK_COVERAGE = 0.95  # mean opacity above which masks are as good as no masks
PROBLEM = "the views have"  # how the text of `masks_problem` begins
DENSITY_CHUNK = 1 << 12  # per thread, for densities


@runtime_checkable
class Renderable(Protocol):
    """Anything that renders new views."""

    def render(self, cameras: PinholeCamera) -> Pictures:
        """The pictures of the cameras."""
        ...


@runtime_checkable
class Adapter(Protocol):
    """A method: support views -> a field."""

    def adapt(self, support: Views) -> Renderable:
        """The field of one object."""
        ...


@dataclass(frozen=True)
class AdaptedField:
    """A field of one object with everything needed to render it.

    Attributes:
        field: (points, directions) -> (colour, density).
        occupancy: voxels outside of which it is empty: the visual hull of the support masks.
        sampling: the sampler that it was trained with.
        proposal: the coarse field of `Hierarchical` sampling, if it is another one.
        densities: points -> density without colour, of the field and of its proposal.
        refined: the voxels of `occupancy` in which it has density, if known.
        symmetry: by which its views were reflected, if they were.
        fine_tuned: whether gradient steps on its views made it.
    """

    field: FieldFunction
    occupancy: Occupancy
    sampling: Sampler
    proposal: FieldFunction | None = None
    densities: tuple[Callable[[Tensor], Tensor], ...] = ()
    refined: RefinedOccupancy | None = None
    symmetry: Symmetry | None = None
    fine_tuned: bool = False

    def __repr__(self) -> str:
        side = self.occupancy.occupied.shape[0]
        share = float(self.occupancy.occupied.float().mean())
        return f"AdaptedField({self.field!r}, {self.sampling!r}, {share:.0%} of {side}^3 voxels)"

    def _repr_html_(self) -> str:
        """Four pictures of the field from all around, for notebooks."""
        bounds = self.occupancy.bounds
        angles = torch.arange(4) * (torch.pi / 2)
        eyes = torch.stack([angles.sin(), torch.full((4,), 0.4), angles.cos()], 1) * 3 * bounds.radius
        poses = camera.look_at(eyes + torch.tensor(bounds.centre), bounds.centre)
        cameras = camera.pinhole(camera.symmetric_intrinsics(96, 96, 0.8), poses, 96, 96)
        return show_views(repr(self), self.render(cameras).images, cameras, bounds)

    def with_sampling(self, sampling: Sampler) -> AdaptedField:
        """The same field, rendered with another sampler.

        Args:
            sampling: the sampler.
        """
        return replace(self, sampling=sampling)

    def without_residuals(self) -> AdaptedField:
        """The same field without residual correction of its pictures (`adaptation.correction.residuals`)."""
        return self

    def with_penalty_at(self, centre: Float[Tensor, 3], penalty: float) -> AdaptedField:
        """The same field, which prefers other support views to those from one place; densities and voxels stay.

        Args:
            centre: of their cameras.
            penalty: as in `VisibilityPlanes.with_penalty_at`.

        Returns:
            A field with that penalty; one that does not choose between views is returned unchanged.
        """
        own, planes = self.field, getattr(self.field, "planes", None)
        if not (isinstance(planes, VisibilityPlanes) and is_dataclass(own) and not isinstance(own, type)):
            return self
        penalised = replace(own, planes=planes.with_penalty_at(centre, penalty))
        return replace(self, field=penalised, refined=self.refined_occupancy)

    @property
    def dtype(self) -> torch.dtype:
        """The dtype in which the field expects points."""
        return dtype_of(self.field)

    @property
    def thread_safe(self) -> bool:
        """Whether several threads may evaluate the field at once."""
        return is_thread_safe(self.field)

    @property
    def refined_occupancy(self) -> RefinedOccupancy:
        """The voxels of `occupancy` in which the field has density: `refined`, or computed on first use.

        Computed ones are computed again if weights of a network, or the voxels, have changed in place.
        """
        if self.refined is not None:
            return self.refined
        weights = self.field.parameters.values() if isinstance(self.field, Field) else ()
        make = partial(refine, self.occupancy, self.density, margin_loss=MARGIN_LOSS)
        return cached_on(self, "refined", [self.occupancy.occupied, *weights], make)

    @without_autocast
    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per world unit, without evaluating colour if the field can do that."""
        points = as_points(points)
        own = points.to(self.dtype)
        if self.thread_safe and points.device.type == "cpu" and not torch.is_grad_enabled():
            return torch.cat(list(parallel_map(self._density, own.split(DENSITY_CHUNK)))).to(points.dtype)
        return self._density(own).to(points.dtype)

    def _density(self, points: Tensor) -> Tensor:
        if self.densities:
            return self.densities[0](points)
        return self.field(points, torch.nn.functional.normalize(points, dim=-1))[1]

    @without_autocast
    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour and density of the field, in the precision of the points."""
        colour, density = self.field(points.to(self.dtype), directions.to(self.dtype))
        return colour.to(points.dtype), density.to(points.dtype)

    @without_autocast
    def trace(self, rays: Rays, generator: torch.Generator | None = None, *, differentiable: bool = True) -> Rendered:
        """The pixels of rays with the field's own sampler: the forward pass of training.

        Args:
            rays: through the scene, in any precision.
            generator: of the positions of samples; on the CPU.
            differentiable: with gradients; otherwise in chunks, with early ray termination.
        """
        return render(
            self.field, rays.to(self.dtype), self.sampling, occupancy=self.occupancy, proposal=self.proposal,
            generator=generator, differentiable=differentiable,
        )  # fmt: skip

    @checked
    @without_autocast
    @torch.no_grad()
    def render(
        self,
        cameras: PinholeCamera,
        sampling: Sampler | None = None,
        antialias: bool | None = None,
        *,
        mixed_precision: bool = True,
    ) -> Pictures:
        """The pictures of cameras, without gradients; rays and pixels in single precision, whatever that of the field.

        Args:
            cameras: any number, one image size, on any device and in any precision.
            sampling: a sampler; by default that of the field, with denser samples if it is `RayMarching`: as many as
                the camera needs that shows the scene largest.
            antialias: five rays through each pixel at an edge; by default for `RayMarching`.
            mixed_precision: a float32 network may multiply in bfloat16 (`Field.mixed_precision`); otherwise the field
                decides.

        Returns:
            One picture a camera, on the device of the field.
        """
        return self._pictures(cameras, sampling, antialias, mixed_precision)

    def _pictures(
        self, cameras: PinholeCamera, sampling: Sampler | None, antialias: bool | None, mixed_precision: bool
    ) -> Pictures:
        """As `render`, which fields made of other fields define by this."""
        sampling = sampling or self.sampling.for_rendering(pixels_across(cameras, self.occupancy.bounds))
        return render(
            self._for_pictures(self.field, mixed_precision),
            camera.to(cameras, self.occupancy.occupied.device),
            sampling,
            bounds=self.occupancy.bounds,
            occupancy=self.refined_occupancy if sampling.needs_occupancy else None,
            proposal=self.proposal and self._for_pictures(self.proposal, mixed_precision),
            antialias=antialias,
        )

    def _for_pictures(self, field: FieldFunction, mixed_precision: bool) -> FieldFunction:
        """A field as a function of float32 points; in mixed precision, if it is a float32 network."""
        if self.dtype != torch.float32:
            cast = partial(torch.Tensor.to, dtype=self.dtype)
            return mapped(field, cast, cast, torch.Tensor.float)
        return field.in_mixed_precision if mixed_precision and isinstance(field, Field) else field


def attributes_of(adapted: AdaptedField) -> dict[str, Any]:
    """The attributes of a field by name, for another one that is made of it."""
    return {each.name: getattr(adapted, each.name) for each in fields(AdaptedField)}


def hull(support: Views, side: int, within: Occupancy | None = None) -> Occupancy:
    """The visual hull of the support masks, or a full grid without masks.

    Args:
        support: the views.
        side: voxels an axis.
        within: voxels that the hull is known to lie in.

    Raises:
        ValueError: an empty mask, masks whose background has some opacity, or masks whose hull is empty.
    """
    if support.masks is None:
        return full(support.bounds, side, support.images.device)
    check_masks(support)
    carved = carve(support.masks, support.cameras, support.bounds, side, within=within)
    if not carved.occupied.any():
        raise ValueError(
            f"masks of the support views{_from_to(support.names)}: expected an object, got no point that all of them "
            "may show; check alpha and poses, or leave the masks out"
        )
    return carved


def check_masks(support: Views) -> None:
    """Refuse masks that would silently make the hull far too small or too large.

    An empty mask says that nothing of the object is in its picture: carving removes what all others show there. Methods
    that begin with some of the views check all of them first, so that the message counts all.

    Raises:
        ValueError: some masks are empty, or have some opacity nearly everywhere.
    """
    if support.masks is None:
        return
    masks, names, flat = support.masks, support.names, support.masks.flatten(1)
    empty: list[int] = (flat.amax(1) == 0).nonzero()[:, 0].tolist()
    if empty and len(empty) == len(masks):
        raise ValueError(
            f"masks of the support views{_from_to(names)}: expected an object, got none with a pixel set; "
            "check alpha and poses, or leave the masks out"
        )
    if empty:
        found = f"{len(empty)} of {len(masks)} empty: {listed([names[view] if names else str(view) for view in empty])}"
        raise ValueError(
            f"masks of the support views: expected a part of the object in each, found {found}; "
            "leave these views out or correct their masks"
        )
    # as much of faint opacity is no edge
    hazy = ((flat > 0) & (flat < MIN_MASK_OPACITY)).float().mean(1) > MAX_HAZY_SHARE
    if hazy.any():
        least = float(flat[hazy].median())
        raise ValueError(
            f"masks of the support views: expected opacity 0 in the background, found {least:.2g} in most pixels of "
            f"{int(hazy.sum())} of {len(masks)}; set opacity below {MIN_MASK_OPACITY} to 0"
        )


def masks_problem(support: Views) -> str:
    """What is wrong with views without masks, or with masks that leave no background, in one sentence; else nothing."""
    covered = 1.0 if support.masks is None else float(support.masks.mean())
    if not covered > MAX_MASK_COVERAGE:
        return ""
    what = "no alpha and no masks" if support.masks is None else f"masks that cover {covered:.0%}"
    return (
        f"{PROBLEM} {what}, but the model was trained on objects over white, so it would treat the background "
        "as a part of the object; cut the object out (RGBA images, or a folder masks/)"
    )


@contextmanager
def no_masks_warning() -> Generator[None]:
    """A context in which models do not warn of `masks_problem`, for callers that have reported it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", PROBLEM, UserWarning)
        yield


def _from_to(names: Sequence[str]) -> str:
    return f" ({names[0]} to {names[-1]})" if names else ""
