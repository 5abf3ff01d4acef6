"""The OpenGL pass that draws surfaces inside a pyrender Renderer. Imports pyrender: only pyrender_backend imports this.

pyrender keeps the context, the buffers, the textures and the frame buffers; the pass itself is our own, because
pyrender's lights back faces with ambient light only, squares the alpha of what is translucent, multiplies vertex
colours in after the light, and reads a depth buffer that nobody needs. It draws without multisampling: sixteen samples
a pixel take as long (14.8 ms at 128 pixels) as four multisamples at twice the size (15.6 ms), and each is shaded for
itself. Shading is the formula of `data_gen.shading`, with which the Embree backend shades too.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_void_p
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from OpenGL import GL
from OpenGL.GL import shaders
from pyrender import Mesh, MetallicRoughnessMaterial, Node, Primitive, Renderer, RenderFlags, Scene, Texture

from data_gen.lighting import MAX_LIGHTS, Lighting
from data_gen.shading import SHOULDER
from data_gen.surfaces import Surface

__all__ = ["Drawable", "SurfaceRenderer"]

_VERTEX = """
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
#ifdef UV
layout(location = UV) in vec2 uv;
out vec2 point_uv;
#endif
#ifdef COLOUR
layout(location = COLOUR) in vec4 colour;
out vec4 point_colour;
#endif
uniform mat4 clip_from_world;
out vec3 point;
out vec3 point_normal;

void main() {
    gl_Position = clip_from_world * vec4(position, 1.0);
    point = position;
    point_normal = normal;
#ifdef UV
    point_uv = uv;
#endif
#ifdef COLOUR
    point_colour = colour;
#endif
}
"""

_FRAGMENT = """
in vec3 point;
in vec3 point_normal;
#ifdef UV
in vec2 point_uv;
#endif
#ifdef COLOUR
in vec4 point_colour;
#endif
uniform vec3 camera;
uniform vec3 light_direction[MAX_LIGHTS];
uniform vec3 light_colour[MAX_LIGHTS];
uniform int light_count;
uniform vec3 sky;
uniform vec3 ground;
uniform vec4 base_colour;
uniform vec3 emissive;
uniform float metallic;
uniform float narrowness;
uniform float shadowing;
uniform float cutoff;
uniform int layer;
uniform sampler2D base_texture;
uniform sampler2D emissive_texture;
uniform int textured;
uniform int emissive_textured;
out vec4 pixel;

vec3 linear(vec3 c) {
    return mix(pow((c + 0.055) / 1.055, vec3(2.4)), c / 12.92, lessThanEqual(c, vec3(0.04045)));
}

vec3 encoded(vec3 c) {
    return mix(1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, c * 12.92, lessThanEqual(c, vec3(0.0031308)));
}

void main() {
    vec4 base = base_colour;
    vec3 glow = emissive;
#ifdef COLOUR
    base *= clamp(point_colour, 0.0, 1.0);
#endif
#ifdef UV
    if (textured != 0) {
        vec4 texel = texture(base_texture, point_uv);
        base *= vec4(linear(min(texel.rgb / max(texel.a, 1e-4), 1.0)), texel.a);
    }
    if (emissive_textured != 0) glow *= linear(texture(emissive_texture, point_uv).rgb);
#endif
    float alpha = 1.0;
#ifdef CLEAR
    alpha = base.a;
    if (cutoff >= 0.0) alpha = alpha < cutoff ? 0.0 : 1.0;
    if ((layer == CLEAR_TEXELS) == (alpha >= 0.999) || alpha < 0.001) discard;
#endif

    vec3 towards = normalize(camera - point);
    vec3 facet = cross(dFdx(point), dFdy(point));
    facet = dot(facet, towards) < 0.0 ? -facet : facet;
    vec3 n = dot(point_normal, point_normal) > 1e-8 ? point_normal : facet;
    n = normalize(dot(n, facet) < 0.0 ? -n : n);
    float nv = max(dot(n, towards), 0.05);

    vec3 diffuse = base.rgb * (1.0 - 0.5 * metallic);
    vec3 f0 = mix(vec3(0.04), base.rgb, metallic);
    vec3 light = diffuse * mix(ground, sky, 0.5 + 0.5 * n.y);
    for (int i = 0; i < light_count; i++) {
        float nl = dot(n, light_direction[i]);
        if (nl <= 0.0) continue;
        vec3 h = normalize(light_direction[i] + towards);
        float nh = max(dot(n, h), 0.0);
        float d = nh * nh * (narrowness - 1.0) + 1.0;
        float grazing = 1.0 - max(dot(towards, h), 0.0);
        float grazing2 = grazing * grazing;
        vec3 fresnel = f0 + (1.0 - f0) * (grazing2 * grazing2 * grazing);
        float shadow = (nl * (1.0 - shadowing) + shadowing) * (nv * (1.0 - shadowing) + shadowing);
        float highlight = narrowness / (4.0 * d * d * shadow);
        light += nl * light_colour[i] * (diffuse + fresnel * highlight);
    }
    vec3 shoulder = SHOULDER + (1.0 - SHOULDER) * (1.0 - exp((SHOULDER - light) / (1.0 - SHOULDER)));
    light = mix(light, shoulder, greaterThan(light, vec3(SHOULDER)));
    pixel = vec4(encoded(clamp(light + glow, 0.0, 1.0)) * alpha, alpha);
}
"""


_SOLID_TEXELS, _CLEAR_TEXELS = 0, 1

Floats = npt.NDArray[np.float64]


class Drawable:
    """A surface with the pyrender objects that hold its buffers and textures.

    Args:
        surface: What to draw.
        textures: pyrender textures made so far, by the identity of their texels, so that surfaces share them.
    """

    def __init__(self, surface: Surface, textures: dict[int, Texture]) -> None:
        self.surface = surface
        self.base_texture = _texture(surface.texture, textures)
        self.emissive_texture = _texture(surface.emissive_texture, textures)
        # pyrender uploads the textures of a primitive's material; nothing else of the material is used.
        material = MetallicRoughnessMaterial(baseColorTexture=self.base_texture, emissiveTexture=self.emissive_texture)
        self.primitive = Primitive(
            positions=surface.positions,
            normals=surface.normals,
            texcoord_0=surface.uv,
            color_0=surface.colours,
            indices=surface.faces,
            material=material,
        )
        self.defines: dict[str, int] = {}
        if surface.uv is not None:
            self.defines["UV"] = 2
        if surface.colours is not None:
            self.defines["COLOUR"] = 2 + len(self.defines)
        if not surface.opaque or surface.cutoff is not None:
            self.defines["CLEAR"] = 1
        self.centre = surface.positions[surface.faces].mean(axis=(0, 1))


class SurfaceRenderer(Renderer):
    """A pyrender Renderer that draws surfaces into premultiplied RGBA."""

    def load(self, surfaces: Sequence[Surface]) -> list[Drawable]:
        """Put surfaces into the context, in place of those that were there.

        Args:
            surfaces: What to draw from now on; none empties the context.

        Returns:
            What `draw` takes: what is solid first, by the program that draws it.
        """
        textures: dict[int, Texture] = {}
        drawables = [Drawable(surface, textures) for surface in surfaces]
        scene = Scene()
        if drawables:
            scene.add_node(Node(mesh=Mesh([drawable.primitive for drawable in drawables])))
        self._update_context(scene, RenderFlags.NONE)
        return sorted(drawables, key=lambda drawable: (not drawable.surface.opaque, sorted(drawable.defines.items())))

    def draw(
        self, drawables: Sequence[Drawable], clip_from_world: Floats, camera: Floats, lighting: Lighting, lamps: Floats
    ) -> npt.NDArray[np.uint8]:
        """Draw one view at the size of the viewport.

        Args:
            drawables: What `load` returned.
            clip_from_world: OpenGL's view and projection ``(4, 4)``.
            camera: The camera's position ``(3,)`` in world axes.
            lighting: The lights.
            lamps: Unit vectors to the lights ``(light, 3)`` in world axes.

        Returns:
            Premultiplied sRGB with alpha ``(height, width, 4)``, first row on top.
        """
        self._configure_main_framebuffer()
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._main_fb)
        GL.glViewport(0, 0, self.viewport_width, self.viewport_height)
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glDepthFunc(GL.GL_LESS)
        GL.glDepthMask(GL.GL_TRUE)
        GL.glPolygonMode(GL.GL_FRONT_AND_BACK, GL.GL_FILL)
        GL.glDisable(GL.GL_BLEND)
        GL.glEnable(GL.GL_CULL_FACE)
        GL.glClearColor(0.0, 0.0, 0.0, 0.0)
        GL.glClear(int(GL.GL_COLOR_BUFFER_BIT) | int(GL.GL_DEPTH_BUFFER_BIT))
        # Upside down, so that the rows that OpenGL reads from the bottom come out with the first on top;
        # which turns every triangle around.
        far_side, near_side = GL.GL_FRONT, GL.GL_BACK
        view = (np.diag([1.0, -1.0, 1.0, 1.0]) @ clip_from_world, camera, lighting, lamps)
        bound: _Program | None = None
        # Both sides are drawn. Near sides first: what they hide is not shaded, which saves up to half of the time.
        for hidden_side in (far_side, near_side):
            GL.glCullFace(hidden_side)
            for drawable in drawables:
                bound = self._bind(drawable, bound, view)
                self._draw_triangles(drawable, bound, _SOLID_TEXELS)
        clear = [drawable for drawable in drawables if not drawable.surface.opaque]
        if clear:
            clear.sort(key=lambda drawable: -float(np.linalg.norm(drawable.centre - camera)))
            GL.glEnable(GL.GL_BLEND)
            GL.glBlendFunc(GL.GL_ONE, GL.GL_ONE_MINUS_SRC_ALPHA)
            GL.glDepthMask(GL.GL_FALSE)
            for drawable in clear:
                bound = self._bind(drawable, bound, view)
                for hidden_side in (near_side, far_side):
                    GL.glCullFace(hidden_side)
                    self._draw_triangles(drawable, bound, _CLEAR_TEXELS)
            GL.glDepthMask(GL.GL_TRUE)
        GL.glUseProgram(0)
        return self._read()

    def delete(self) -> None:
        """Free everything that OpenGL holds for this renderer."""
        for program in self.__dict__.pop("_surface_programs", {}).values():
            program.delete()
        super().delete()

    def _configure_main_framebuffer(self) -> None:
        """Make the frame buffer anew when the viewport has changed: one sample a pixel, no multisampling."""
        size = (self.viewport_width, self.viewport_height)
        if self._main_fb is not None and self._main_fb_dims == size:
            return
        self._delete_main_framebuffer()
        self._main_fb = GL.glGenFramebuffers(1)
        self._main_cb, self._main_db = GL.glGenRenderbuffers(2)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._main_fb)
        for buffer, kind, attachment in (
            (self._main_cb, GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0),
            (self._main_db, GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT),
        ):
            GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
            GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, kind, *size)
            GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, buffer)
        self._main_fb_dims = size

    def _delete_main_framebuffer(self) -> None:
        if self._main_fb is not None:
            GL.glDeleteFramebuffers(1, [self._main_fb])
            GL.glDeleteRenderbuffers(2, [self._main_cb, self._main_db])
        self._main_fb = self._main_cb = self._main_db = None
        self._main_fb_dims = (None, None)

    def _bind(self, drawable: Drawable, bound: _Program | None, view: Any) -> _Program:
        programs: dict[tuple[Any, ...], _Program] = self.__dict__.setdefault("_surface_programs", {})
        key = tuple(sorted(drawable.defines.items()))
        if key not in programs:
            programs[key] = _Program(drawable.defines)
        program = programs[key]
        if program is not bound:
            GL.glUseProgram(program.handle)
            program.set_view(*view)
        return program

    def _draw_triangles(self, drawable: Drawable, program: _Program, layer: int) -> None:
        surface = drawable.surface
        program.set_material(drawable, layer)
        for unit, texture in enumerate((drawable.base_texture, drawable.emissive_texture)):
            if texture is not None:
                GL.glActiveTexture(int(GL.GL_TEXTURE0) + unit)
                texture._bind()
        drawable.primitive._bind()
        GL.glDrawElements(GL.GL_TRIANGLES, surface.faces.size, GL.GL_UNSIGNED_INT, c_void_p(0))
        drawable.primitive._unbind()

    def _read(self) -> npt.NDArray[np.uint8]:
        width, height = self.viewport_width, self.viewport_height
        pixels = GL.glReadPixels(0, 0, width, height, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE)
        return np.frombuffer(cast(bytes, pixels), dtype=np.uint8).reshape(height, width, 4)


class _Program:
    """The shaders compiled for one layout of vertices, and where their uniforms are."""

    def __init__(self, defines: dict[str, int]) -> None:
        constants = {
            **defines,
            "MAX_LIGHTS": MAX_LIGHTS,
            "SHOULDER": SHOULDER,
            "CLEAR_TEXELS": _CLEAR_TEXELS,
        }
        head = "#version 330 core\n" + "".join(f"#define {name} {value}\n" for name, value in constants.items())
        # Some drivers refuse to validate a program while no vertex array is bound.
        array = GL.glGenVertexArrays(1)
        GL.glBindVertexArray(array)
        self.handle = shaders.compileProgram(
            shaders.compileShader(head + _VERTEX, GL.GL_VERTEX_SHADER),
            shaders.compileShader(head + _FRAGMENT, GL.GL_FRAGMENT_SHADER),
        )
        GL.glBindVertexArray(0)
        GL.glDeleteVertexArrays(1, [array])
        self._places: dict[str, int] = {}
        GL.glUseProgram(self.handle)
        if "UV" in defines:
            GL.glUniform1i(self._at("base_texture"), 0)
            GL.glUniform1i(self._at("emissive_texture"), 1)

    def _at(self, name: str) -> int:
        if name not in self._places:
            self._places[name] = GL.glGetUniformLocation(self.handle, name)
        return self._places[name]

    def set_view(self, clip_from_world: Floats, camera: Floats, lighting: Lighting, lamps: Floats) -> None:
        GL.glUniformMatrix4fv(self._at("clip_from_world"), 1, GL.GL_TRUE, clip_from_world.astype(np.float32))
        GL.glUniform3fv(self._at("camera"), 1, camera.astype(np.float32))
        GL.glUniform1i(self._at("light_count"), len(lamps))
        if len(lamps):
            GL.glUniform3fv(self._at("light_direction"), len(lamps), lamps.astype(np.float32))
            GL.glUniform3fv(self._at("light_colour"), len(lamps), lighting.colours.astype(np.float32))
        GL.glUniform3f(self._at("sky"), *lighting.sky)
        GL.glUniform3f(self._at("ground"), *lighting.ground)

    def set_material(self, drawable: Drawable, layer: int) -> None:
        surface = drawable.surface
        GL.glUniform4f(self._at("base_colour"), *surface.base_colour)
        GL.glUniform3f(self._at("emissive"), *surface.emissive)
        GL.glUniform1f(self._at("narrowness"), surface.roughness**4)
        GL.glUniform1f(self._at("shadowing"), (surface.roughness + 1.0) ** 2 / 8.0)
        GL.glUniform1f(self._at("metallic"), surface.metallic)
        if "CLEAR" in drawable.defines:
            GL.glUniform1f(self._at("cutoff"), -1.0 if surface.cutoff is None else surface.cutoff)
            GL.glUniform1i(self._at("layer"), layer)
        if "UV" in drawable.defines:
            GL.glUniform1i(self._at("textured"), int(drawable.base_texture is not None))
            GL.glUniform1i(self._at("emissive_textured"), int(drawable.emissive_texture is not None))

    def delete(self) -> None:
        GL.glDeleteProgram(self.handle)


def _texture(texels: npt.NDArray[np.uint8] | None, textures: dict[int, Texture]) -> Texture | None:
    if texels is None:
        return None
    # Always four channels: OpenGL expects rows of a multiple of four bytes.
    return textures.setdefault(id(texels), Texture(source=texels, source_channels="RGBA"))
