"""The OpenGL pass that draws surfaces inside a pyrender Renderer. Only pyrender_renderer imports it.

pyrender manages the context, the vertex buffers and the textures; the pass is our own, because pyrender's lights back
faces with ambient light only, squares the alpha of translucent surfaces, multiplies vertex colours after lighting, and
reads an unneeded depth buffer. Every sample is shaded (supersampling, not multisampling).
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_void_p
from typing import Any

import numpy as np
import numpy.typing as npt
from OpenGL import GL
from pyrender import Mesh, MetallicRoughnessMaterial, Node, Primitive, Renderer, RenderFlags, Sampler, Scene, Texture

from data_gen.meshes.materials import Wrap
from data_gen.rendering.lighting import Lighting
from data_gen.rendering.opengl.framebuffers import SampleFramebuffers
from data_gen.rendering.opengl.shader_program import (
    OPAQUE_TEXELS,
    TRANSLUCENT_TEXELS,
    ShaderProgram,
    constants_of_lighting,
    constants_of_surface,
)
from data_gen.rendering.surfaces import COINCIDENT, ShadedSurface

__all__ = ["Drawable", "SurfaceRenderer"]

Floats = npt.NDArray[np.float64]
_TextureKey = tuple[int, tuple[Wrap, Wrap]]
_WRAPS = {"repeat": GL.GL_REPEAT, "clamp": GL.GL_CLAMP_TO_EDGE, "mirror": GL.GL_MIRRORED_REPEAT}

# Sides of faces, by what OpenGL culls to draw them. Drawn with flipped rows, so that glReadPixels, which starts at the
# bottom, returns the first row on top; the flip reverses the winding of every triangle.
_OUTER, _INNER = GL.GL_FRONT, GL.GL_BACK
# COINCIDENT in steps of 24-bit depth; one step is 0.44 of it at distance 3. No offset for the slope of a face, which
# would push inner sides behind outer ones at silhouettes.
_OFFSET = 0.44 * COINCIDENT * 2**24
_FLIP_ROWS = np.diag([1.0, -1.0, 1.0, 1.0])


class Drawable:
    """A surface with the pyrender objects that hold its buffers and textures.

    Args:
        surface: what to draw.
        textures: pyrender textures made so far, by the identity of their texels and wrap modes, so that surfaces
            share them.

    Attributes:
        defines: preprocessor definitions for its program.
        constants: material constants that may be compiled in.
    """

    def __init__(self, surface: ShadedSurface, textures: dict[_TextureKey, Texture]) -> None:
        self.surface = surface
        self.base_texture = _texture(surface.texture, surface.wrap, textures)
        self.emissive_texture = _texture(surface.emissive_texture, surface.emissive_wrap, textures)
        # pyrender uploads the textures of a primitive's material; the rest of the material is unused.
        material = MetallicRoughnessMaterial(baseColorTexture=self.base_texture, emissiveTexture=self.emissive_texture)
        self.primitive = Primitive(
            positions=surface.positions,
            normals=surface.normals,
            texcoord_0=surface.uv,
            texcoord_1=surface.emissive_uv,
            color_0=surface.colours,
            indices=surface.faces,
            material=material,
        )
        self.defines: dict[str, int] = {}
        if surface.uv is not None:
            self.defines["UV"] = 2
        if surface.emissive_uv is not None:
            self.defines["EMISSIVE_UV"] = 2 + len(self.defines)
        if surface.colours is not None:
            self.defines["COLOUR"] = 2 + len(self.defines)
        needs = {
            "TEXTURE": self.base_texture is not None,
            "EMISSIVE_TEXTURE": self.emissive_texture is not None,
            "TRANSLUCENT": not surface.opaque or surface.cutoff is not None,
            "UNLIT": surface.unlit,
        }
        self.constants = constants_of_surface(surface)
        self.defines |= {name: 1 for name, needed in needs.items() if needed}
        self.centre = surface.positions[surface.faces].mean(axis=(0, 1))


class SurfaceRenderer(Renderer):
    """A pyrender Renderer that draws surfaces into RGBA with straight alpha.

    Its resources are freed with the OpenGL context, when the process ends.
    """

    def __init__(self, width: int, height: int) -> None:
        super().__init__(width, height)
        self._programs: dict[tuple[Any, ...], ShaderProgram] = {}
        self._buffers: SampleFramebuffers | None = None

    def load(self, surfaces: Sequence[ShadedSurface]) -> list[Drawable]:
        """Upload surfaces to the context, replacing the previous ones.

        Args:
            surfaces: the surfaces to draw from now on; an empty list clears the context.

        Returns:
            Drawables for `draw`, opaque ones first, ordered by program.
        """
        textures: dict[_TextureKey, Texture] = {}
        drawables = [Drawable(surface, textures) for surface in surfaces]
        scene = Scene()
        if drawables:
            scene.add_node(Node(mesh=Mesh([drawable.primitive for drawable in drawables])))
        self._update_context(scene, RenderFlags.NONE)
        return sorted(drawables, key=lambda each: (not each.surface.opaque, _program_key(each.defines, each.constants)))

    def draw(
        self,
        drawables: Sequence[Drawable],
        size: tuple[int, int, int],
        clip_from_world: Floats,
        camera: Floats,
        lighting: Lighting,
        light_directions: Floats,
    ) -> npt.NDArray[np.uint8]:
        """Draw one view.

        Args:
            drawables: as returned by `load`.
            size: pixels across, pixels down, and samples along a side of a pixel.
            clip_from_world: OpenGL's view and projection `(4, 4)`.
            camera: the camera's position `(3,)` in world axes.
            lighting: the lights.
            light_directions: unit vectors to the lights `(light, 3)` in world axes.

        Returns:
            sRGB with straight alpha `(height, width, 4)`, first row on top.
        """
        if self._buffers is None or self._buffers.size != size:
            if self._buffers is not None:
                self._buffers.delete()
            self._buffers = SampleFramebuffers(*size)
        buffers = self._buffers
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, buffers.drawn)
        GL.glViewport(0, 0, size[0] * size[2], size[1] * size[2])
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glDepthFunc(GL.GL_LESS)
        GL.glDepthMask(GL.GL_TRUE)
        GL.glPolygonMode(GL.GL_FRONT_AND_BACK, GL.GL_FILL)
        GL.glDisable(GL.GL_BLEND)
        GL.glEnable(GL.GL_CULL_FACE)
        GL.glClearColor(0.0, 0.0, 0.0, 0.0)
        GL.glClear(int(GL.GL_COLOR_BUFFER_BIT) | int(GL.GL_DEPTH_BUFFER_BIT))
        view = (_FLIP_ROWS @ clip_from_world, camera, lighting, light_directions)
        bound: ShaderProgram | None = None
        # Outer sides first, so that hidden samples are not shaded. Inner ones are drawn slightly farther away, so
        # that an outer side in the same place, whether of a face with the same corners or not, is the one seen.
        GL.glPolygonOffset(0.0, _OFFSET)
        for side in (_OUTER, _INNER):
            for drawable in drawables:
                bound = self._draw_side(drawable, bound, view, OPAQUE_TEXELS, side)
            GL.glEnable(GL.GL_POLYGON_OFFSET_FILL)
        GL.glDisable(GL.GL_POLYGON_OFFSET_FILL)
        # Inner sides of one-sided surfaces fill holes, behind everything else: no object reaches this far.
        GL.glDepthRange(1.0 - 2.0**-13, 1.0)
        for drawable in drawables:
            if drawable.surface.culled and drawable.surface.opaque:
                bound = self._draw_side(drawable, bound, view, OPAQUE_TEXELS, _INNER, culled=True)
        GL.glDepthRange(0.0, 1.0)
        translucent = [drawable for drawable in drawables if not drawable.surface.opaque]
        if translucent:
            # Surfaces from far to near by their centres, each with its inner sides before its outer ones, face by face:
            # correct for a solid and for panes facing one way; where others overlap, a farther one may be in front.
            translucent.sort(key=lambda drawable: -float(np.linalg.norm(drawable.centre - camera)))
            GL.glEnable(GL.GL_BLEND)
            GL.glBlendFunc(GL.GL_ONE, GL.GL_ONE_MINUS_SRC_ALPHA)
            GL.glDepthMask(GL.GL_FALSE)
            for drawable in translucent:
                for side in (_INNER, _OUTER):
                    bound = self._draw_side(drawable, bound, view, TRANSLUCENT_TEXELS, side)
            GL.glDepthMask(GL.GL_TRUE)
        picture = buffers.read()
        GL.glUseProgram(0)
        return picture

    def _bind(self, drawable: Drawable, bound: ShaderProgram | None, view: Any) -> ShaderProgram:
        defines = drawable.defines | {"LIGHTS": len(view[-1])}
        constants = drawable.constants | constants_of_lighting(view[2])
        key = _program_key(defines, constants)
        if key not in self._programs:
            self._programs[key] = ShaderProgram(defines, constants)
        program = self._programs[key]
        if program is not bound:
            GL.glUseProgram(program.handle)
            program.set_view(*view)
        return program

    def _draw_side(
        self,
        drawable: Drawable,
        bound: ShaderProgram | None,
        view: Any,
        layer: int,
        side: int,
        *,
        culled: bool = False,
    ) -> ShaderProgram | None:
        """Draw the faces seen from a side, or the culled ones, and return the program bound afterwards."""
        every = side == _OUTER or culled
        count = len(drawable.surface.faces) if every else drawable.surface.two_sided
        if count == 0:
            return bound
        program = self._bind(drawable, bound, view)
        GL.glCullFace(side)
        program.set_surface(drawable.surface, layer)
        for unit, texture in enumerate((drawable.base_texture, drawable.emissive_texture)):
            if texture is not None:
                GL.glActiveTexture(int(GL.GL_TEXTURE0) + unit)
                texture._bind()
        drawable.primitive._bind()
        faces = drawable.surface.faces[:count]
        if layer == TRANSLUCENT_TEXELS:
            centres = drawable.surface.positions[faces].mean(axis=1)
            _upload(faces[np.argsort(-np.linalg.norm(centres - view[1], axis=1), kind="stable")])
        GL.glDrawElements(GL.GL_TRIANGLES, 3 * count, GL.GL_UNSIGNED_INT, c_void_p(0))
        if layer == TRANSLUCENT_TEXELS:
            _upload(faces)
        drawable.primitive._unbind()
        return program


def _upload(faces: npt.NDArray[np.int64]) -> None:
    """Replace the first faces of the bound primitive."""
    indices = np.ascontiguousarray(faces, dtype=np.uint32)
    GL.glBufferSubData(GL.GL_ELEMENT_ARRAY_BUFFER, 0, indices.nbytes, indices)


def _program_key(defines: dict[str, int], constants: dict[str, str]) -> tuple[Any, ...]:
    return (*sorted(defines.items()), *sorted(constants.items()))


def _texture(
    texels: npt.NDArray[np.uint8] | None, wrap: tuple[Wrap, Wrap], textures: dict[_TextureKey, Texture]
) -> Texture | None:
    if texels is None:
        return None
    key = (id(texels), wrap)
    if key not in textures:
        sampler = Sampler(wrapS=_WRAPS[wrap[0]], wrapT=_WRAPS[wrap[1]])
        # Always four channels: OpenGL expects rows of a multiple of four bytes.
        textures[key] = Texture(source=texels, source_channels="RGBA", sampler=sampler)
    return textures[key]
