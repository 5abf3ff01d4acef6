"""Sampling alone: colours of images at given coordinates, for whoever projects by other means than the lookup."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry import lookup_torch
from hyperplanes.geometry.lookup import choose
from hyperplanes.geometry.packed_images import PackedImages

__all__ = ["sample"]


def sample(
    images: Float[Tensor, "view channel height width"],
    coordinates: Float[Tensor, "point view 2"],
    *,
    background: float = 1.0,
    packed: PackedImages | None = None,
    backend: str | None = None,
) -> Float[Tensor, "point view channel"]:
    """Bilinear colours of every image at its own coordinates, as the lookup interpolates them.

    Coordinates are those of `Lookup.coordinates`, Kornia's `normalize_pixel_coordinates` and `grid_sample` with
    `align_corners=True`: (column, row), -1 in the first pixel's centre, 1 in the last one's; along an axis of one pixel
    all are that pixel. Beyond them, and where one is not a number, there is the background, with no gradient; unlike in
    `grid_sample` nothing is blended with it. Differentiable in images and coordinates; with the torch backend twice.

    Args:
        images: any number of channels, none included.
        coordinates: of any strides; fastest where a view's coordinates lie together in memory, in pairs, as the
            transpose of (view, point, 2), or columns first, as the lookup returns them. All computations happen in
            their dtype, float32 or float64 for the fast backend.
        background: colour outside.
        packed: the same images in 32 bits a pixel, which the CPU backend reads instead for float32 coordinates when no
            gradient with respect to the images is wanted.
        backend: "torch" or "cpu"; the fastest that takes these tensors where absent.

    Returns:
        Colours, planar in memory: (view, channel, point).

    Raises:
        ValueError: coordinates of another shape or of another number of images, or a backend that does not take them.

    >>> import torch
    >>> ramp = torch.arange(4.0).expand(1, 1, 4, 4)
    >>> sample(ramp, torch.tensor([[[0.0, 0.0]], [[1.0, -1.0]], [[1.1, 0.0]]]), background=9.0).flatten().tolist()
    [1.5, 3.0, 9.0]
    """
    if images.ndim != 4:
        raise ValueError(f"images: expected shape (view, channel, height, width), got {tuple(images.shape)}")
    if coordinates.ndim != 3 or coordinates.shape[1:] != (len(images), 2):
        expected = f"(point, {len(images)}, 2), {len(images)} being the number of images"
        raise ValueError(f"coordinates: expected shape {expected}, got {tuple(coordinates.shape)}")
    images = images.to(coordinates)
    fastest = choose(coordinates, images)
    name = backend or ("cpu" if fastest == "cpu" else "torch")
    if name == "torch":
        return lookup_torch.sample(images, coordinates, background)
    if name != "cpu" or fastest != "cpu":
        taken = f"{str(coordinates.dtype).removeprefix('torch.')} on {coordinates.device}"
        raise ValueError(
            f"backend: expected {'torch' if fastest != 'cpu' else 'torch or cpu'} for {taken}, got {name!r}"
        )
    from hyperplanes.geometry.kernels import sample_operator

    fits = packed is not None and coordinates.element_size() == 4 and not images.requires_grad
    words, bits = (packed.words, packed.bits) if packed is not None and fits else (None, 0)
    return sample_operator.sample(images, coordinates, words, bits, background)
