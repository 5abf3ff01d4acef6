"""The OpenGL programs that shade surfaces, compiled for the features of a surface. Imports OpenGL.

Shading is the formula of `data_gen.rendering.shading`, as in `embree`, arranged for speed: software OpenGL spends half
of its time here. Half vectors are never normalised (`|L + V|^2 = 2 + 2 L.V`), the sRGB curves are polynomials (their
error of 0.05 of 255 is below that of 8 bits), lights are unrolled, unused features are not compiled in, and values that
are the same for nearly all surfaces are constants: llvmpipe reloads a uniform every few pixels (2.2 ms a picture of a
car with constants, 3.1 with uniforms).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from OpenGL import GL
from OpenGL.GL import shaders

from data_gen.rendering.lighting import MAX_LIGHTS, Lighting
from data_gen.rendering.shading import SHOULDER
from data_gen.rendering.surfaces import DEFAULT_ROUGHNESS, ShadedSurface

__all__ = [
    "OPAQUE_TEXELS",
    "TRANSLUCENT_TEXELS",
    "ShaderProgram",
    "compile_program",
    "constants_of_lighting",
    "constants_of_surface",
]

OPAQUE_TEXELS, TRANSLUCENT_TEXELS = 0, 1
"""Which texels of a translucent surface are drawn: the opaque ones, or the others."""

Floats = npt.NDArray[np.float64]

_VERTEX = """
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
#ifdef UV
layout(location = UV) in vec2 uv;
out vec2 point_uv;
#endif
#ifdef EMISSIVE_UV
layout(location = EMISSIVE_UV) in vec2 emissive_uv;
out vec2 point_emissive_uv;
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
#ifdef EMISSIVE_UV
    point_emissive_uv = emissive_uv;
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
#ifdef EMISSIVE_UV
in vec2 point_emissive_uv;
#endif
#ifdef COLOUR
in vec4 point_colour;
#endif
uniform vec3 camera;
uniform float cutoff;
uniform int layer;
uniform sampler2D base_texture;
uniform sampler2D emissive_texture;
out vec4 pixel;

vec3 linear(vec3 c) {
    vec3 curve = 0.00104633 + c * (0.02840388 + c * (0.56036574 + c * (0.52653887 - c * 0.11681571)));
    return mix(curve, c * (1.0 / 12.92), lessThanEqual(c, vec3(0.04045)));
}

vec3 encoded(vec3 c) {
    vec3 root = sqrt(sqrt(c));
    vec3 curve = -0.07175889 + root * (0.25578366 + root * (0.95259771 - root * 0.13683765));
    return mix(curve, c * 12.92, lessThanEqual(c, vec3(0.0031308)));
}

void main() {
    vec4 base = base_colour;
#ifdef COLOUR
    base *= clamp(point_colour, 0.0, 1.0);
#endif
#ifdef TEXTURE
    vec4 texel = texture(base_texture, point_uv);
#ifdef TRANSLUCENT
    texel.rgb = min(texel.rgb / max(texel.a, 1e-4), 1.0);
#endif
    base *= vec4(linear(texel.rgb), texel.a);
#endif
    vec3 emission = emissive;
#ifdef EMISSIVE_TEXTURE
#ifdef EMISSIVE_UV
    emission *= linear(texture(emissive_texture, point_emissive_uv).rgb);
#else
    emission *= linear(texture(emissive_texture, point_uv).rgb);
#endif
#endif
#ifdef TRANSLUCENT
    float alpha = base.a;
    if (cutoff >= 0.0) alpha = alpha < cutoff ? 0.0 : 1.0;
    if ((layer == TRANSLUCENT_TEXELS) == (alpha >= 0.999) || alpha < 0.001) discard;
#endif

#ifdef UNLIT
    pixel = vec4(encoded(clamp(base.rgb, 0.0, 1.0)), 1.0);
#else
    vec3 towards = camera - point;
    towards *= inversesqrt(dot(towards, towards));
    vec3 facet = cross(dFdx(point), dFdy(point));
    facet = dot(facet, towards) < 0.0 ? -facet : facet;
    vec3 n = dot(point_normal, point_normal) > 1e-8 ? point_normal : facet;
    n = dot(n, facet) < 0.0 ? -n : n;
    n *= inversesqrt(dot(n, n));
    float facing = dot(n, towards);
    float masking = max(facing, 0.05) * (1.0 - shadowing) + shadowing;

    vec3 diffuse = mix(ground, sky, 0.5 + 0.5 * n.y);
    vec3 specular = vec3(0.0);
    vec3 grazing = vec3(0.0);
    for (int i = 0; i < LIGHTS; i++) {
        float nl = max(dot(n, light_direction[i]), 0.0);
        float m = max(1.0 + dot(towards, light_direction[i]), 1e-5);
        float t = max(nl + facing, 0.0);
        float d = t * t * (squared_alpha - 1.0) + 2.0 * m;
        float slope = 1.0 - sqrt(0.5 * m);
        float slope2 = slope * slope;
        float fresnel = slope2 * slope2 * slope;
        vec3 lit = nl * light_colour[i];
        vec3 high = lit * (squared_alpha * m * m / (d * d * masking * (nl * (1.0 - shadowing) + shadowing)));
        diffuse += lit;
        grazing += high * fresnel;
        specular += high * (1.0 - fresnel);
    }
    vec3 light = base.rgb * (1.0 - 0.5 * metallic) * diffuse + mix(vec3(0.04), base.rgb, metallic) * specular + grazing;
    vec3 over = max(light - SHOULDER, 0.0);
    light = min(light, SHOULDER) + (1.0 - SHOULDER) * (1.0 - exp(over * (-1.0 / (1.0 - SHOULDER))));
    pixel = vec4(encoded(clamp(light + emission, 0.0, 1.0)), 1.0);
#endif
#ifdef TRANSLUCENT
    pixel = vec4(pixel.rgb * alpha, alpha);
#endif
}
"""


_TYPES = {
    "light_direction": "vec3[MAX_LIGHTS]",
    "light_colour": "vec3[MAX_LIGHTS]",
    "sky": "vec3",
    "ground": "vec3",
    "base_colour": "vec4",
    "emissive": "vec3",
    "metallic": "float",
    "squared_alpha": "float",
    "shadowing": "float",
}
_COMMON_ROUGHNESS = (0.55, DEFAULT_ROUGHNESS)  # of generated objects, and of files that state none


def constants_of_surface(surface: ShadedSurface) -> dict[str, str]:
    """Common values of a surface's material as GLSL constants by name; only few, to limit the number of programs."""
    constants = {}
    if (surface.base_colour == 1.0).all():
        constants["base_colour"] = "vec4(1.0)"
    if not surface.emissive.any():
        constants["emissive"] = "vec3(0.0)"
    if surface.metallic == 0.0:
        constants["metallic"] = "0.0"
    if surface.roughness in _COMMON_ROUGHNESS:
        constants |= {name: f"{value:.9g}" for name, value in _roughness_constants(surface.roughness).items()}
    return constants


@lru_cache(maxsize=8)
def constants_of_lighting(lighting: Lighting) -> dict[str, str]:
    """Lights shared by many objects and views, as GLSL constants by name; empty for others."""
    if not lighting.is_constant or lighting.follows_camera or not lighting.lights:
        return {}
    unused = [np.zeros(3)] * (MAX_LIGHTS - len(lighting.lights))
    arrays = {"light_direction": lighting.directions(np.eye(4)), "light_colour": lighting.colours}
    constants = {name: f"vec3[]({', '.join(map(_vector, [*rows, *unused]))})" for name, rows in arrays.items()}
    return constants | {"sky": _vector(lighting.sky), "ground": _vector(lighting.ground)}


def _vector(values: Sequence[float] | Floats) -> str:
    return f"vec3({', '.join(f'{value:.9g}' for value in values)})"


def _roughness_constants(roughness: float) -> dict[str, float]:
    return {"squared_alpha": roughness**4, "shadowing": (roughness + 1.0) ** 2 / 8.0}


def compile_program(vertex: str, fragment: str, constants: dict[str, Any]) -> int:
    """OpenGL's name of a program from GLSL without version; `constants` are defined for the preprocessor."""
    head = "#version 330 core\n" + "".join(f"#define {name} {value}\n" for name, value in constants.items())
    # Some drivers do not validate a program without a bound vertex array.
    array = GL.glGenVertexArrays(1)
    GL.glBindVertexArray(array)
    program = shaders.compileProgram(
        shaders.compileShader(head + vertex, GL.GL_VERTEX_SHADER),
        shaders.compileShader(head + fragment, GL.GL_FRAGMENT_SHADER),
    )
    GL.glBindVertexArray(0)
    GL.glDeleteVertexArrays(1, [array])
    return program


class ShaderProgram:
    """The shaders for surfaces with the same features, and the locations of their uniforms.

    Args:
        defines: features of the surfaces: UV, EMISSIVE_UV and COLOUR with the number of their vertex attribute,
            TEXTURE, EMISSIVE_TEXTURE, TRANSLUCENT and UNLIT, and LIGHTS, the number of lights.
        constants: GLSL values that replace uniforms.

    Attributes:
        handle: OpenGL's name of the program.
    """

    def __init__(self, defines: dict[str, int], constants: dict[str, str]) -> None:
        numbers = {"MAX_LIGHTS": MAX_LIGHTS, "SHOULDER": SHOULDER, "TRANSLUCENT_TEXELS": TRANSLUCENT_TEXELS}
        values = "".join(
            f"const {kind} {name} = {constants[name]};\n" if name in constants else f"uniform {kind} {name};\n"
            for name, kind in _TYPES.items()
        )
        self.handle = compile_program(_VERTEX, values + _FRAGMENT, defines | numbers)
        self._lights = defines["LIGHTS"]
        self._places: dict[str, int] = {}
        GL.glUseProgram(self.handle)
        GL.glUniform1i(self._at("base_texture"), 0)
        GL.glUniform1i(self._at("emissive_texture"), 1)

    def _at(self, name: str) -> int:
        """The location of a uniform; -1, which OpenGL ignores, if it is not compiled in."""
        if name not in self._places:
            self._places[name] = GL.glGetUniformLocation(self.handle, name)
        return self._places[name]

    def set_view(self, clip_from_world: Floats, camera: Floats, lighting: Lighting, light_directions: Floats) -> None:
        """Set the uniforms of a view; arguments as in `SurfaceRenderer.draw`."""
        GL.glUniformMatrix4fv(self._at("clip_from_world"), 1, GL.GL_TRUE, clip_from_world.astype(np.float32))
        GL.glUniform3fv(self._at("camera"), 1, camera.astype(np.float32))
        if self._lights and self._at("light_direction") >= 0:
            GL.glUniform3fv(self._at("light_direction"), self._lights, light_directions.astype(np.float32))
            GL.glUniform3fv(self._at("light_colour"), self._lights, lighting.colours.astype(np.float32))
        GL.glUniform3f(self._at("sky"), *lighting.sky)
        GL.glUniform3f(self._at("ground"), *lighting.ground)

    def set_surface(self, surface: ShadedSurface, layer: int) -> None:
        """Set the uniforms of a surface, of which OPAQUE_TEXELS or TRANSLUCENT_TEXELS are drawn."""
        GL.glUniform4f(self._at("base_colour"), *surface.base_colour)
        GL.glUniform3f(self._at("emissive"), *surface.emissive)
        for name, value in _roughness_constants(surface.roughness).items():
            GL.glUniform1f(self._at(name), value)
        GL.glUniform1f(self._at("metallic"), surface.metallic)
        GL.glUniform1f(self._at("cutoff"), -1.0 if surface.cutoff is None else surface.cutoff)
        GL.glUniform1i(self._at("layer"), layer)
