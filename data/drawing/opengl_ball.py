"""Balls drawn by OpenGL's fixed-function pipeline, in memory, through OSMesa (Debian package ``libosmesa6``).

What OpenGL computes per vertex (OpenGL 2.1 specification, section 2.14.1), with scene and material as given here:

    colour = k_a I_a + sum_i attenuation_i spot_i I_i [ k_d (N.L_i)+ + k_s (N.H_i)+^n ],  no highlight where N.L_i <= 0

It then **clamps the colour to [0, 1]** and interpolates it over the face: keep pictures below 1 (or let the fit leave
the saturated pixels out), and faces small. Faces here are a quarter of a pixel wide: interpolation flattens a lobe by
less than n / (128 R^2) of its height, R the ball's radius in pixels, and blurs over a face the edge of a spot's cone,
the edge of a saturated area, and the highlight's jump to zero where N.L = 0. Points with N.V <= 0 keep their highlight;
only a local viewer in an orthographic picture sees such points, near the silhouette, and only lobes of n < 10 show it.
Shininess is limited to 128, the number of lights to 8, and nothing casts a shadow.
"""

import contextlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

os.environ.setdefault("PYOPENGL_PLATFORM", "osmesa")  # read when OpenGL is first imported

from OpenGL import GL, osmesa

__all__ = ["draw_ball", "float_context"]

FACE_PIXELS = 0.25


def draw_ball(scene: Mapping[str, Any], material: Mapping[str, Any]) -> np.ndarray:
    """Draws the spheres of a scene.

    Args:
        scene: A parsed ``scene.toml``: orthographic or perspective camera, spheres, ``ambient``, and up to 8 lights
            (directional, point, spot). ``camera.viewer`` is ``"local"`` or ``"infinite"`` (the default with an
            orthographic camera); an infinite viewer sees every point from the direction the camera looks from.
        material: ``k_a``, ``k_d``, ``k_s`` (three numbers each) and ``n`` in [0, 128], Blinn-Phong.

    Returns:
        (height, width, 3) float32, linear, row 0 at the top, clamped to [0, 1].

    Raises:
        ValueError: The scene holds what the fixed-function pipeline cannot draw.
    """
    camera = scene["camera"]
    width, height = camera["resolution"]
    spheres = scene["shapes"]
    for shape in spheres:
        if shape["type"] != "sphere":
            raise ValueError(f"shapes: OpenGL draws spheres here, got {shape['type']!r}")
    if not 0 <= material["n"] <= 128:
        raise ValueError(f"n: OpenGL's shininess is limited to [0, 128], got {material['n']}")

    world_to_eye = _look_at(camera)
    eye_centres = [(world_to_eye @ [*sphere["center"], 1.0])[:3] for sphere in spheres]
    radii = [float(sphere["radius"]) for sphere in spheres]
    with float_context(width, height) as picture:
        GL.glViewport(0, 0, width, height)
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glDisable(GL.GL_DITHER)
        GL.glShadeModel(GL.GL_SMOOTH)
        GL.glMatrixMode(GL.GL_PROJECTION)
        GL.glLoadMatrixd(_projection(camera, eye_centres, radii).T)
        GL.glMatrixMode(GL.GL_MODELVIEW)
        GL.glLoadMatrixd(world_to_eye.T)  # lights are given in world space: OpenGL takes them through this matrix
        _set_lights(scene)
        _set_material(material)
        GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
        GL.glLoadIdentity()
        for centre, radius in zip(eye_centres, radii, strict=True):
            _draw_cap(centre, radius, camera)
        GL.glFinish()
        return picture[::-1, :, :3].copy()


@contextlib.contextmanager
def float_context(width: int, height: int) -> Iterator[np.ndarray]:
    """A context that draws float32 RGBA into the array it yields (row 0 at the bottom, OpenGL's order)."""
    context = osmesa.OSMesaCreateContextExt(osmesa.OSMESA_RGBA, 24, 0, 0, None)
    picture = np.zeros((height, width, 4), np.float32)
    if not context or not osmesa.OSMesaMakeCurrent(context, picture, GL.GL_FLOAT, width, height):
        raise RuntimeError("OSMesa gave no float context")
    try:
        yield picture
    finally:
        osmesa.OSMesaDestroyContext(context)


def _look_at(camera: Mapping[str, Any]) -> np.ndarray:
    """World to eye space, 4 x 4: the eye at the origin, looking along -z (what gluLookAt builds)."""
    position, target, up = (np.array(camera[key], float) for key in ("position", "target", "up"))
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(backward, right), backward])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ position
    return matrix


def _projection(camera: Mapping[str, Any], centres: Sequence[np.ndarray], radii: Sequence[float]) -> np.ndarray:
    """The matrix of glOrtho or glFrustum, with depth planes that just hold the spheres."""
    width, height = camera["resolution"]
    distances = [-centre[2] for centre in centres]
    near = min(distance - 1.01 * radius for distance, radius in zip(distances, radii, strict=True))
    far = max(distance + 1.01 * radius for distance, radius in zip(distances, radii, strict=True))
    if camera["type"] == "orthographic":
        half_width = camera["width"] / 2
        return np.array(
            [
                [1 / half_width, 0, 0, 0],
                [0, width / height / half_width, 0, 0],
                [0, 0, -2 / (far - near), -(far + near) / (far - near)],
                [0, 0, 0, 1.0],
            ]
        )
    near = max(near, 1e-3 * far)
    focal = 1 / math.tan(math.radians(camera["fov"]) / 2)
    return np.array(
        [
            [focal * height / width, 0, 0, 0],
            [0, focal, 0, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1.0, 0],
        ]
    )


def _set_lights(scene: Mapping[str, Any]) -> None:
    camera, lights = scene["camera"], scene["lights"]
    if len(lights) > 8:
        raise ValueError(f"lights: OpenGL has 8, got {len(lights)}")
    viewer = camera.get("viewer", "infinite" if camera["type"] == "orthographic" else "local")
    ambient = scene.get("ambient", {}).get("intensity", [0.0, 0.0, 0.0])
    GL.glEnable(GL.GL_LIGHTING)
    GL.glLightModelfv(GL.GL_LIGHT_MODEL_AMBIENT, [*ambient, 1.0])
    GL.glLightModeli(GL.GL_LIGHT_MODEL_LOCAL_VIEWER, int(viewer == "local"))
    for name, light in enumerate(lights, GL.GL_LIGHT0):
        GL.glEnable(name)
        GL.glLightfv(name, GL.GL_AMBIENT, [0.0, 0.0, 0.0, 1.0])
        GL.glLightfv(name, GL.GL_DIFFUSE, [*light["intensity"], 1.0])
        GL.glLightfv(name, GL.GL_SPECULAR, [*light["intensity"], 1.0])
        if light["type"] == "directional":
            GL.glLightfv(name, GL.GL_POSITION, [*light["direction"], 0.0])
            continue
        if light["type"] not in ("point", "spot"):
            raise ValueError(f"lights: OpenGL knows directional, point and spot, got {light['type']!r}")
        GL.glLightfv(name, GL.GL_POSITION, [*light["position"], 1.0])
        constant, linear, quadratic = light.get("attenuation", [0.0, 0.0, 1.0])
        GL.glLightf(name, GL.GL_CONSTANT_ATTENUATION, constant)
        GL.glLightf(name, GL.GL_LINEAR_ATTENUATION, linear)
        GL.glLightf(name, GL.GL_QUADRATIC_ATTENUATION, quadratic)
        if light["type"] == "spot":
            GL.glLightfv(name, GL.GL_SPOT_DIRECTION, light["direction"])
            GL.glLightf(name, GL.GL_SPOT_CUTOFF, light["cutoff_angle"])
            GL.glLightf(name, GL.GL_SPOT_EXPONENT, light["exponent"])


def _set_material(material: Mapping[str, Any]) -> None:
    GL.glMaterialfv(GL.GL_FRONT_AND_BACK, GL.GL_AMBIENT, [*material["k_a"], 1.0])
    GL.glMaterialfv(GL.GL_FRONT_AND_BACK, GL.GL_DIFFUSE, [*material["k_d"], 1.0])
    GL.glMaterialfv(GL.GL_FRONT_AND_BACK, GL.GL_SPECULAR, [*material["k_s"], 1.0])
    GL.glMaterialf(GL.GL_FRONT_AND_BACK, GL.GL_SHININESS, material["n"])


def _draw_cap(centre: np.ndarray, radius: float, camera: Mapping[str, Any]) -> None:
    """The half of a sphere that faces the eye, as rings of small quads around the axis towards the eye."""
    width, height = camera["resolution"]
    if camera["type"] == "orthographic":
        axis = np.array([0.0, 0.0, 1.0])
        pixels_per_unit = width / camera["width"]
    else:
        distance = float(np.linalg.norm(centre))
        axis = -centre / distance
        pixels_per_unit = height / 2 / math.tan(math.radians(camera["fov"]) / 2) / (distance - radius)
    step = FACE_PIXELS / (radius * pixels_per_unit)
    rings, sectors = math.ceil(math.pi / 2 / step), math.ceil(2 * math.pi / step)
    polar = np.linspace(0, math.pi / 2, rings + 1)[:, None]
    azimuth = np.linspace(0, 2 * math.pi, sectors + 1)
    across = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0], axis)
    across /= np.linalg.norm(across)
    normals = (
        (np.sin(polar) * np.cos(azimuth))[..., None] * across
        + (np.sin(polar) * np.sin(azimuth))[..., None] * np.cross(axis, across)
        + np.broadcast_to(np.cos(polar), (rings + 1, sectors + 1))[..., None] * axis
    )
    vertices = np.ascontiguousarray(centre + radius * normals, np.float32)
    normals = np.ascontiguousarray(normals, np.float32)
    index = np.arange((rings + 1) * (sectors + 1), dtype=np.uint32).reshape(rings + 1, sectors + 1)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).ravel()
    GL.glEnableClientState(GL.GL_VERTEX_ARRAY)
    GL.glEnableClientState(GL.GL_NORMAL_ARRAY)
    GL.glVertexPointer(3, GL.GL_FLOAT, 0, vertices)
    GL.glNormalPointer(GL.GL_FLOAT, 0, normals)
    GL.glDrawElements(GL.GL_QUADS, quads.size, GL.GL_UNSIGNED_INT, quads)
