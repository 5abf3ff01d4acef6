"""Framebuffers for supersampling in OpenGL, and the pass that averages the samples. Imports OpenGL.

OpenGL averages: a ninth of the bytes is read back, already with straight alpha. There is no multisampling: Mesa's
software renderer shades each multisample, at a higher cost than that of a separate sample (5.0 ms against 2.9 for four
samples a pixel of a car at 128x128).
"""

from __future__ import annotations

from typing import cast

import numpy as np
import numpy.typing as npt
from OpenGL import GL

from data_gen.rendering.opengl.shader_program import compile_program

__all__ = ["SampleFramebuffers"]

_VERTEX = """
void main() {
    gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}
"""

_FRAGMENT = """
uniform sampler2D samples;
out vec4 pixel;

void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * SIDE;
    vec4 total = vec4(0.0);
    for (int row = 0; row < SIDE; row++)
        for (int column = 0; column < SIDE; column++)
            total += texelFetch(samples, first + ivec2(column, row), 0);
    pixel = vec4(total.rgb / max(total.a, 1e-6), total.a / float(SIDE * SIDE));
}
"""


class SampleFramebuffers:
    """Framebuffers for one picture size.

    Args:
        width: pixels across.
        height: pixels down.
        side: samples along a side of a pixel.

    Attributes:
        size: the arguments.
        drawn: OpenGL's name of the framebuffer to draw into, `side` times as wide and high, with depth.
    """

    def __init__(self, width: int, height: int, side: int) -> None:
        self.size = (width, height, side)
        self.drawn, self._averaged = GL.glGenFramebuffers(2)
        self._depth, self._pixels = GL.glGenRenderbuffers(2)
        self._samples = GL.glGenTextures(1)
        self._array = GL.glGenVertexArrays(1)
        wide, high = width * side, height * side
        GL.glActiveTexture(GL.GL_TEXTURE0)
        GL.glBindTexture(GL.GL_TEXTURE_2D, self._samples)
        GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_RGBA8, wide, high, 0, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, None)
        for name in (GL.GL_TEXTURE_MIN_FILTER, GL.GL_TEXTURE_MAG_FILTER):
            GL.glTexParameteri(GL.GL_TEXTURE_2D, name, GL.GL_NEAREST)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self.drawn)
        GL.glFramebufferTexture2D(GL.GL_FRAMEBUFFER, GL.GL_COLOR_ATTACHMENT0, GL.GL_TEXTURE_2D, self._samples, 0)
        self._attach(self._depth, GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT, wide, high)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._averaged)
        self._attach(self._pixels, GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0, width, height)
        self._program = compile_program(_VERTEX, _FRAGMENT, {"SIDE": side})

    def read(self) -> npt.NDArray[np.uint8]:
        """The averaged samples: sRGB with straight alpha `(height, width, 4)`, bottom row first."""
        width, height, _ = self.size
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._averaged)
        GL.glViewport(0, 0, width, height)
        for state in (GL.GL_DEPTH_TEST, GL.GL_CULL_FACE, GL.GL_BLEND):
            GL.glDisable(state)
        GL.glActiveTexture(GL.GL_TEXTURE0)
        GL.glBindTexture(GL.GL_TEXTURE_2D, self._samples)
        GL.glUseProgram(self._program)
        GL.glBindVertexArray(self._array)
        GL.glDrawArrays(GL.GL_TRIANGLES, 0, 3)
        GL.glBindVertexArray(0)
        pixels = GL.glReadPixels(0, 0, width, height, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE)
        return np.frombuffer(cast(bytes, pixels), dtype=np.uint8).reshape(height, width, 4)

    def delete(self) -> None:
        """Free all buffers."""
        GL.glDeleteProgram(self._program)
        GL.glDeleteFramebuffers(2, [self.drawn, self._averaged])
        GL.glDeleteRenderbuffers(2, [self._depth, self._pixels])
        GL.glDeleteTextures([self._samples])
        GL.glDeleteVertexArrays(1, [self._array])

    @staticmethod
    def _attach(buffer: int, kind: int, attachment: int, width: int, height: int) -> None:
        GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
        GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, kind, width, height)
        GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, buffer)
