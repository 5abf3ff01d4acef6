"""`Views` are posed images of one scene. A `Task` has the support and query views of one object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import interpolate

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.inputs import Selection, as_selection, check_channels_first, check_indices
from hyperplanes.geometry.notebooks import show_views
from hyperplanes.geometry.rays import Rays, Sphere, cast, pixel_grid
from hyperplanes.utilities.images.image_range import check_image_range
from hyperplanes.utilities.images.sizes import scaled_size
from hyperplanes.utilities.messages.arguments import checked, kind_of

__all__ = ["Classified", "Task", "Tasks", "Views", "class_of", "join_views", "moved"]


@dataclass(frozen=True)
class Views:
    """Posed images of one scene.

    Attributes:
        images: RGB in [0, 1], composited over white; shape (N, 3, H, W), as in PyTorch.
        cameras: one camera per view, with OpenCV axes and integer pixel centres.
        masks: opacity in [0, 1], or None for images without masks.
        bounds: the sphere that contains everything to be reconstructed.
        names: the file of each view, for messages and file names.
        up: the up direction stated by the files, as `data.upright.y_up_from` takes it; None if they state none.
    """

    images: Float[Tensor, "view 3 height width"]
    cameras: PinholeCamera
    masks: Float[Tensor, "view 1 height width"] | None = None
    bounds: Sphere = field(default_factory=Sphere)
    names: tuple[str, ...] = ()
    up: str | None = None

    def __post_init__(self) -> None:
        check_image_range("images", self.images)
        if not isinstance(self.cameras, PinholeCamera):
            raise ValueError(f"cameras: expected a PinholeCamera of Kornia, got {kind_of(self.cameras)}")
        if self.masks is not None:
            check_image_range("masks", self.masks)
        if self.images.ndim == 4 and len(self.images) and self.cameras.batch_size:
            check_channels_first("images", self.images, camera.image_size(self.cameras))
        if self.images.ndim != 4 or self.images.shape[1] != 3:
            raise ValueError(f"images: expected shape (view, 3, height, width), got {tuple(self.images.shape)}")
        if len(self.images) != self.cameras.batch_size:
            raise ValueError(f"images: expected one a camera, {self.cameras.batch_size}, got {len(self.images)}")
        if len(self.images) and camera.image_size(self.cameras) != self.size:
            raise ValueError(f"images: expected the cameras' size {camera.image_size(self.cameras)}, got {self.size}")
        if self.names and len(self.names) != len(self.images):
            raise ValueError(f"names: expected one a view, {len(self.images)}, got {len(self.names)}")
        if self.masks is not None and self.masks.shape != (len(self.images), 1, *self.images.shape[2:]):
            raise ValueError(
                f"masks: expected {(len(self.images), 1, *self.images.shape[2:])}, got {tuple(self.masks.shape)}"
            )

    def __len__(self) -> int:
        return len(self.images)

    @property
    def camera_directions(self) -> Float[Tensor, "view 3"]:
        """Unit vectors from the centre of the scene to the cameras, in single precision."""
        return camera.camera_directions(self.cameras, self.bounds.centre).float()

    def __repr__(self) -> str:
        height, width = self.size
        masks, names = "" if self.masks is None else ", masks", f", {self.names[0]} ..." if self.names else ""
        return f"Views({len(self)} of {width}x{height}{masks}{names})"

    def _repr_html_(self) -> str:
        """The images and the positions of their cameras, for notebooks."""
        return show_views(repr(self), self.images, self.cameras, self.bounds)

    def __getitem__(self, index: Selection) -> Views:
        chosen, names = as_selection(index, len(self), "views"), self.names
        if names:
            places = torch.arange(len(self))[chosen.cpu() if isinstance(chosen, Tensor) else chosen]
            names = tuple(names[place] for place in places.tolist())
        return self._derived(
            images=self.images[chosen],
            cameras=camera.select(self.cameras, chosen),
            masks=None if self.masks is None else self.masks[chosen],
            names=names,
        )

    @property
    def nbytes(self) -> int:
        """The bytes of images and masks."""
        return self.images.nbytes + (0 if self.masks is None else self.masks.nbytes)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of every image."""
        return self.images.shape[2], self.images.shape[3]

    @checked
    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Views:
        """The views and their cameras on another device or in another precision."""
        return self._derived(
            images=self.images.to(device=device, dtype=dtype),
            cameras=camera.to(self.cameras, device, dtype),
            masks=None if self.masks is None else self.masks.to(device=device, dtype=dtype),
        )

    @checked
    def resized(self, longest: int) -> Views:
        """The views scaled down so that the longer side has `longest` pixels; smaller views stay unchanged."""
        if longest < 1:
            raise ValueError(f"longest: expected at least 1 pixel, got {longest}")
        size = scaled_size(self.size, longest)
        if size == self.size:
            return self
        if not len(self):  # no cameras have no size, and `interpolate` refuses no images
            empty = (
                None if each is None else each.new_zeros(0, each.shape[1], *size) for each in (self.images, self.masks)
            )
            return self._derived(**dict(zip(("images", "masks"), empty, strict=True)))
        images, masks = (
            None if each is None else interpolate(each, size, mode="area") for each in (self.images, self.masks)
        )
        return self._derived(images=images, masks=masks, cameras=camera.resized(self.cameras, *size))

    def _derived(self, **changes: Any) -> Views:
        """The same views with some attributes replaced, without the checks of the constructor."""
        views = object.__new__(type(self))
        views.__dict__.update({**self.__dict__, **changes})
        return views

    @checked
    def rays(self, view: int, *, near_far: str = "sphere") -> Rays:
        """The rays through all pixels of one view, row by row."""
        pixels = pixel_grid(*self.size, device=self.images.device)
        index = torch.full((len(pixels),), view, dtype=torch.long, device=pixels.device)
        return cast(self.cameras, index, pixels, self.bounds, near_far=near_far)

    @checked
    def sample_rays(
        self,
        count: int,
        *,
        generator: torch.Generator | None = None,
        among: Int[Tensor, " pixel"] | None = None,
        near_far: str = "sphere",
    ) -> tuple[Rays, Float[Tensor, "ray 3"]]:
        """Rays through pixels drawn uniformly from all views, and the colours of these pixels.

        Args:
            count: the number of rays, drawn with replacement.
            generator: a generator on the CPU, so that every device draws the same pixels.
            among: flat indices (view, row, column) of the pixels to draw from; by default all.
            near_far: as in `geometry.cast`.

        Returns:
            The rays and their true colours. Raises ValueError if there is no pixel to draw from.
        """
        return self.sample_masked_rays(count, generator=generator, among=among, near_far=near_far)[:2]

    def sample_masked_rays(
        self,
        count: int,
        *,
        generator: torch.Generator | None = None,
        among: Int[Tensor, " pixel"] | None = None,
        near_far: str = "sphere",
        subpixels: Sequence[tuple[float, float]] = ((0.0, 0.0),),
    ) -> tuple[Rays, Float[Tensor, "drawn 3"], Float[Tensor, "drawn 1"]]:
        """As `sample_rays`, also returning the opacity of the masks, which is 1 without masks.

        `subpixels` are offsets from the centre of a pixel, in pixels (column, row). The rays through the first offset
        of every pixel come first, then those through the second, and so on (`Rendered.pooled`). Each pixel has one
        colour and one opacity.

        Raises:
            ValueError: less than one ray, or no pixel to draw from.
        """
        if count < 1:
            raise ValueError(f"count: expected at least 1 ray, got {count!r}")
        height, width = self.size
        total = len(self) * height * width if among is None else len(among)
        if not total:
            raise ValueError(f"among: expected at least one pixel of {len(self)} views to draw rays from, got none")
        flat = torch.randint(total, (count,), generator=generator).to(self.images.device)
        flat = flat if among is None else among[flat]
        if among is not None and flat.device.type == "cpu":  # a GPU would have to synchronise
            check_indices(flat, len(self) * height * width, "among", f"pixels of {len(self)} views")
        return self._rays_through(flat, near_far, subpixels)

    @checked
    def rays_at(
        self,
        pixels: Int[Tensor, " pixel"],
        *,
        near_far: str = "sphere",
        subpixels: Sequence[tuple[float, float]] = ((0.0, 0.0),),
    ) -> tuple[Rays, Float[Tensor, "pixel 3"], Float[Tensor, "pixel 1"]]:
        """The rays through some pixels.

        Args:
            pixels: flat indices (view, row, column) of the pixels.
            near_far: as in `geometry.cast`.
            subpixels: as in `sample_masked_rays`.

        Returns:
            The rays, the colours of the pixels, and the opacity of the masks, which is 1 without masks. On a CPU an
            index out of range raises ValueError.
        """
        height, width = self.size
        if pixels.device.type == "cpu":  # a GPU would have to synchronise
            check_indices(pixels, len(self) * height * width, "pixels", f"pixels of {len(self)} views")
        return self._rays_through(pixels, near_far, subpixels)

    def _rays_through(
        self, pixels: Int[Tensor, " pixel"], near_far: str, subpixels: Sequence[tuple[float, float]]
    ) -> tuple[Rays, Float[Tensor, "pixel 3"], Float[Tensor, "pixel 1"]]:
        height, width = self.size
        view, pixel = pixels // (height * width), pixels % (height * width)
        row, column = pixel // width, pixel % width
        places = torch.stack([column, row], -1).to(self.cameras.extrinsics)  # the dtype of images may be too coarse
        places = torch.cat([places + places.new_tensor(each) for each in subpixels])
        rays = cast(self.cameras, view.repeat(len(subpixels)), places, self.bounds, near_far=near_far)
        colours = self.images[view, :, row, column]
        return (
            rays,
            colours,
            torch.ones_like(colours[:, :1]) if self.masks is None else self.masks[view, :, row, column],
        )


def join_views(first: Views, *others: Views) -> Views:
    """Several sets of views of a scene as one, with the bounds and the up direction of the first.

    The result has masks if all sets have masks, and names if all have names.
    """
    parts = (first, *others)
    masks = [each.masks for each in parts if each.masks is not None]
    names = tuple(name for each in parts for name in each.names) if all(each.names for each in parts) else ()
    return Views(
        torch.cat([each.images for each in parts]),
        camera.concatenate([each.cameras for each in parts]),
        torch.cat(masks) if len(masks) == len(parts) else None,
        first.bounds,
        names,
        first.up,
    )


def moved(views: Views, motion: Float[Tensor, "4 4"]) -> Views:
    """The views of an object after a rigid motion: the same images, with cameras that move with the object.

    Args:
        views: the views of the object.
        motion: the motion in world coordinates, (4, 4), in float64.
    """
    return views._derived(cameras=camera.moved(views.cameras, motion))


@dataclass(frozen=True)
class Task:
    """One object: the views that a method is given, and the views that it is evaluated on (HyperPlanes, Eq. 5).

    Attributes:
        support: the views that the method may use.
        query: other views of the same object.
        name: the name of the object.
    """

    support: Views
    query: Views
    name: str = ""

    def __repr__(self) -> str:
        return f"Task({self.name!r}, support={self.support!r}, query={self.query!r})"

    def _repr_html_(self) -> str:
        """The support and the query views, for notebooks."""
        return f"<p><b>{escape(self.name)}</b></p>{self.support._repr_html_()}{self.query._repr_html_()}"


@runtime_checkable
class Tasks(Protocol):
    """A data set of tasks."""

    def names(self, split: str) -> Sequence[str]:
        """The names of the objects of a split."""
        ...

    def task(self, name: str) -> Task:
        """The views of one object."""
        ...


@runtime_checkable
class Classified(Protocol):
    """Tasks whose objects have classes."""

    def class_of(self, name: str) -> str:
        """The class of one object; empty if it is not stated."""
        ...


def class_of(data: Tasks, name: str) -> str:
    """The class of an object; empty if the data set does not state it."""
    return data.class_of(name) if isinstance(data, Classified) else ""
