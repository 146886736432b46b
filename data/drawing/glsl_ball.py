"""A ball drawn by a GLSL fragment shader, in memory, through OSMesa (Debian package ``libosmesa6``).

The shader is the caller's: functions ``vec3 brdf_ambient(vec3 intensity)`` and ``vec3 brdf_light(vec3 normal, vec3
to_light, vec3 to_view, vec3 intensity)``. This program adds what they need: a ball of radius 1 seen from +z through an
orthographic camera, one directional light, one ambient light, a pixel's centre a sample.
"""

from collections.abc import Sequence

import numpy as np

from drawing.opengl_ball import GL, float_context

__all__ = ["FRAGMENT", "draw_ball"]

VERTEX = "#version 120\nvoid main() { gl_Position = gl_Vertex; }\n"

FRAGMENT = """
uniform vec2 size;
uniform float width;
uniform vec3 direction;
uniform vec3 intensity;
uniform vec3 ambient;
void main() {
    vec2 place = (gl_FragCoord.xy / size.x - 0.5 * size / size.x) * width;
    float depth = 1.0 - dot(place, place);
    vec3 radiance = vec3(0.0);
    if (depth > 0.0) {
        vec3 normal = vec3(place, sqrt(depth));
        radiance = brdf_ambient(ambient) + brdf_light(normal, normalize(direction), vec3(0.0, 0.0, 1.0), intensity);
    }
    gl_FragColor = vec4(radiance, 1.0);
}
"""


def draw_ball(
    functions: str,
    *,
    size: int,
    width: float,
    direction: Sequence[float],
    intensity: Sequence[float],
    ambient: Sequence[float],
) -> np.ndarray:
    """Draws the ball.

    Args:
        functions: GLSL, see the head of this file.
        size: Pixels on a side.
        width: Of the picture, the ball's radius being 1.
        direction: Towards the light.
        intensity: Of the light, RGB.
        ambient: Of the ambient light, RGB.

    Returns:
        (size, size, 3) float32, linear, row 0 at the top.

    Raises:
        RuntimeError: The shader does not compile; with what the compiler says.
    """
    with float_context(size, size) as picture:
        program = GL.glCreateProgram()
        for kind, text in (
            (GL.GL_VERTEX_SHADER, VERTEX),
            (GL.GL_FRAGMENT_SHADER, "#version 120\n" + functions + FRAGMENT),
        ):
            shader = GL.glCreateShader(kind)
            GL.glShaderSource(shader, text)
            GL.glCompileShader(shader)
            if not GL.glGetShaderiv(shader, GL.GL_COMPILE_STATUS):
                raise RuntimeError(GL.glGetShaderInfoLog(shader))
            GL.glAttachShader(program, shader)
        GL.glLinkProgram(program)
        if not GL.glGetProgramiv(program, GL.GL_LINK_STATUS):
            raise RuntimeError(GL.glGetProgramInfoLog(program))
        GL.glUseProgram(program)
        GL.glUniform2f(GL.glGetUniformLocation(program, "size"), size, size)
        GL.glUniform1f(GL.glGetUniformLocation(program, "width"), width)
        for name, value in {"direction": direction, "intensity": intensity, "ambient": ambient}.items():
            GL.glUniform3f(GL.glGetUniformLocation(program, name), *value)
        GL.glClampColor(GL.GL_CLAMP_FRAGMENT_COLOR, GL.GL_FALSE)
        GL.glViewport(0, 0, size, size)
        GL.glBegin(GL.GL_QUADS)
        for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            GL.glVertex2f(x, y)
        GL.glEnd()
        GL.glFinish()
        return picture[::-1, :, :3].copy()
