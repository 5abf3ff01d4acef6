"""Rendering by ray casting with Embree: the fallback without OpenGL, and the source of exact geometry.

Colours follow `shading`, the formula of the OpenGL shader, at the same sample positions. So the two renderers differ by
rounding, by mipmap selection, and in the order of translucent faces where OpenGL's, by their centres, is not that along
the ray. Geometry (depth, normals, coordinates) is always ray-cast, whatever renders the colours: at exact pixel centres
and in double precision, while a depth buffer has 24 unevenly spread bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from data_gen.meshes.materials import Wrap
from data_gen.rendering.lighting import Lighting
from data_gen.rendering.ray_tracing.ray_casting import Hits, RayCaster, pixel_rays
from data_gen.rendering.shading import facing, shade
from data_gen.rendering.surfaces import COINCIDENT, ShadedSurface
from data_gen.rendering.textures import MipmappedTexture
from data_gen.rigs import Rig
from hyperplanes.utilities.images.colour import linear_from_srgb, srgb_from_linear

__all__ = ["EmbreeRenderer", "Geometry", "cast_geometry"]

Floats = npt.NDArray[np.float64]

_MAX_LAYERS = 256  # far more than foliage has; nearly all rays end sooner, and then cost nothing


@dataclass(frozen=True)
class Geometry:
    """The first surface at each pixel centre that is at least half opaque; zero where there is none.

    Attributes:
        depth: distance along the camera's z axis, float32 `(height, width)`.
        normals: unit normals towards the camera, world axes, float32 `(height, width, 3)`.
        coordinates: points on the surface, world units, float32 `(height, width, 3)`.
    """

    depth: npt.NDArray[np.float32]
    normals: npt.NDArray[np.float32]
    coordinates: npt.NDArray[np.float32]


class EmbreeRenderer:
    """Renders by casting rays at a regular grid of samples in each pixel."""

    def __init__(self) -> None:
        import embreex

        self.detail = f"Embree ray casting, embreex {getattr(embreex, '__version__', 'of unknown version')}"

    def draw(
        self, surfaces: Sequence[ShadedSurface], rig: Rig, lighting: Lighting, supersample: int
    ) -> Iterator[npt.NDArray[np.uint8]]:
        """Render all views, as described in `mesh_renderer.ViewRenderer`."""
        scene = _Scene(surfaces)
        for pose, intrinsics in zip(rig.world_from_camera, rig.intrinsics, strict=True):
            picture = np.zeros((rig.height, rig.width, 4), dtype=np.float32)
            left, top, right, bottom = scene.extent(pose, intrinsics, rig)
            if left < right and top < bottom:
                offsets = (np.arange(supersample) + 0.5) / supersample - 0.5
                columns = (np.arange(left, right)[:, None] + offsets).ravel()
                rows = (np.arange(top, bottom)[:, None] + offsets).ravel()
                samples = scene.trace(pose, intrinsics, columns, rows, lighting, supersample)
                blocks = samples.reshape(bottom - top, supersample, right - left, supersample, 4)
                picture[top:bottom, left:right] = 255.0 * blocks.mean(axis=(1, 3))
            yield _unpremultiplied(picture)


def cast_geometry(surfaces: Sequence[ShadedSurface], rig: Rig) -> Iterator[Geometry]:
    """Depth, normals and coordinates at the centres of the pixels.

    Yields:
        The geometry of one view after the other.
    """
    scene = _Scene(surfaces)
    for pose, intrinsics in zip(rig.world_from_camera, rig.intrinsics, strict=True):
        rays = pixel_rays(pose, intrinsics, np.arange(0.0, rig.width), np.arange(0.0, rig.height))
        depth, normals, coordinates = np.zeros(len(rays)), np.zeros((len(rays), 3)), np.zeros((len(rays), 3))
        active, after = np.arange(len(rays)), None
        for _ in range(_MAX_LAYERS):
            hits = scene.ray_caster.cast(pose[:3, 3], rays[active], after)
            solid = scene.base(hits, None)[:, 3] >= 0.5
            seen = active[hits.rays[solid]]
            depth[seen] = hits.distances[solid]
            coordinates[seen] = hits.points[solid]
            normals[seen] = scene.normals(hits, -rays[active[hits.rays]])[solid]
            active, after = active[hits.rays[~solid]], hits.distances[~solid] + COINCIDENT
            if len(active) == 0:
                break
        shape = (rig.height, rig.width)
        yield Geometry(
            depth.reshape(shape).astype(np.float32),
            normals.reshape(*shape, 3).astype(np.float32),
            coordinates.reshape(*shape, 3).astype(np.float32),
        )


class _Scene:
    """Surfaces, ray caster and textures, to compute the colours of hits."""

    def __init__(self, surfaces: Sequence[ShadedSurface]) -> None:
        self.surfaces = surfaces
        self.ray_caster = RayCaster(surfaces)
        self._textures: dict[tuple[int, tuple[Wrap, Wrap]], MipmappedTexture] = {}
        self._vertices = np.concatenate([surface.positions for surface in surfaces])
        self._roughness = np.array([[surface.roughness] for surface in surfaces])
        self._metallic = np.array([[surface.metallic] for surface in surfaces])
        self._unlit = np.array([surface.unlit for surface in surfaces])
        self._emits = any(surface.emissive.any() for surface in surfaces)

    def extent(self, pose: Floats, intrinsics: Floats, rig: Rig) -> tuple[int, int, int, int]:
        """Columns and rows (left, top, right, bottom) outside which no vertex is seen, ends excluded."""
        points = (self._vertices - pose[:3, 3]) @ pose[:3, :3] @ intrinsics.T
        if points[:, 2].min() <= 1e-6:
            return 0, 0, rig.width, rig.height
        pixels = points[:, :2] / points[:, 2:]
        size = np.array([rig.width, rig.height])
        first = np.clip(np.floor(pixels.min(axis=0)), 0, size).astype(int)
        last = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int)
        return first[0], first[1], last[0], last[1]

    def trace(
        self, pose: Floats, intrinsics: Floats, columns: Floats, rows: Floats, lighting: Lighting, supersample: int
    ) -> Floats:
        """Premultiplied colours (sample, 4) in [0, 1], composited front to back along each sample's ray."""
        rays = pixel_rays(pose, intrinsics, columns, rows)
        steps = (pose[:3, :3] @ np.linalg.inv(intrinsics))[:, :2].T / supersample
        directions = lighting.directions(pose)
        colours, transmittance = np.zeros((len(rays), 4)), np.ones(len(rays))
        active, after = np.arange(len(rays)), None
        for _ in range(_MAX_LAYERS):
            hits = self.ray_caster.cast(pose[:3, 3], rays[active], after)
            seen = active[hits.rays]
            base = self.base(hits, (rays[seen], steps))
            view_directions = -rays[seen] / np.linalg.norm(rays[seen], axis=1, keepdims=True)
            owner = self.ray_caster.owner[hits.faces]
            shaded = shade(
                base[:, :3],
                self._emission(hits, (rays[seen], steps)),
                self.normals(hits, view_directions),
                view_directions,
                self._roughness[owner],
                self._metallic[owner],
                lighting,
                directions,
            )
            unlit = np.flatnonzero(self._unlit[owner])
            shaded[unlit] = srgb_from_linear(np.clip(base[unlit, :3], 0.0, 1.0))
            alpha = base[:, 3:]
            colours[seen] += transmittance[seen, None] * alpha * np.concatenate((shaded, np.ones_like(alpha)), axis=1)
            transmittance[seen] *= 1.0 - alpha[:, 0]
            through = transmittance[seen] > 0.002
            active, after = seen[through], hits.distances[through] + COINCIDENT
            if len(active) == 0:
                break
        return colours

    def normals(self, hits: Hits, view_directions: Floats) -> Floats:
        """The shading normals (hit, 3)."""
        normals = np.empty((len(hits.rays), 3))
        for surface, number, selected in self._by_surface(hits):
            normals[selected] = _interpolate(surface.normals[surface.faces[number]], hits.corners[selected])
        return facing(normals, self.ray_caster.facets[hits.faces], view_directions)

    def base(self, hits: Hits, spread: tuple[Floats, Floats] | None) -> Floats:
        """Linear base colours (hit, 4), alpha after the cutoff; textures at full size if no spread is given."""
        colours = np.ones((len(hits.rays), 4))
        for surface, number, selected in self._by_surface(hits):
            colour = np.broadcast_to(surface.base_colour, (len(selected), 4)).copy()
            if surface.colours is not None:
                colour *= _interpolate(surface.colours[surface.faces[number]], hits.corners[selected])
            if surface.texture is not None:
                texture = self._texture(surface.texture, surface.wrap)
                assert surface.uv is not None
                texel = self._texel(texture, surface.uv[surface.faces[number]], hits, selected, spread)
                colour[:, :3] *= linear_from_srgb(np.minimum(texel[:, :3] / np.maximum(texel[:, 3:], 1e-4), 1.0))
                colour[:, 3] *= texel[:, 3]
            if surface.cutoff is not None:
                colour[:, 3] = colour[:, 3] >= surface.cutoff
            elif surface.opaque:
                colour[:, 3] = 1.0
            colours[selected] = colour
        return colours

    def _emission(self, hits: Hits, spread: tuple[Floats, Floats]) -> Floats:
        """Linear emitted light (hit, 3)."""
        light = np.zeros((len(hits.rays), 3))
        if self._emits:
            for surface, number, selected in self._by_surface(hits):
                light[selected] = surface.emissive
                if surface.emissive_texture is not None:
                    texture = self._texture(surface.emissive_texture, surface.emissive_wrap)
                    uv = surface.uv if surface.emissive_uv is None else surface.emissive_uv
                    assert uv is not None
                    texel = self._texel(texture, uv[surface.faces[number]], hits, selected, spread)
                    light[selected] *= linear_from_srgb(texel[:, :3])
        return light

    def _by_surface(self, hits: Hits) -> Iterator[tuple[ShadedSurface, npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
        """Each surface that is hit, with the faces and the indices of its hits."""
        owner = self.ray_caster.owner[hits.faces]
        for index in np.unique(owner):
            selected = np.flatnonzero(owner == index)
            yield self.surfaces[index], hits.faces[selected] - self.ray_caster.first_face[index], selected

    def _texel(
        self,
        texture: MipmappedTexture,
        corners: Floats,
        hits: Hits,
        selected: npt.NDArray[np.int64],
        spread: tuple[Floats, Floats] | None,
    ) -> Floats:
        """RGBA (hit, 4) of the selected hits, whose faces have texture coordinates (hit, 3, 2) at their corners."""
        level = np.zeros(len(selected))
        if spread is not None:
            rays, steps = spread
            faces = hits.faces[selected]
            facets, edges = self.ray_caster.facets[faces], corners[:, 1:] - corners[:, :1]
            gradients = np.einsum("hcx,hci->hxi", edges, self.ray_caster.gradients[faces])
            gradients *= np.array([[texture.width], [texture.height]])
            lengths = []
            for step in steps:
                slide = (facets @ step) / np.einsum("hi,hi->h", facets, rays[selected])
                moved = hits.distances[selected, None] * (step - slide[:, None] * rays[selected])
                lengths.append(np.linalg.norm(np.einsum("hxi,hi->hx", gradients, moved), axis=1))
            level = np.log2(np.maximum(np.maximum(*lengths), 1e-12))
        return texture.sample(_interpolate(corners, hits.corners[selected]), level).astype(np.float64)

    def _texture(self, texels: npt.NDArray[np.uint8], wrap: tuple[Wrap, Wrap]) -> MipmappedTexture:
        key = (id(texels), wrap)
        if key not in self._textures:
            self._textures[key] = MipmappedTexture(texels, wrap)
        return self._textures[key]


def _unpremultiplied(picture: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Premultiplied RGBA to straight uint8, both from 0 to 255."""
    alpha = picture[..., 3:]
    colour = np.divide(picture[..., :3] * 255.0, alpha, out=np.zeros_like(picture[..., :3]), where=alpha > 0)
    return np.clip(np.rint(np.concatenate((colour, alpha), axis=-1)), 0, 255).astype(np.uint8)


def _interpolate(values: Floats, weights: Floats) -> Floats:
    """Values (hit, 3, value) at the corners of faces, interpolated by barycentric weights (hit, 3): (hit, value)."""
    return np.einsum("hc,hcx->hx", weights, values)
