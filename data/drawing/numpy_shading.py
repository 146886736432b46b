"""The shading equation in plain NumPy float64, written straight from the lectures: the oracle of the drawing programs.

radiance = k_a I_a + sum_i I_i [ k_d (N.L_i)+ + k_s S(L_i, V) ], with S = 0 where N.L_i <= 0 or N.V <= 0.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Sight", "shade", "trace"]


class Sight(NamedTuple):
    """What the pixels of a camera see; rows from the top.

    Attributes:
        hit: (H, W) whether the ray through the pixel's centre meets a shape.
        position: (H, W, 3) where, in world space.
        normal: (H, W, 3) unit normal there.
        to_view: (H, W, 3) unit direction back along the ray.
        shape: (H, W) index of the shape met, -1 for none.
    """

    hit: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    to_view: np.ndarray
    shape: np.ndarray

    def inside(self, pixels: int) -> np.ndarray:
        """(H, W): pixels whose neighbours up to that many pixels away (rows and columns) all see the same shape."""
        padded = np.pad(self.shape, pixels, constant_values=-1)
        height, width = self.shape.shape
        same = self.hit.copy()
        for down in range(2 * pixels + 1):
            for right in range(2 * pixels + 1):
                same &= padded[down : down + height, right : right + width] == self.shape
        return same


def trace(camera: Mapping[str, Any], shapes: list[dict[str, Any]]) -> Sight:
    """Sends one ray through the centre of every pixel of a ``[camera]`` table at spheres and rectangles."""
    width, height = camera["resolution"]
    position, target, up = (np.array(camera[key], float) for key in ("position", "target", "up"))
    forward = _unit(target - position)
    right = _unit(np.cross(forward, up))
    above = np.cross(right, forward)
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = 1 - (np.arange(height) + 0.5) / height * 2
    if camera["type"] == "orthographic":
        half = camera["width"] / 2
        x, y = x * half, y * half * height / width
        origin = position + x[None, :, None] * right + y[:, None, None] * above
        direction = np.broadcast_to(forward, origin.shape)
    else:
        half = math.tan(math.radians(camera["fov"]) / 2)
        x, y = x * half * width / height, y * half
        direction = _unit(forward + x[None, :, None] * right + y[:, None, None] * above)
        origin = np.broadcast_to(position, direction.shape)
    distance, normal, shape = _nearest(origin, direction, shapes)
    hit = np.isfinite(distance)
    return Sight(hit, origin + np.where(hit, distance, 1)[..., None] * direction, normal, -direction, shape)


def shade(
    scene: Mapping[str, Any], material: Mapping[str, Any], viewer: str | None = None, shadows: bool = False
) -> np.ndarray:
    """Renders spheres and rectangles under directional, point and spot lights.

    Args:
        scene: A parsed ``scene.toml``.
        material: ``model``, ``k_a``, ``k_d`` and, unless Lambert, ``k_s`` and ``n``.
        viewer: ``"local"``: V points to the camera's position; ``"infinite"``: V is the direction opposite to where
            the camera looks. Default: the camera's key ``viewer``, else infinite with an orthographic camera.
        shadows: Whether shapes cast them.

    Returns:
        (H, W, 3) float64, not clamped, zero where nothing is hit.
    """
    camera = scene["camera"]
    sight = trace(camera, scene["shapes"])
    viewer = viewer or camera.get("viewer", "infinite" if camera["type"] == "orthographic" else "local")
    eye, target = np.array(camera["position"], float), np.array(camera["target"], float)
    to_view = _unit(eye - sight.position) if viewer == "local" else np.broadcast_to(_unit(eye - target), (3,))
    n_dot_v = np.sum(sight.normal * to_view, -1)
    ambient = np.array(scene.get("ambient", {}).get("intensity", [0.0, 0.0, 0.0]))
    image = np.broadcast_to(np.array(material["k_a"]) * ambient, sight.normal.shape).copy()
    for light in scene["lights"]:
        to_light, distance, falloff = _light(light, sight.position)
        n_dot_l = np.sum(sight.normal * to_light, -1)
        lit = n_dot_l > 0
        if shadows:
            start = sight.position + 1e-6 * sight.normal
            lit &= _nearest(start, np.broadcast_to(to_light, start.shape), scene["shapes"])[0] >= distance
        term = np.array(material["k_d"]) * n_dot_l[..., None]
        if material["model"] != "lambert":
            lobe = np.where(n_dot_v > 0, _lobe(material, sight.normal, to_light, to_view, n_dot_l), 0)
            term = term + np.array(material["k_s"]) * lobe[..., None]
        image += np.where(lit, falloff, 0)[..., None] * np.array(light["intensity"]) * term
    return np.where(sight.hit[..., None], image, 0)


def _lobe(
    material: Mapping[str, Any], normal: np.ndarray, to_light: np.ndarray, to_view: np.ndarray, n_dot_l: np.ndarray
) -> np.ndarray:
    n, model = material["n"], material["model"]
    if model.endswith("blinn-phong"):
        cosine = np.sum(normal * _unit(to_light + to_view), -1)
        scale = (n + 2) * (n + 4) / (8 * (2 ** (-n / 2) + n))
    else:
        cosine = np.sum((2 * n_dot_l[..., None] * normal - to_light) * to_view, -1)
        scale = (n + 2) / 2
    power = np.where(cosine > 0, np.abs(cosine) ** n, 0)
    return scale * n_dot_l * power if model.startswith("normalized") else power


def _light(light: Mapping[str, Any], position: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit direction to the light, distance to it, and what is left of its intensity there."""
    if light["type"] == "directional":
        far = np.full(position.shape[:-1], np.inf)
        return _unit(np.array(light["direction"], float)), far, np.ones(position.shape[:-1])
    offset = np.array(light["position"]) - position
    distance = np.linalg.norm(offset, axis=-1)
    constant, linear, quadratic = light.get("attenuation", [0.0, 0.0, 1.0])
    falloff = 1 / (constant + linear * distance + quadratic * distance**2)
    to_light = _unit(offset)
    if light["type"] == "spot":
        cosine = np.sum(-to_light * _unit(np.array(light["direction"], float)), -1)
        inside = cosine >= math.cos(math.radians(light["cutoff_angle"]))
        falloff = np.where(inside, falloff * np.maximum(cosine, 0) ** light["exponent"], 0)
    return to_light, distance, falloff


def _nearest(
    origin: np.ndarray, direction: np.ndarray, shapes: list[dict[str, Any]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance along each ray (inf: nothing), unit normal and index of the nearest shape in front."""
    nearest = np.full(direction.shape[:-1], np.inf)
    normals = np.zeros(direction.shape)
    index = np.full(direction.shape[:-1], -1)
    for number, shape in enumerate(shapes):
        distance, normal = (_sphere if shape["type"] == "sphere" else _rectangle)(origin, direction, shape)
        closer = distance < nearest
        nearest = np.where(closer, distance, nearest)
        normals = np.where(closer[..., None], normal, normals)
        index = np.where(closer, number, index)
    return nearest, normals, index


def _sphere(origin: np.ndarray, direction: np.ndarray, shape: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    offset = origin - np.array(shape["center"])
    half_b = np.sum(offset * direction, -1)
    discriminant = half_b**2 - np.sum(offset**2, -1) + shape["radius"] ** 2
    distance = -half_b - np.sqrt(np.maximum(discriminant, 0))
    met = (discriminant > 0) & (distance > 0)
    distance = np.where(met, distance, np.inf)
    normal = (offset + np.where(met, distance, 0)[..., None] * direction) / shape["radius"]
    return distance, normal


def _rectangle(origin: np.ndarray, direction: np.ndarray, shape: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    edge_u, edge_v = np.array(shape["edge_u"], float), np.array(shape["edge_v"], float)
    normal = _unit(np.cross(edge_u, edge_v))
    slope = np.sum(direction * normal, -1)
    slope = np.where(slope == 0, 1e-300, slope)  # a parallel ray then meets the plane too far away to count
    distance = np.sum((np.array(shape["center"]) - origin) * normal, -1) / slope
    local = origin + np.where(np.abs(distance) < 1e6, distance, 0)[..., None] * direction - np.array(shape["center"])
    u, v = local @ edge_u / (edge_u @ edge_u), local @ edge_v / (edge_v @ edge_v)
    met = (np.abs(u) <= 1) & (np.abs(v) <= 1) & (distance > 0) & (distance < 1e6)
    return np.where(met, distance, np.inf), np.broadcast_to(normal, direction.shape)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
