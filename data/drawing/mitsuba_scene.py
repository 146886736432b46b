"""Scenes rendered by Mitsuba 3 (``scalar_rgb``), direct light only, the five models as a BSDF plugin written here.

A light's intensity I is the radiance that a white Lambertian surface facing it shows, and the toolkit sums
I [k_d (N.L)+ + k_s S]; Mitsuba integrates f_r (N.L)+ times radiance over solid angle. Hence

==================================  ====================================================================
Mitsuba                             from the toolkit's numbers
==================================  ====================================================================
BSDF, cosine included               f_r (N.L)+ = [k_d (N.L)+ + k_s S] / pi
``directional``: irradiance         pi I
``point``: intensity (W/sr)         pi I: irradiance pi I at distance 1; inverse squares only
spot (an emitter written here)      pi I cos^exponent inside the cutoff; inverse squares only
``area``, ``constant``, ``envmap``  the same radiance
``area`` on the shapes themselves   radiance k_a I_a, rendered apart and added: the ambient term
==================================  ====================================================================

``envmap`` axes: y is up (the first row is seen along +y), the left and right edges of the map along -z, a quarter of
the width from the left along +x, the middle along +z, three quarters along -x. Mitsuba has row i of H at the angle
pi i / (H - 1) and interpolates, the toolkit's texels shine evenly, from pi i / H to pi (i + 1) / H: it is given those.

Every ray goes through the centre of its pixel, or of one of the k x k equal squares of it where ``camera.samples`` is
k, so that pixels compare with the toolkit's to rounding under lights without extent. Light samples are the only noise.
Lights cast no shadows and are hidden from the camera. Lights are sampled, lobes are not, with a multi-jittered pattern:
at n = 30, 64 samples of a small area light or 1024 of a smooth environment leave a noise of 0.1 % in the median pixel.
"""

import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

__all__ = ["render"]

mi.set_variant("scalar_rgb")  # the plugins' base classes and Mitsuba's types exist only from here on


def render(scene: Mapping[str, Any], material: Mapping[str, Any], spp: int = 64, seed: int = 0) -> np.ndarray:
    """Renders spheres, rectangles and triangle meshes, all of one material, under any of the lights, with shadows.

    Args:
        scene: A parsed ``scene.toml``; files in it are absolute paths. Polygon lights are convex.
        material: ``model``, ``k_a``, ``k_d`` and, unless Lambert, ``k_s`` and ``n``, three channels.
        spp: Samples per pixel and light, a square number; lights without extent take no more than they need
            (one per square of the pixel).
        seed: Of the light samples.

    Returns:
        (height, width, 3) float32, linear, row 0 at the top, black where no shape is hit.

    Raises:
        ValueError: The scene holds what Mitsuba cannot do: an attenuation that is not an inverse square.
    """
    camera = scene["camera"]
    image = np.zeros((*camera["resolution"][::-1], 3), np.float32)
    numbers = {key: _numbers(material[key]) for key in ("k_d", "k_s") if key in material}
    bsdf = {
        "type": "classic",
        "id": "classic",
        "model": material["model"],
        "n": float(material.get("n", 0.0)),
    } | numbers
    matter = {"bsdf": {"type": "ref", "id": "classic"}}
    objects = {f"shape_{index}": _shape(shape) | matter for index, shape in enumerate(scene["shapes"])}
    # One light at a time: with several, Mitsuba would draw one per sample, and lights would shadow each other.
    for light in scene["lights"]:
        samples = camera.get("samples", 1) ** 2 if light["type"] in ("directional", "point", "spot") else spp
        with tempfile.TemporaryDirectory() as folder:
            world = mi.load_dict(
                {
                    "type": "scene",
                    "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0, "hide_emitters": True},
                    "sensor": _sensor(camera, samples),
                    "classic": bsdf,
                    "light": _light(light, Path(folder) / "polygon.obj"),
                    **objects,
                }
            )
        image += np.array(mi.render(world, spp=samples, seed=seed))
    ambient = np.array(material["k_a"]) * scene.get("ambient", {}).get("intensity", [0.0, 0.0, 0.0])
    if ambient.any():
        samples = camera.get("samples", 1) ** 2
        matter = {"emitter": {"type": "area", "radiance": _rgb(ambient)}}
        objects = {f"shape_{index}": _shape(shape) | matter for index, shape in enumerate(scene["shapes"])}
        seen = {"type": "path", "max_depth": 1}
        world = mi.load_dict({"type": "scene", "integrator": seen, "sensor": _sensor(camera, samples), **objects})
        image += np.array(mi.render(world, spp=samples, seed=seed))
    return image


class _Classic(mi.BSDF):
    """The five models. Scalars leave Mitsuba's vectors first: Python floats are what is fast here."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.model = props["model"]
        self.n = props["n"]
        self.k_d = _triple(props["k_d"])
        self.k_s = _triple(props["k_s"]) if "k_s" in props else (0.0, 0.0, 0.0)
        scale = {
            "normalized-phong": (self.n + 2) / 2,
            "normalized-blinn-phong": (self.n + 2) * (self.n + 4) / (8 * (2 ** (-self.n / 2) + self.n)),
        }
        self.scale = scale.get(self.model, 1.0)
        self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        self.m_components = [self.m_flags]

    def eval(self, ctx: Any, si: Any, wo: Any, active: bool = True) -> Any:
        view_x, view_y, view_z = si.wi.x, si.wi.y, si.wi.z
        light_x, light_y, light_z = wo.x, wo.y, wo.z
        if light_z <= 0 or view_z <= 0:
            return mi.Color3f(0.0)
        if self.model.endswith("blinn-phong"):
            half = (light_x + view_x, light_y + view_y, light_z + view_z)
            cosine = half[2] / math.hypot(*half)
        else:
            cosine = light_z * view_z - light_x * view_x - light_y * view_y
        lobe = self.scale * cosine**self.n if cosine > 0 else 0.0
        if self.model.startswith("normalized"):
            lobe *= light_z
        return mi.Color3f(
            *((k_d * light_z + k_s * lobe) / math.pi for k_d, k_s in zip(self.k_d, self.k_s, strict=True))
        )

    def pdf(self, ctx: Any, si: Any, wo: Any, active: bool = True) -> float:
        return max(wo.z, 0.0) / math.pi  # asked for, never used: only lights are sampled

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: bool = True) -> tuple[Any, float]:
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def to_string(self) -> str:
        return f"Classic[{self.model}]"


class _Spot(mi.Emitter):
    """Mitsuba's own spot falls off linearly with the angle; this one as OpenGL's does."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.origin = mi.Point3f(*_triple(props["origin"]))
        self.axis = mi.Vector3f(*_triple(props["axis"]))
        self.strength = mi.Color3f(*_triple(props["strength"]))
        self.cosine_cutoff = math.cos(math.radians(props["cutoff_angle"]))
        self.exponent = props["exponent"]
        self.m_flags = mi.EmitterFlags.DeltaPosition

    def sample_direction(self, it: Any, sample: Any, active: bool = True) -> tuple[Any, Any]:
        offset = self.origin - it.p
        distance = math.hypot(offset.x, offset.y, offset.z)
        direction = mi.DirectionSample3f()
        direction.p = self.origin
        direction.n = mi.Normal3f(0.0)
        direction.time = it.time
        direction.d = offset / distance
        direction.dist = distance
        direction.pdf = 1.0
        direction.delta = True
        cosine = -sum(direction.d[axis] * self.axis[axis] for axis in range(3))
        falloff = max(cosine, 0.0) ** self.exponent / distance**2 if cosine >= self.cosine_cutoff else 0.0
        return direction, self.strength * falloff

    def to_string(self) -> str:
        return "Spot[]"


class _Centred(mi.Sensor):
    """Moves the rays of another sensor to the centres of a pixel's squares."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.camera = props["camera"]
        self.squares = [size * props["samples"] for size in self.film().size()]

    def sample_ray_differential(self, time: float, wave: float, at: Any, lens: Any, active: bool = True) -> Any:
        centre = [(math.floor(at[axis] * self.squares[axis]) + 0.5) / self.squares[axis] for axis in range(2)]
        return self.camera.sample_ray_differential(time, wave, mi.Point2f(*centre), lens, active)

    def to_string(self) -> str:
        return "Centred[]"


mi.register_bsdf("classic", _Classic)
mi.register_emitter("opengl_spot", _Spot)
mi.register_sensor("centred", _Centred)


def _sensor(camera: Mapping[str, Any], spp: int) -> dict[str, Any]:
    width, height = camera["resolution"]
    to_world = mi.ScalarTransform4f().look_at(origin=camera["position"], target=camera["target"], up=camera["up"])
    inner: dict[str, Any] = {"type": camera["type"], "near_clip": 1e-3}
    if camera["type"] == "orthographic":
        to_world = to_world @ mi.ScalarTransform4f().scale([camera["width"] / 2, camera["width"] / 2, 1.0])
    else:
        inner |= {"fov": float(camera["fov"]), "fov_axis": "y"}
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return {
        "type": "centred",
        "samples": int(camera.get("samples", 1)),
        "film": film,
        "sampler": {"type": "multijitter", "sample_count": spp},
        "camera": inner | {"to_world": to_world, "film": film},
    }


def _shape(shape: Mapping[str, Any]) -> dict[str, Any]:
    if shape["type"] == "sphere":
        return {"type": "sphere", "center": shape["center"], "radius": float(shape["radius"])}
    if shape["type"] == "triangles":
        return {"type": "obj", "filename": str(shape["file"]), "face_normals": not shape.get("smooth", True)}
    edge_u, edge_v = np.array(shape["edge_u"], float), np.array(shape["edge_v"], float)
    normal = np.cross(edge_u, edge_v)
    to_world = np.eye(4)
    to_world[:3] = np.stack([edge_u, edge_v, normal / np.linalg.norm(normal), shape["center"]], -1)
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(to_world)}


def _light(light: Mapping[str, Any], mesh: Path) -> dict[str, Any]:
    kind = light["type"]
    if kind == "directional":
        travels = [-float(x) for x in light["direction"]]
        return {"type": "directional", "direction": travels, "irradiance": _rgb(light["intensity"], math.pi)}
    if kind in ("point", "spot"):
        attenuation = list(light.get("attenuation", [0.0, 0.0, 1.0]))
        if attenuation[:2] != [0, 0]:
            raise ValueError(f"attenuation: Mitsuba's lights fall off as 1/d^2, got {attenuation}")
        power = math.pi / attenuation[2]
        if kind == "point":
            return {"type": "point", "position": light["position"], "intensity": _rgb(light["intensity"], power)}
        axis = np.array(light["direction"], float)
        return {
            "type": "opengl_spot",
            "origin": _numbers(light["position"]),
            "axis": _numbers(axis / np.linalg.norm(axis)),
            "strength": _numbers(np.array(light["intensity"]) * power),
            "cutoff_angle": float(light["cutoff_angle"]),
            "exponent": float(light["exponent"]),
        }
    if kind == "environment":
        if "file" in light:
            return {"type": "envmap", "bitmap": _sky(str(light["file"]))}
        return {"type": "constant", "radiance": _rgb(light["radiance"])}
    if kind == "polygon":
        vertices = "".join("v {} {} {}\n".format(*vertex) for vertex in light["vertices"])
        fan = "".join(f"f 1 {last} {last + 1}\n" for last in range(2, len(light["vertices"])))
        mesh.write_text(vertices + fan)
        light = {"type": "triangles", "file": mesh, "radiance": light["radiance"]}
    return _shape(light) | {"emitter": {"type": "area", "radiance": _rgb(light["radiance"])}}


def _sky(file: str, fine: int = 4) -> mi.Bitmap:
    """A map whose texels shine evenly, for an ``envmap``, which interpolates, its first and last row at the poles."""
    texels = np.array(mi.Bitmap(file).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32))
    height = len(texels)
    # Where a row lies between two texels it is the mean of both.
    row = np.clip(np.arange(fine * height + 1)[:, None] / fine + [-1e-6, 1e-6], 0, height - 1e-6).astype(int)
    return mi.Bitmap(np.repeat(texels[row].mean(axis=1), fine, axis=1))


def _rgb(values: Sequence[float] | np.ndarray, factor: float = 1.0) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(value) * factor for value in values]}


def _numbers(values: Sequence[float] | np.ndarray) -> mi.ScalarPoint3f:
    """Three numbers as a plugin property that no colour conversion touches."""
    return mi.ScalarPoint3f(*(float(value) for value in values))


def _triple(values: Any) -> tuple[float, float, float]:
    return (float(values[0]), float(values[1]), float(values[2]))
