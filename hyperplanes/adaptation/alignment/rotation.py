"""Rotations about the vertical axis of a scene, of the views, the symmetry and the field of an object."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, Pictures
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays, Sphere
from hyperplanes.geometry.symmetry.reflections import Symmetry, rotation_about
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.renderer import Sampler
from hyperplanes.rendering.scene import mapped
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.views import Views, moved

__all__ = ["RotatedField", "Rotation"]


@dataclass(frozen=True)
class Rotation:
    """A rotation of an object, the same for all of its views.

    Attributes:
        angle: in radians, about the vertical axis through the centre of the scene; a quarter turn maps the z axis to
            the x axis.
    """

    angle: float = 0.0

    @property
    def inverse(self) -> Rotation:
        """The inverse rotation."""
        return Rotation(-self.angle)

    def about(self, bounds: Sphere) -> Float[Tensor, "4 4"]:
        """The transform of world coordinates, in float64."""
        return rotation_about(bounds.centre, self.angle)

    def views(self, views: Views) -> Views:
        """The views of the rotated object: the same images with rotated cameras."""
        return moved(views, self.about(views.bounds)) if self.angle else views

    def symmetry(self, symmetry: Symmetry | None, bounds: Sphere) -> Symmetry | None:
        """The symmetry of the rotated object."""
        return symmetry.moved(self.about(bounds)) if symmetry is not None and self.angle else symmetry

    def field(self, field: AdaptedField) -> AdaptedField:
        """The field of the rotated object, which renders the given field from cameras that are rotated back."""
        if not self.angle:
            return field
        bounds = field.occupancy.bounds
        back = partial(_moved, motion=self.inverse.about(bounds))
        return RotatedField(
            mapped(field.field, back, partial(back, translated=0.0)),
            self._occupancy(field.occupancy),
            field.sampling,
            symmetry=self.symmetry(field.symmetry, bounds),
            fine_tuned=field.fine_tuned,
            unrotated=field,
            rotation=self,
        )

    def _occupancy(self, occupancy: Occupancy) -> Occupancy:
        """Voxels that cover the rotated ones."""
        occupied = torch.zeros_like(occupancy.occupied)
        occupied.view(-1)[occupancy.index(_moved(occupancy.centres(), self.about(occupancy.bounds)))] = True
        return replace(occupancy, occupied=occupied).dilated()  # half a diagonal of a voxel is less than one


@dataclass(frozen=True, repr=False)
class RotatedField(AdaptedField):
    """The field of a rotated object: another field at points that are rotated back.

    Attributes:
        unrotated: the other field.
        rotation: of the object.
    """

    unrotated: AdaptedField = field(kw_only=True)
    rotation: Rotation = field(kw_only=True)

    def __repr__(self) -> str:
        return f"RotatedField({self.unrotated!r}, {self.rotation.angle:.2f} radians)"

    def with_sampling(self, sampling: Sampler) -> RotatedField:
        """As `AdaptedField.with_sampling`."""
        return replace(self, sampling=sampling, unrotated=self.unrotated.with_sampling(sampling))

    def with_penalty_at(self, centre: Float[Tensor, 3], penalty: float) -> RotatedField:
        """As `AdaptedField.with_penalty_at`."""
        return replace(self, unrotated=self.unrotated.with_penalty_at(_moved(centre, self._back), penalty))

    @property
    def _back(self) -> Float[Tensor, "4 4"]:
        return self.rotation.inverse.about(self.occupancy.bounds)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """As `AdaptedField.density`."""
        return self.unrotated.density(_moved(points, self._back))

    def trace(self, rays: Rays, generator: torch.Generator | None = None, *, differentiable: bool = True) -> Rendered:
        """As `AdaptedField.trace`."""
        origins, directions = _moved(rays.origins, self._back), _moved(rays.directions, self._back, 0.0)
        rays = replace(rays, origins=origins, directions=directions)
        return self.unrotated.trace(rays, generator, differentiable=differentiable)

    def _pictures(
        self, cameras: PinholeCamera, sampling: Sampler | None, antialias: bool | None, mixed_precision: bool
    ) -> Pictures:
        cameras = camera.moved(cameras, self._back)
        return self.unrotated.render(cameras, sampling, antialias, mixed_precision=mixed_precision)


@without_autocast
def _moved(points: Float[Tensor, "*point 3"], motion: Float[Tensor, "4 4"], translated: float = 1.0) -> Tensor:
    """Points after a rigid motion; directions, which it does not translate, with 0."""
    motion = motion.to(points)
    return points @ motion[:3, :3].T + translated * motion[:3, 3]
