"""What every method is to evaluation: support views in, something that renders new views out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy, carve, full
from hyperplanes.geometry.rays import Rays, Sphere, cast, pixel_grid
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.footprint import footprint
from hyperplanes.rendering.refinement import refine
from hyperplanes.rendering.renderer import FieldFunction, Hierarchical, Marched, render, render_in_chunks
from hyperplanes.views import Views

__all__ = ["AdaptedField", "Adapter", "Pictures", "Renderable", "hull", "photograph"]


@dataclass(frozen=True)
class Pictures:
    """Rendered views.

    Attributes:
        images: RGB over white.
        opacity: how much of each pixel is covered.
        depth: distance along the ray in world units, 0 where nothing is.
        samples: how often the field was asked, over all pixels.
    """

    images: Float[Tensor, "view 3 height width"]
    opacity: Float[Tensor, "view 1 height width"]
    depth: Float[Tensor, "view 1 height width"]
    samples: int


@runtime_checkable
class Renderable(Protocol):
    """Anything that can be looked at from new cameras."""

    def render(self, cameras: PinholeCamera) -> Pictures:
        """The pictures that the cameras see."""
        ...


@runtime_checkable
class Adapter(Protocol):
    """A method: support views -> a field."""

    def adapt(self, support: Views) -> Renderable:
        """What the method makes of one object."""
        ...


@dataclass(frozen=True)
class AdaptedField:
    """A field of one object with all that rendering it needs.

    Attributes:
        field: (points, directions) -> (colour, density).
        occupancy: where it can be anything but empty, by the masks of the support views.
        sampling: the protocol to render it by.
        proposal: the coarse field of `Hierarchical` sampling, where it is another one.
        densities: points -> density alone, of the field and of its proposal.
    """

    field: FieldFunction
    occupancy: Occupancy
    sampling: Hierarchical | Marched
    proposal: FieldFunction | None = None
    densities: tuple[Callable[[Tensor], Tensor], ...] = ()

    @cached_property
    def filled(self) -> Occupancy:
        """Where it is anything but empty, by its own word: asked once, when the first view is rendered."""
        return refine(self.occupancy, self.density)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density alone, as the field gives it."""
        if self.densities:
            return self.densities[0](points)
        return self.field(points, torch.nn.functional.normalize(points, dim=-1))[1]

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour and density, as the field gives them."""
        return self.field(points, directions)

    def trace(self, rays: Rays, generator: torch.Generator | None = None) -> Rendered:
        """What rays see by the field's own protocol, with gradients: one step of training."""
        return render(
            self.field, rays, self.sampling, occupancy=self.occupancy, proposal=self.proposal, generator=generator
        )

    @torch.no_grad()
    def render(self, cameras: PinholeCamera, sampling: Hierarchical | Marched | None = None) -> Pictures:
        """The pictures that the cameras see.

        Args:
            cameras: any number, one image size, on any device and in any precision.
            sampling: another protocol than the field's own, whose samples are made denser for pictures where they
                are marched.

        Returns:
            One picture a camera, where the field is.
        """
        if sampling is None:
            sampling = self.sampling.finer if isinstance(self.sampling, Marched) else self.sampling
        cameras = camera.to(cameras, self.occupancy.occupied.device)
        if isinstance(sampling, Hierarchical):
            return photograph(
                cameras,
                self.occupancy.bounds,
                lambda rays: render_in_chunks(self.field, rays, sampling, proposal=self.proposal),
                span="depth",
            )
        return photograph(
            cameras,
            self.occupancy.bounds,
            lambda rays: render_in_chunks(self.field, rays, sampling, occupancy=self.filled),
            seen=self.filled,
        )


def photograph(
    cameras: PinholeCamera,
    bounds: Sphere,
    see: Callable[[Rays], Rendered],
    *,
    seen: Occupancy | None = None,
    span: str = "sphere",
) -> Pictures:
    """Pictures from anything that sees along rays.

    Rays are cast in the precision of the cameras and seen in single precision, as pictures are.

    Args:
        cameras: any number, one image size.
        bounds: what near and far of the rays are taken from.
        see: the pixels of rays.
        seen: where anything can be; pixels that do not look there stay white and are never asked for.
        span: as in `geometry.cast`.

    Returns:
        One picture a camera.
    """
    height, width = camera.image_size(cameras)
    pixels = pixel_grid(height, width, cameras.intrinsics.device)
    live = None if seen is None else footprint(seen, cameras).flatten(1)
    values = pixels.new_zeros(cameras.batch_size, height * width, 5)
    values[..., :3] = 1.0
    samples = 0
    for view in range(cameras.batch_size):
        chosen = torch.arange(len(pixels), device=pixels.device) if live is None else live[view].nonzero()[:, 0]
        if not len(chosen):
            continue
        rays = cast(cameras, torch.full_like(chosen, view), pixels[chosen], bounds, span=span)
        part = see(Rays(rays.origins.float(), rays.directions.float(), rays.near.float(), rays.far.float()))
        values[view, chosen] = torch.cat([part.colour, part.opacity[:, None], part.depth[:, None]], 1).to(values)
        samples += part.samples
    maps = values.reshape(cameras.batch_size, height, width, 5).permute(0, 3, 1, 2)
    return Pictures(maps[:, :3], maps[:, 3:4], maps[:, 4:], samples)


def hull(support: Views, side: int) -> Occupancy:
    """The visual hull of the support masks, or a full grid where there are none.

    Raises:
        ValueError: masks that leave nothing.
    """
    if support.masks is None:
        return full(support.bounds, side, support.images.device)
    carved = carve(support.masks, support.cameras, support.bounds, side)
    seen = int((support.masks > 0).flatten(1).any(1).sum())
    if not (seen and carved.occupied.any()):
        found = f"{seen} of {len(support)} with a pixel set, and no point that all of them may show"
        views = f" ({support.names[0]} to {support.names[-1]})" if support.names else ""
        raise ValueError(
            f"masks of the support views{views}: expected an object, got {found if seen else 'none with a pixel set'}; "
            "check alpha and poses, or leave the masks out"
        )
    return carved
