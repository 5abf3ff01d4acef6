"""ImagePlanes: posed images as a function from world points to colours (MultiPlaneNeRF; HyperPlanes, Eq. 3)."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry import lookup_torch
from hyperplanes.geometry.distortion import DistortedCamera, distorted_pixels
from hyperplanes.geometry.inputs import (
    ArrayLike,
    Selection,
    as_images,
    as_indices,
    as_points,
    as_selection,
    check_indices,
)
from hyperplanes.geometry.lookup import Lookup, choose, lookup
from hyperplanes.geometry.lookup_torch import MIN_Z
from hyperplanes.geometry.notebooks import show_views
from hyperplanes.geometry.packed_images import PackedImages, pack
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.cached_on import cached_on
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.utilities.tensors.transforms import are_plain

__all__ = ["MIN_Z", "ImagePlanes", "Lookup"]


class ImagePlanes:
    """Images with their cameras, as one function of world points.

    A batch of several objects is one set of planes; `views` holds the indices of the planes of each point's object.
    """

    @checked
    def __init__(
        self,
        images: ArrayLike,
        cameras: PinholeCamera,
        background: float = 1.0,
        *,
        backend: str | None = None,
        exact: bool = False,
    ) -> None:
        """Planes from images and their cameras.

        Args:
            images: (view, channel, height, width), any number of channels; 8-bit ones are divided by 255. Three
                channels in [0, 1] that need no gradient may be read from a copy packed into 32 bits a pixel, exact for
                8-bit images and within 1/2046 for others. NumPy arrays, inference tensors and non-contiguous tensors
                are copied, so that changes in place do not reach the planes.
            cameras: one an image, of the images' size.
            background: colour of points outside an image.
            backend: of the lookup; the fastest available where absent.
            exact: never read a packed copy.

        Raises:
            ValueError: images of another number or size than the cameras, or of another number of dimensions.
        """
        given = images
        images = as_images(images, size=camera.image_size(cameras) if cameras.batch_size else None)
        if len(images) != cameras.batch_size:
            raise ValueError(f"images: expected one a camera, {cameras.batch_size}, got {len(images)}")
        if len(images) and camera.image_size(cameras) != tuple(images.shape[2:]):
            raise ValueError(
                f"images: expected the cameras' size {camera.image_size(cameras)}, got {tuple(images.shape[2:])}"
            )
        self.images = _counting(images.contiguous(), given)  # as the kernels need
        self.cameras = cameras
        self.background = background
        self.backend = backend
        self.exact = exact
        self.nearest = camera.least_depth(cameras)
        self.masked: Bool[Tensor, " view"] | None = None

    def __len__(self) -> int:
        return len(self.images)

    def __repr__(self) -> str:
        count, channels, height, width = self.images.shape
        return f"ImagePlanes({count} of {width}x{height}, {channels} channels, {self.images.device})"

    def _repr_html_(self) -> str:
        """The images and where their cameras stand, for notebooks."""
        return show_views(repr(self), self.images, self.cameras)

    def mask_views(self, views: Selection) -> ImagePlanes:
        """The same planes with more views masked: no point is valid in them, and their colour is the background.

        Args:
            views: indices of the views to mask, or a boolean for each view.
        """
        chosen = as_selection(views, len(self), "views")
        result = copy.copy(self)
        before = self.images.new_zeros(len(self), dtype=torch.bool) if self.masked is None else self.masked
        result.masked = before.clone()
        result.masked[chosen] = True
        return result

    def with_images(self, images: ArrayLike) -> ImagePlanes:
        """The same cameras with other images, looked up exactly; no view is masked.

        Args:
            images: of the same number and size, with any number of channels, as the class takes them.

        Raises:
            ValueError: images of another number or size.
        """
        given, images = images, as_images(images)
        if (len(images), *images.shape[2:]) != (len(self), *self.images.shape[2:]):
            expected = f"({len(self)}, channel, {self.images.shape[2]}, {self.images.shape[3]})"
            raise ValueError(f"images: expected shape {expected}, got {tuple(images.shape)}")
        result = copy.copy(self)
        result.images, result.exact, result.masked = _counting(images.contiguous(), given), True, None
        vars(result).pop("_cached_packed", None)
        return result

    @without_autocast
    def lookup(
        self,
        points: ArrayLike,
        views: ArrayLike | None = None,
        *,
        return_directions: bool = False,
    ) -> Lookup:
        """Projects every point onto the planes and interpolates the colours there.

        A point counts as behind a camera where z in its frame is below `cameras.least_depth`.

        Args:
            points: (point, 3) in the world.
            views: (point, chosen), indices of the planes of each point; all planes where absent.
            return_directions: also return the direction and distance from each camera.

        Returns:
            Colours, coordinates and validity, differentiable in points, images and cameras.
        """
        points = as_points(points)
        views = None if views is None else as_indices(views, points)
        matrices = camera.projection_matrices(self.cameras)
        if isinstance(self.cameras, DistortedCamera):
            found = self._lookup_distorted(points, matrices, views)
        else:
            found = lookup(
                points,
                matrices,
                self.images,
                views,
                background=self.background,
                nearest=self.nearest,
                packed=self.packed_images(points),
                backend=self.backend,
            )
        if self.masked is not None:
            masked = self.masked.to(points.device)
            shown = found.valid & ~(masked if views is None else masked[views])
            found = replace(found, colours=torch.where(shown[..., None], found.colours, self.background), valid=shown)
        if not return_directions:
            return found
        centres = camera.centres(self.cameras).to(points)
        offsets = points[:, None] - (centres if views is None else centres[views])
        distances = offsets.norm(dim=-1)
        # at a centre both are 0, and a gradient of 1 / 0 would be infinite
        directions = offsets / torch.where(distances > 0, distances, 1.0)[..., None]
        return replace(found, directions=directions, distances=distances)

    def _lookup_distorted(self, points: Tensor, matrices: Tensor, views: Tensor | None) -> Lookup:
        """The lookup in plain PyTorch; points that a lens cannot show count as behind the camera."""
        assert isinstance(self.cameras, DistortedCamera)
        if views is not None:
            check_indices(views, len(self.images))
        ideal, front = lookup_torch.project(points, matrices.to(points), views, self.nearest)
        pixels, shown = distorted_pixels(self.cameras, ideal, views)
        coordinates, valid = lookup_torch.place(pixels, front & shown, *self.images.shape[2:])
        colours = lookup_torch.interpolate(self.images.to(points), coordinates, views)
        return Lookup(torch.where(valid[..., None], colours, self.background), coordinates, valid)

    def packed_images(self, points: Tensor) -> PackedImages | None:
        """The images in 32 bits a pixel, for points that may be looked up in them; None otherwise.

        Packed at the first lookup that can use them, and again after the images have changed.
        """
        if self.exact or self.images.requires_grad or self.images.device.type != "cpu" or points.dtype != torch.float32:
            return None
        if not are_plain(points, self.images) or (self.backend or choose(points, self.images)) != "cpu":
            return None
        return cached_on(self, "packed", [self.images], lambda: pack(self.images))


def _counting(images: Tensor, given: ArrayLike) -> Tensor:
    """Images whose changes in place PyTorch counts, so that they are packed again after one: a copy where needed.

    Args:
        images: made of the caller's.
        given: the caller's images.
    """
    shared = isinstance(given, np.ndarray) and np.may_share_memory(images.numpy(), given)
    if not (shared or images.is_inference()):
        return images
    with torch.inference_mode(False):
        return images.clone()
