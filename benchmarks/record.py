"""A record of what the product answers, to be compared after every change that is to change no answer.

    python -m benchmarks.record write before.json [--only PATTERN]
    python -m benchmarks.record compare before.json after.json

Some 200 cases: the pictures of data/ and of the folder that BRDF_REAL_DATA names (default ../shared/data, left out
where missing), pictures drawn here under every kind of light, checks, exports, files, commands and bad input, whose
lines of error are kept word for word. Seconds and paths are masked. Only names that scripts outside the project rely on
are used, so that one script runs on old and new code alike.

Numbers agree within 1e-9 of each other in float64; in float32 within 1e-5, or within a hundredth of the standard error
that stands beside them. Numbers in lines of text may also differ by one in their last digit.
"""

import argparse
import contextlib
import fnmatch
import io
import json
import math
import os
import re
import shutil
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import brdf
import fitting
from benchmarks.stability import stability_map

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "data"
REAL = Path(os.environ.get("BRDF_REAL_DATA", ROOT.parent / "shared" / "data"))

SIZE = 48
MODELS = ("lambert", "phong", "blinn-phong", "normalized-phong", "normalized-blinn-phong")
TOLERANCES = {"float64": 1e-9, "float32": 1e-5}
# What counts as nothing beside numbers of the size of 1.
SMALLEST = {"float64": 1e-12, "float32": 1e-7}

CASES: dict[str, tuple[Callable[[], Any], str]] = {}


def case(name: str, precision: str = "float64") -> Callable[[Callable[[], Any]], Callable[[], Any]]:
    """Put a function into the record.

    Args:
        name: of the case.
        precision: whose tolerance its numbers have.
    """

    def register(function: Callable[[], Any]) -> Callable[[], Any]:
        assert name not in CASES, name
        CASES[name] = function, precision
        return function

    return register


# -- what is written down of an answer ---------------------------------------------------------------------------------


def numbers(value: Any) -> Any:
    """An array as JSON: a few numbers as they are, many by what can be said of them."""
    array = np.asarray(value)
    if array.size <= 64:
        return array.tolist()
    values = array.astype(np.float64).ravel()
    finite = values[np.isfinite(values)]
    some = np.linspace(0, values.size - 1, 12).astype(int)
    told = {"shape": list(array.shape), "finite": int(finite.size), "some": values[some].tolist()}
    if finite.size:
        told |= {
            "mean": finite.mean(),
            "least": finite.min(),
            "largest": finite.max(),
            "rms": (finite**2).mean() ** 0.5,
        }
    return told


def material(value: Any) -> Any:
    """A material's model and numbers."""
    told = {key: numbers(getattr(value, key)) for key in ("k_a", "k_d", "k_s", "n") if hasattr(value, key)}
    return {"model": value.name} | told


def parameters(result: Any) -> list[dict[str, Any]]:
    """Each number with its error."""
    keys = ("name", "channel", "value", "error", "interval", "at_bound", "reason")
    return [{key: getattr(one, key) for key in keys} for one in result.parameters]


def fitted(result: Any) -> dict[str, Any]:
    """All of a fit but its time."""
    told = {
        "material": material(result.material),
        "surface": result.surface,
        "parameters": parameters(result),
        "noise": numbers(result.noise),
        "structure": result.structure,
        "highlight_pixels": result.highlight_pixels,
        "residual": result.residual,
        "pixels": result.pixels,
        "left_out": result.left_out,
        "warnings": list(result.warnings),
        "candidates": [{**vars(one)} for one in result.candidates],
        "correlation": numbers(result.correlation),
        "report": masked(str(result)),
    }
    if result.choice is not None:
        # What is chosen follows from how long things take here and now.
        told = {key: told[key] for key in ("surface", "left_out")}
    return told


def measured(result: Any) -> dict[str, Any]:
    """All of a fit of a measured BRDF but its time."""
    candidates = [{"model": one.model, "losses": one.losses._asdict()} for one in result.candidates]
    return {
        "material": material(result.material),
        "parameters": parameters(result),
        "candidates": candidates,
        "left_out": result.left_out,
        "fits": result.fits,
        "verdict": result.verdict,
        "report": masked(str(result)),
    }


def checked(report: Any) -> dict[str, Any]:
    """A verdict on plausibility."""
    findings = {name: getattr(report, name) for name in ("positivity", "reciprocity", "energy")}
    return {
        "plausible": report.plausible,
        "findings": {
            name: {"verdict": one.verdict, "margin": one.margin, "error_bound": one.error_bound}
            for name, one in findings.items()
        },
        "report": str(report),
    }


def scene_text(scene: Any) -> dict[str, Any]:
    """What a scene is, through its picture."""
    picture = brdf.render(MATERIAL, scene, precision="float64")
    return {"resolution": list(scene.resolution), "lights": len(scene.lights), "picture": numbers(picture)}


def masked(text: str) -> str:
    """A text without seconds, paths and versions."""
    for path, name in ((str(REAL), "REAL"), (str(ROOT), "ROOT"), (tempfile.gettempdir(), "TMP")):
        text = text.replace(str(path), name)
    text = re.sub(r"TMP/record-\w+", "FOLDER", text)
    text = re.sub(r"\.\w+\.part\w*", ".PART", text)
    text = re.sub(r'("\w*seconds": )[-+.\de]+', r"\1T", text)
    return re.sub(r"\b\d[\d.]*(e[-+]?\d+)? (ms|s|min)\b", r"T \2", text)


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    """A folder for a case's files, in which it runs."""
    before = os.getcwd()
    place = Path(tempfile.mkdtemp(prefix="record-"))
    os.chdir(place)
    try:
        yield place
    finally:
        os.chdir(before)
        shutil.rmtree(place)


def command(*words: Any) -> dict[str, Any]:
    """The command's exit status and what it said."""
    from fitting.cli.main import main

    out, err, status = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(word) for word in words])
        except SystemExit as done:
            status = int(done.code or 0)
    return {"status": status, "out": masked(out.getvalue()), "err": masked(err.getvalue())}


def files(place: Path, skip: tuple[str, ...] = ()) -> dict[str, Any]:
    """What lies in a folder."""
    told = {}
    for path in sorted(place.rglob("*")):
        name = str(path.relative_to(place))
        if path.is_dir() or name in skip:
            continue
        if path.suffix in (".exr", ".png", ".hdr"):
            told[name] = numbers(brdf.read_image(path))
        elif path.suffix in (".html", ".pdf"):
            told[name] = "there"
        else:
            told[name] = masked(path.read_text())
    return told


def refusal(function: Callable[[], Any]) -> str:
    """Why something is refused: the exception and its words."""
    try:
        came = function()
    except Exception as error:
        return masked(f"{type(error).__name__}: {error}")
    return f"no refusal: {type(came).__name__}"


# -- pictures drawn here -----------------------------------------------------------------------------------------------

MATERIAL = brdf.BlinnPhong(k_a=[0.2, 0.3, 0.1], k_d=[0.5, 0.3, 0.2], k_s=[0.4, 0.35, 0.3], n=40.0)
MATT = brdf.Lambert(k_a=[0.2, 0.3, 0.1], k_d=[0.5, 0.3, 0.2])
SUN = brdf.DirectionalLight(direction=(0.5, 0.6, 0.7), intensity=[1.0, 0.9, 0.8])


def sky(height: int = 16) -> np.ndarray:
    """A small lat-long map with a sun in it."""
    row, column = np.mgrid[:height, : 2 * height] + 0.5
    elevation, azimuth = np.pi * (0.5 - row / height), np.pi * column / height
    glow = 0.3 + 0.2 * np.sin(elevation) + 4.0 * np.exp(-8 * ((elevation - 0.6) ** 2 + (azimuth - 1.5) ** 2))
    return glow[..., None] * [0.9, 1.0, 1.2]


LIGHTS: dict[str, Callable[[], tuple[Any, ...]]] = {
    "directional": lambda: (SUN,),
    "point": lambda: (brdf.PointLight(position=(1.5, 2.0, 2.5), intensity=[9.0, 8.0, 7.0]),),
    "attenuated": lambda: (brdf.PointLight(position=(1.5, 2.0, 2.5), intensity=[1.0], attenuation=(0.5, 0.2, 0.15)),),
    "spot": lambda: (
        brdf.SpotLight(
            position=(1.0, 1.5, 3.0), direction=(-1.0, -1.5, -3.0), intensity=[9.0], cutoff_angle=25.0, exponent=3.0
        ),
    ),
    "rectangle": lambda: (
        brdf.RectangleLight(
            center=(1.5, 1.5, 3.0),
            edge_u=(0, 0.5, -0.25),
            edge_v=(0.5, 0, -0.25),
            radiance=[12.0, 11.0, 10.0],
            samples=9,
        ),
    ),
    "polygon": lambda: (
        brdf.PolygonLight(
            vertices=((1, 1, 3), (1, 2, 3), (2, 2, 3), (2.2, 1, 3), (1.6, 1.2, 3)), radiance=[14.0], samples=16
        ),
    ),
    "sphere": lambda: (brdf.SphereLight(center=(1.5, 2.0, 3.0), radius=0.5, radiance=[18.0, 17.0, 16.0], samples=16),),
    "constant": lambda: (brdf.ConstantEnvironment(radiance=[0.8, 0.9, 1.0], samples=64),),
    "map": lambda: (brdf.EnvironmentMap(sky(), samples=32),),
    "three": lambda: (
        SUN,
        brdf.DirectionalLight(direction=(-0.7, 0.2, 0.5), intensity=[0.3, 0.4, 0.5]),
        brdf.PointLight(position=(-1.5, -2.0, 2.5), intensity=[2.0]),
    ),
}


def ball(light: str = "directional", ambient: Any = (0.2, 0.25, 0.3), wall: bool = False, **camera: Any) -> brdf.Scene:
    """A ball under a light, perhaps before a wall that takes its shadow."""
    given = {"position": (0, 0, 4), "target": (0, 0, 0), "up": (0, 1, 0), "width": 2.2 if not wall else 3.2}
    view = brdf.OrthographicCamera(**(given | {"resolution": (SIZE, SIZE)} | camera))
    shapes: list[Any] = [brdf.Sphere(center=(0, 0, 0), radius=1.0)]
    if wall:
        shapes.append(brdf.Rectangle(center=(0, 0, -1.2), edge_u=(3, 0, 0), edge_v=(0, 3, 0)))
    return brdf.Scene(camera=view, shapes=shapes, ambient=ambient, lights=LIGHTS[light]())


def picture(scene: brdf.Scene, surface: Any = MATERIAL, noise: float = 0.01, seed: int = 7) -> np.ndarray:
    """What it looks like, with noise relative to its mean."""
    clean = np.asarray(brdf.render(surface, scene, precision="float64"))
    return clean + noise * clean.mean() * np.random.default_rng(seed).standard_normal(clean.shape)


def _fit_case(name: str, make: Callable[[], tuple[Any, Any]], precision: str = "float64", **options: Any) -> None:
    """A case that fits a target and a scene."""

    @case(f"fit/{name}", precision)
    def run() -> Any:
        target, scene = make()
        return fitted(fitting.fit(target, scene, precision=precision, **options))


def _made(light: str, surface: Any = MATERIAL, noise: float = 0.01, **scene: Any) -> Callable[[], tuple[Any, Any]]:
    def make() -> tuple[Any, Any]:
        lit = ball(light, **scene)
        return picture(lit, surface, noise), lit

    return make


for light_name in LIGHTS:
    _fit_case(f"light {light_name}", _made(light_name), model="blinn-phong")
for light_name in ("directional", "rectangle", "map"):
    _fit_case(f"light {light_name}, float32", _made(light_name), "float32", model="blinn-phong")
for light_name in ("directional", "point", "rectangle", "three"):
    _fit_case(f"wall in the shadow, {light_name}", _made(light_name, wall=True), model="blinn-phong")
for model_name in MODELS:
    _fit_case(f"model {model_name}", _made("directional"), model=model_name)
    truth = MATT if model_name == "lambert" else brdf.MODELS[model_name](k_a=0.1, k_d=[0.4, 0.3, 0.2], k_s=0.3, n=12.0)
    _fit_case(f"auto of {model_name}", _made("directional", truth), "float32")
_fit_case("auto of matt, float64", _made("directional", MATT))
_fit_case("auto of a point light", _made("point"))
_fit_case("auto of an area light", _made("rectangle"), "float32")
_fit_case("auto without ambient", _made("directional", ambient=None))
_fit_case(
    "auto, ambient missing from the material", _made("directional", brdf.Phong(k_d=[0.5] * 3, k_s=[0.3] * 3, n=25.0))
)
_fit_case("auto of black", lambda: (np.zeros((SIZE, SIZE, 3)), ball()))
_fit_case("auto of ambient alone", _made("directional", brdf.Lambert(k_a=[0.5, 0.4, 0.3], k_d=[0.0] * 3)))
_fit_case("auto of noise alone", lambda: (np.random.default_rng(3).uniform(0, 0.1, (SIZE, SIZE, 3)), ball()))
_fit_case(
    "sharp highlight", _made("directional", brdf.BlinnPhong(k_d=[0.2] * 3, k_s=[0.9] * 3, n=20000.0), noise=0.003)
)
_fit_case("broad highlight", _made("directional", brdf.Phong(k_d=[0.2] * 3, k_s=[0.5] * 3, n=0.7)), model="phong")
_fit_case("no noise", _made("directional", noise=0.0), model="blinn-phong")
_fit_case("no noise, float32", _made("directional", noise=0.0), "float32", model="blinn-phong")
_fit_case("much noise", _made("directional", noise=0.3))
_fit_case("local viewer", _made("directional", viewer="local"), model="phong")
_fit_case("pixel area", _made("directional", samples=4), model="blinn-phong")
_fit_case("plausible", _made("directional"), plausible=True)
_fit_case(
    "plausible, bound at work",
    _made("directional", brdf.BlinnPhong(k_d=[0.7] * 3, k_s=[0.9] * 3, n=9.0)),
    plausible=True,
)
_fit_case("plausible lambert", _made("directional"), plausible=True, model="lambert")
_fit_case("saturation", _made("directional"), saturation=0.7)
_fit_case("dark", _made("directional"), dark=0.05, model="blinn-phong")
_fit_case("camera noise", _made("directional"), noise=(0.002, 0.001), model="blinn-phong")
_fit_case("bounds of n", _made("directional"), n_range=(1.0, 20.0), model="blinn-phong")
_fit_case("n at the upper bound", _made("directional"), n_range=(1.0, 3.0), model="phong")
for loss_name in ("relative", "log", "huber", "cauchy"):
    _fit_case(f"loss {loss_name}", _made("directional"), loss=loss_name, model="blinn-phong")
_fit_case("loss huber, auto", _made("directional"), "float32", loss="huber")
_fit_case("accuracy", _made("directional", noise=0.001), "float32", accuracy=1e-2)
_fit_case("one channel", lambda: (picture(ball("spot"), brdf.Phong(k_a=0.1, k_d=0.4, k_s=0.3, n=20.0)), ball("spot")))


def _several() -> tuple[Any, Any]:
    scenes = [ball("directional"), ball("point"), ball("three")]
    return [picture(scene, seed=index) for index, scene in enumerate(scenes)], scenes


_fit_case("several pictures", _several)
_fit_case("several pictures, one model", _several, "float32", model="phong")


def _clipped() -> tuple[Any, Any]:
    lit = ball()
    return np.clip(picture(lit, brdf.BlinnPhong(k_a=[0.1] * 3, k_d=[0.8] * 3, k_s=[0.9] * 3, n=30.0)), 0, 1), lit


_fit_case("clipped above", _clipped, model="blinn-phong")
_fit_case("clipped above, auto", _clipped, "float32")
_fit_case("clipped at 0", lambda: (np.maximum(picture(ball(ambient=None), noise=0.1), 0), ball(ambient=None)))
_fit_case("flat and negative", lambda: (np.full((SIZE, SIZE, 3), -0.1), ball()))


def _shadowed() -> tuple[Any, Any]:
    lit = ball()
    shown = picture(lit)
    shown[:20, :20] *= 0.2
    return shown, lit


_fit_case("unknown shadow", _shadowed)
_fit_case("unknown shadow, cauchy", _shadowed, loss="cauchy", model="blinn-phong")


def _mirrored() -> tuple[Any, Any]:
    return picture(ball())[:, ::-1], ball()


_fit_case("mirrored picture", _mirrored)
_fit_case("not finite", lambda: (np.where(np.arange(SIZE)[:, None, None] == 20, np.nan, picture(ball())), ball()))


@case("fit/mask and weight")
def _masked_fit() -> Any:
    lit = ball()
    mask = np.zeros((SIZE, SIZE), bool)
    mask[10:30, 5:40] = True
    weight = np.linspace(0, 1, SIZE * SIZE).reshape(SIZE, SIZE)
    first = fitting.fit(picture(lit), lit, mask=mask, precision="float64")
    second = fitting.fit(picture(lit), lit, weight=weight, precision="float64")
    return [fitted(first), fitted(second)]


def _stored(suffix: str, **how: Any) -> Callable[[], Any]:
    def run() -> Any:
        lit = ball()
        with folder() as place:
            brdf.write_image(place / f"target{suffix}", 0.7 * picture(lit, noise=0.02).astype(np.float32), **how)
            read = brdf.read_picture(place / f"target{suffix}")
            return {"picture": numbers(read.pixels), "fit": fitted(fitting.fit(read, lit, precision="float64"))}

    return run


for name, suffix, how in (
    ("8 bit linear", ".png", {"encoding": "linear"}),
    ("8 bit srgb", ".png", {"encoding": "srgb"}),
    ("16 bit", ".png", {"dtype": "uint16", "encoding": "linear"}),
    ("half", ".exr", {"dtype": "half"}),
    ("hdr", ".hdr", {}),
    ("jpeg", ".jpg", {}),
    ("tiff float", ".tif", {"dtype": "float"}),
):
    case(f"fit/file of {name}")(_stored(suffix, **how))


@case("fit/by bands of rows", "float32")
def _bands() -> Any:
    lit = ball()
    with folder() as place:
        brdf.write_image(place / "target.exr", picture(lit).astype(np.float32))
        with_reader = [
            fitting.fit(brdf.ImageReader(place / "target.exr"), lit, model=model) for model in ("auto", "phong")
        ]
        return [fitted(result) for result in with_reader]


@case("fit/surface points")
def _points() -> Any:
    lit = ball("three")
    points = lit.surface_points()
    own = brdf.SurfacePoints.from_normals(points.normal, position=points.position, mask=points.mask)
    scene = brdf.Scene(points=own, lights=lit.lights, ambient=lit.ambient)
    return fitted(fitting.fit(picture(lit), scene, precision="float64"))


@case("fit/some pixels")
def _some_pixels() -> Any:
    lit = ball("point", wall=True)
    pixel = np.arange(0, SIZE * SIZE, 3)
    shown = picture(lit).reshape(-1, 3)[pixel][None]
    return fitted(fitting.fit(shown, brdf.some_pixels(lit, pixel, precision="float64"), precision="float64"))


@case("fit/saved, plotted")
def _saved() -> Any:
    lit = ball()
    with folder() as place:
        result = fitting.fit(picture(lit), lit, precision="float64")
        result.save(place / "out", plot=True)
        html = result._repr_html_()
        told = files(place, skip=("out/comparison.png", "out/scene.toml", "out/fit.npz"))
        return {"files": told, "plotted": (place / "out" / "comparison.png").exists(), "html": len(html) > 1000}


@case("fit/fitted picture, undetermined")
def _undetermined() -> Any:
    lit = ball("constant", ambient=[0.1, 0.1, 0.1])
    result = fitting.fit(picture(lit, MATT), lit, model="phong", precision="float64")
    free = [[one.name, one.channel] for one in result.free_parameters]
    return {"undetermined": result.undetermined, "free": free, "picture": numbers(result.fitted())} | fitted(result)


for free_name, free, start in (
    ("direction", lambda m, s: (m.k_d, m.k_s, m.n, s[0].lights[0].direction), {}),
    ("intensity", lambda m, s: (m.k_d, m.n, s[0].lights[0].intensity), {}),
    ("bfgs", lambda m, s: (m.k_a, m.k_d, m.k_s, m.n), {"solver": "bfgs"}),
    ("lm", lambda m, s: (m.k_a, m.k_d, m.k_s, m.n, s[0].lights[0].direction), {"solver": "lm"}),
):

    def _joint(free: Any = free, start: Any = start) -> Any:
        lit = ball()
        near = brdf.DirectionalLight(direction=(0.52, 0.58, 0.7), intensity=[1.0, 0.9, 0.8])
        guess = brdf.Scene(camera=lit.camera, shapes=lit.shapes, ambient=lit.ambient, lights=(near,))
        first = fitting.fit(picture(lit), guess, model="blinn-phong", precision="float64")
        result = fitting.fit_jointly(picture(lit), guess, first.material, free, **start)
        return {"material": material(result.material), "report": masked(str(result))}

    case(f"joint/{free_name}")(_joint)


def _lit(result: Any) -> Any:
    told = {key: numbers(getattr(result, key)) for key in ("emittances", "factors", "errors", "residual")}
    report = masked(str(result))
    return told | {"material": material(result.material), "undetermined": list(result.undetermined), "report": report}


@case("lights/given the material")
def _lights() -> Any:
    lit = ball("three")
    return _lit(fitting.fit_lights(picture(lit), lit, MATERIAL, precision="float64"))


@case("lights/and the material")
def _lights_too() -> Any:
    lit = ball("three")
    return _lit(fitting.fit_lights_and_material(picture(lit), lit, precision="float64"))


@case("lights/relit")
def _relit() -> Any:
    lit = ball("three")
    images = brdf.render_lights(MATERIAL, lit, precision="float64")
    one = brdf.relight(images, [1.0, 0.5, 2.0, 0.0])
    return [numbers(images), numbers(one), numbers(brdf.relight(images, np.linspace(0, 1, 12).reshape(4, 3)))]


@case("sensitivity")
def _sensitivity() -> Any:
    lit = ball("point")
    result = fitting.fit(picture(lit), lit, model="blinn-phong", precision="float64")
    told = fitting.sensitivity(result, lambda scenes: (scenes[0].lights[0].position, scenes[0].lights[0].intensity))
    return [{key: numbers(getattr(one, key)) for key in ("k_a", "k_d", "k_s", "n")} for one in told]


# -- pictures of others ------------------------------------------------------------------------------------------------


def _of_folder(place: Path, precision: str, **options: Any) -> Any:
    scene = brdf.Scene.load(place / "scene.toml")
    target = brdf.read_picture(next(place.glob("target.*")))
    return fitted(fitting.fit(target, scene, precision=precision, **options))


def _every(scene: brdf.Scene, target: np.ndarray, step: int) -> tuple[np.ndarray, brdf.Scene]:
    """One pixel of many."""
    pixel = np.arange(0, target.shape[0] * target.shape[1], step)
    return target.reshape(-1, target.shape[2])[pixel][None], brdf.some_pixels(scene, pixel)


@case("data/gold-ball", "float32")
def _gold() -> Any:
    return _of_folder(DATA / "gold-ball", "float32")


@case("data/gold-ball, float64")
def _gold64() -> Any:
    return _of_folder(DATA / "gold-ball", "float64", model="blinn-phong")


@case("data/area-light", "float32")
def _area() -> Any:
    scene = brdf.Scene.load(DATA / "area-light" / "scene.toml")
    target, scene = _every(scene, brdf.read_image(DATA / "area-light" / "target.exr"), 7)
    return fitted(fitting.fit(target, scene))


@case("data/sky", "float32")
def _sky() -> Any:
    text = (DATA / "sky" / "scene.toml").read_text().replace("samples = 1024", "samples = 64")
    with folder() as place:
        shutil.copy(DATA / "sky" / "sky.exr", place)
        (place / "scene.toml").write_text(text)
        scene = brdf.Scene.load(place / "scene.toml")
    target, scene = _every(scene, brdf.read_image(DATA / "sky" / "target.exr"), 3)
    return fitted(fitting.fit(target, scene, model="blinn-phong"))


if REAL.is_dir():
    for name in ("opengl/cyan-plastic-directional", "opengl/jade-point", "vtk/red-satin"):
        case(f"real/{name}", "float32")(lambda name=name: _of_folder(REAL / name, "float32"))
        case(f"real/{name}, float64")(lambda name=name: _of_folder(REAL / name, "float64", model="blinn-phong"))

    def _diligent(chosen: range, step: int, **options: Any) -> Any:
        with np.load(REAL / "diligent-ball" / "ball_crop_uint16.npz") as data:
            intensity, directions = data["light_intensities"][chosen], data["light_dirs"][chosen]
            codes, normal, mask = data["images"][chosen][:, ::step, ::step], data["normal"], data["mask"]
        points = brdf.SurfacePoints.from_normals(normal[::step, ::step], mask=mask[::step, ::step])
        lights = [brdf.DirectionalLight(direction=direction, intensity=[1.0]) for direction in directions]
        scenes = [brdf.Scene(points=points, lights=(light,)) for light in lights]
        targets = list((codes / 65535.0 / intensity[:, None, None, :]).astype(np.float32))
        masks = [np.all(one < 65535, axis=-1) for one in codes]
        return fitted(fitting.fit(targets, scenes, mask=masks, **options))

    case("real/diligent-ball", "float32")(lambda: _diligent(range(3, 96, 24), 2))
    case("real/diligent-ball, float64")(
        lambda: _diligent(range(3, 96, 24), 2, precision="float64", model="normalized-blinn-phong")
    )

    GRAY = ("--sphere", "244.5,144.5,108")
    PHOTOGRAPHS = REAL / "uw-spheres" / "gray"
    COMMANDS = {
        "gray, light fitted": ("fit", PHOTOGRAPHS / "gray.1.png", *GRAY, "--light", "fit"),
        "gray, ambient": ("fit", PHOTOGRAPHS / "gray.2.png", *GRAY, "--light", "0.3,0.2,0.9", "--ambient"),
        "gray, two": (
            *("fit", PHOTOGRAPHS / "gray.0.png", PHOTOGRAPHS / "gray.1.png", *GRAY),
            *("--lights", "two.txt", "--encoding", "linear", "--json"),
        ),
        "matt ball": ("lights", PHOTOGRAPHS / "gray.3.png", PHOTOGRAPHS / "gray.4.png", *GRAY, "--matt"),
        "mirror ball": (
            *("lights", REAL / "uw-spheres" / "chrome" / "chrome.1.png", "--sphere", "253.5,148,119.5"),
            *("--out", "lights.txt"),
        ),
    }
    for name, words in COMMANDS.items():

        def _photograph(words: tuple[Any, ...] = words) -> Any:
            with folder() as place:
                (place / "two.txt").write_text("0.49 0.46 0.74\n0.24 0.13 0.96\n")
                return {**command(*words), "files": files(place)}

        case(f"real/{name}", "float32")(_photograph)

    TABLES = {
        "rgl/colodur_napoli_4f_rgb.bsdf": {},
        "cornell/acryl_blue.brdf": {},
        "cornell/cayman.brdf": {"loss": "log"},
        "cornell/garnet_red.brdf": {"loss": "squared", "model": "phong"},
        "alta/retro-gray-tape.dat": {},
        "alta/pink-felt-1d.alta": {"model": "lambert"},
    }
    for name, options in TABLES.items():

        def _table(name: str = name, options: Any = options) -> Any:
            table = brdf.load_measured(REAL / name)
            told = {"repr": repr(table), "values": numbers(table.values), "channels": list(table.channels)}
            return told | {"left_out": table.left_out, "fit": measured(fitting.fit_brdf(table, **options))}

        case(f"real/{name}")(_table)
    for name in ("rgl/vch_golden_yellow_rgb.bsdf", "cornell/garnet_red.brdf", "alta/retro-gray-tape.dat"):
        case(f"check/table {name}")(lambda name=name: command("check", REAL / name))

    @case("real/merl rows")
    def _merl() -> Any:
        lines = (REAL / "merl" / "ngan2005_BlinnPhong_half.csv").read_text().splitlines()[1::7]
        told = {}
        for line in lines:
            words = line.split(",")
            values = [float(word) for word in words if re.fullmatch(r"[-+.\deE]+", word)][:7]
            if len(values) == 7:
                surface = brdf.NormalizedBlinnPhong(k_d=values[:3], k_s=values[3:6], n=abs(values[6]))
                told[words[0]] = checked(brdf.check(surface))
        return told

    @case("real/opengl table")
    def _teapots() -> Any:
        return [
            (REAL / "materials" / "opengl_teapots_materials.csv").read_text().splitlines()[:1],
            {name: checked(brdf.check(brdf.preset(name))) for name in sorted(brdf.PRESETS)[::3]},
        ]

    @case("real/mtl files")
    def _mtl_files() -> Any:
        told = {}
        for path in sorted((REAL / "materials" / "mtl").glob("*.mtl")):
            try:
                told[path.name] = {name: material(one) for name, one in brdf.load_materials(path).items()}
            except brdf.InputError as error:
                told[path.name] = masked(str(error))
        return told

    @case("real/environment maps")
    def _maps() -> Any:
        told = {}
        for path in sorted((REAL / "envmaps").glob("*.*r")):
            pixels = brdf.read_image(path)
            told[path.name] = numbers(pixels)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                light = brdf.EnvironmentMap(pixels, samples=16)
            lit = brdf.Scene(camera=ball().camera, shapes=ball().shapes, lights=(light,))
            told[path.name + " lit"] = numbers(brdf.render(MATERIAL, lit, precision="float64"))
        return told

    @case("real/aov")
    def _aov() -> Any:
        source = REAL / "aov" / "mitsuba_multi_channels.exr"
        layers = brdf.read_layers(source)
        with folder() as place:
            shutil.copy(source, place / "aovs.exr")
            (place / "scene.toml").write_text('[aov]\nfile = "aovs.exr"\nnormal = "sh_normal"\n' + LIGHT)
            scene = scene_text(brdf.Scene.load(place / "scene.toml"))
        return {"layers": {name: numbers(pixels) for name, pixels in layers.items()}, "scene": scene}

    for letter in sorted({path.name[0] for path in (REAL / "bad-images").iterdir()} - {"P"}):

        def _bad_images(letter: str = letter) -> Any:
            told = {}
            for path in sorted((REAL / "bad-images").glob(f"{letter}*")):
                told[path.name] = _read_or_refused(path)
            return told

        case(f"bad/images {letter}*")(_bad_images)


def _read_or_refused(path: Path) -> Any:
    try:
        return numbers(brdf.read_image(path))
    except brdf.InputError as error:
        return masked(str(error))


# -- checks, conversions, exports, files -------------------------------------------------------------------------------

SURFACES = {
    "lambert": brdf.Lambert(k_d=[0.5, 0.3, 0.2]),
    "lambert too bright": brdf.Lambert(k_d=[0.5, 1.3, 0.2]),
    "phong": brdf.Phong(k_d=[0.5, 0.3, 0.2], k_s=[0.3] * 3, n=20.0),
    "blinn-phong": MATERIAL,
    "normalized-phong": brdf.NormalizedPhong(k_d=[0.5, 0.3, 0.2], k_s=[0.3] * 3, n=20.0),
    "normalized-phong at the bound": brdf.NormalizedPhong(k_d=[0.5], k_s=[0.5], n=20.0),
    "normalized-blinn-phong": brdf.NormalizedBlinnPhong(k_d=[0.5, 0.3, 0.2], k_s=[0.3] * 3, n=200.0),
    "normalized-blinn-phong too bright": brdf.NormalizedBlinnPhong(k_d=0.7, k_s=0.5, n=2.0),
    "n of 0": brdf.NormalizedPhong(k_d=0.4, k_s=0.5, n=0.0),
    "n of a million": brdf.NormalizedBlinnPhong(k_d=0.4, k_s=0.5, n=1e6),
    "black": brdf.Lambert(k_d=[0.0]),
    "31 bands": brdf.Phong(k_d=np.linspace(0.1, 0.6, 31), k_s=np.full(31, 0.2), n=8.0),
}
for name, surface in SURFACES.items():
    case(f"check/{name}")(lambda surface=surface: checked(brdf.check(surface)))


def _steep(to_light: Any, to_view: Any) -> Any:
    return 0.2 + 0.1 * to_light[..., 2:] ** 2


FUNCTIONS = {
    "constant": lambda to_light, to_view: np.full((*np.shape(to_light)[:-1], 1), 0.3),
    "not reciprocal": _steep,
    "negative": lambda to_light, to_view: 0.1 - 0.2 * to_light[..., 2:] * to_view[..., 2:],
    "too bright": lambda to_light, to_view: np.full((*np.shape(to_light)[:-1], 1), 0.34),
    "not finite": lambda to_light, to_view: jnp.where(to_light[..., 2:] > 0.9, jnp.nan, 0.1),
    "scalar": lambda to_light, to_view: 0.2 * np.ones(np.shape(to_light)[:-1]),
}
for name, function in FUNCTIONS.items():
    case(f"check/function {name}")(lambda function=function: checked(brdf.check(function)))

PLAIN = {key: surface for key, surface in SURFACES.items() if key not in ("31 bands", "black")}
for to in ("json", "mtl", "three", "gltf", "mitsuba", "mitsuba-dict", "pytorch3d", "glsl"):

    def _exports(to: str = to) -> Any:
        told = {}
        for name, surface in PLAIN.items():
            export = brdf.export_material(surface, to, name=name)
            told[name] = {"text": export.text, "losses": list(export.losses)}
        return told | {"31 bands": refusal(lambda: brdf.export_material(SURFACES["31 bands"], to).text)}

    case(f"export/{to}")(_exports)


@case("export/saved")
def _saved_exports() -> Any:
    with folder() as place:
        told = {}
        for name in ("a.json", "a.mtl", "a.gltf", "a.xml", "a.glsl", "a.py"):
            told[name] = list(brdf.save_export(MATERIAL, place / name).losses)
        brdf.save_export(MATERIAL, place / "three.json", to="three", name="golden")
        return [told, files(place), refusal(lambda: brdf.save_export(MATERIAL, place / "a.xyz"))]


@case("files/materials there and back")
def _materials() -> Any:
    told = {}
    with folder() as place:
        for name, surface in SURFACES.items():
            for suffix in (".json", ".mtl"):
                path = place / (name + suffix)
                try:
                    brdf.save_material(surface, path)
                    told[path.name] = [path.read_text(), material(brdf.load_material(path))]
                except brdf.InputError as error:
                    told[path.name] = masked(str(error))
    return told


@case("files/presets")
def _presets() -> Any:
    return {name: material(brdf.preset(name)) for name in brdf.PRESETS}


@case("conversions")
def _conversions() -> Any:
    names = ("slope_from_exponent", "exponent_from_slope", "roughness_from_exponent", "exponent_from_roughness")
    told: dict[str, Any] = {}
    for name in (*names, "half_from_mirror", "mirror_from_half"):
        function = getattr(brdf, name)
        told[name] = [float(function(value)) for value in (0.05, 0.3, 1.0)]
        told[name + " refused"] = refusal(lambda function=function: function(-3.0))
    for name, surface in PLAIN.items():
        if name.startswith("lambert"):
            continue
        told["normalized " + name] = material(brdf.nearest_normalized(surface))
        told["classic " + name] = material(brdf.nearest_classic(surface))
    return told


@case("albedo")
def _albedo() -> Any:
    angles = np.radians([0.0, 30.0, 60.0, 80.0, 89.0])
    return {name: numbers(brdf.directional_albedo(one, angles, precision="float64")) for name, one in SURFACES.items()}


@case("stability map", "float32")
def _stability() -> Any:
    found = stability_map(brdf.NormalizedPhong, np.array([0.5, 50.0, 1e5]), np.array([0.0, 45.0, 89.0]))
    return [found.model, bool(np.all(found.finite)), bool(np.all(found.error < 1e-5))]


for light_name in LIGHTS:

    def _rendered(light_name: str = light_name) -> Any:
        told = {"float32": numbers(brdf.render(MATERIAL, ball(light_name), precision="float32"))}
        for model in ("phong", "normalized-blinn-phong"):
            surface = brdf.MODELS[model](k_a=0.1, k_d=[0.4, 0.3, 0.2], k_s=0.3, n=12.0)
            told[model] = numbers(brdf.render(surface, ball(light_name, wall=True), precision="float64"))
        return told

    case(f"render/{light_name}", "float32")(_rendered)


@case("render/views")
def _views() -> Any:
    perspective = brdf.PerspectiveCamera(
        position=(0.6, 0.4, 4.0), target=(0, 0, 0), up=(0, 1, 0), fov=34.0, resolution=(SIZE, 40)
    )
    shapes = [brdf.Sphere(center=(0, 0, 0), radius=1.0)]
    shapes.append(brdf.Sphere(center=(0.9, 0.9, 1.5), radius=0.3, fitted=False))
    scene = brdf.Scene(camera=perspective, shapes=shapes, lights=LIGHTS["point"]())
    shown = np.linspace(0, 1, SIZE * SIZE).reshape(SIZE, SIZE)
    masked_scene = brdf.Scene(camera=ball().camera, shapes=shapes[:1], lights=(SUN,), visibility=(shown,))
    area = ball("sphere", wall=True, samples=4)
    scenes = {"perspective": scene, "visibility": masked_scene, "area": area}
    return {name: numbers(brdf.render(MATERIAL, one, precision="float64")) for name, one in scenes.items()}


@case("render/mesh")
def _mesh() -> Any:
    with folder() as place:
        (place / "mesh.obj").write_text(OBJ)
        mesh = brdf.Triangles(brdf.load_mesh(place / "mesh.obj"))
        scene = brdf.Scene(camera=ball().camera, shapes=(mesh,), lights=(SUN,), ambient=[0.2])
        return numbers(brdf.render(MATERIAL, scene, precision="float64"))


@case("render/basis images")
def _basis() -> Any:
    told = {}
    for name, model in brdf.MODELS.items():
        images = brdf.basis_images(model, ball("three"), 20.0)
        for key in ("ambient", "diffuse", "specular"):
            image = getattr(images, key)
            told[f"{name} {key}"] = None if image is None else numbers(image)
    return told


@case("render/displayed")
def _displayed() -> Any:
    return numbers(brdf.displayed(brdf.render(MATERIAL, ball(), precision="float64")))


@case("render/scene there and back")
def _scene_file() -> Any:
    told = {}
    with folder() as place:
        (place / "mesh.obj").write_text(OBJ)
        brdf.write_image(place / "sky.exr", sky().astype(np.float32))
        for name, text in SCENES.items():
            (place / "scene.toml").write_text(text)
            told[name] = scene_text(brdf.Scene.load(place / "scene.toml"))
    return told


@case("images/there and back")
def _images() -> Any:
    shown = (0.8 * picture(ball(), noise=0.0)).astype(np.float32)
    told = {}
    with folder() as place:
        for suffix in (".exr", ".hdr", ".png", ".jpg", ".tif", ".tga", ".bmp", ".webp", ".jp2", ".xyz"):
            for how in ({}, {"dtype": "uint16"}, {"dtype": "half"}, {"encoding": "srgb"}, {"dtype": "uint8"}):
                path = place / f"a{suffix}"
                label = f"{suffix} {how}"
                try:
                    brdf.write_image(path, shown, **how)
                    read = brdf.read_picture(path)
                    told[label] = numbers(read.pixels)
                except brdf.InputError as error:
                    told[label] = masked(str(error))
        one = place / "grey.exr"
        brdf.write_image(one, shown[..., :1])
        told["grey"] = numbers(brdf.read_image(one))
        told["mask"] = numbers(brdf.read_mask(one))
        told["as gamma 2.2"] = _read_encoded(place / "a.png", "2.2")
        told["as linear"] = _read_encoded(place / "a.png", "linear")
        reader = brdf.ImageReader(place / "a.exr")
        told["bands"] = [numbers(band) for band in [reader.rows(0, 5), reader.rows(40, SIZE)]]
        for value in (np.zeros(3), [["a"]], np.zeros((0, 2, 3))):
            told[f"refused {np.shape(value)}"] = refusal(lambda value=value: brdf.write_image(one, value))
    return told


def _read_encoded(path: Path, encoding: str) -> Any:
    try:
        return numbers(brdf.read_picture(path, encoding=encoding).pixels)
    except brdf.InputError as error:
        return masked(str(error))


def _samples(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(5)
    directions = random.standard_normal((2, count, 3))
    directions[..., 2] = np.abs(directions[..., 2] + 1) + 0.05
    return tuple(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


for loss_name in ("cosine", "squared", "log"):
    for model_name in ("auto", "normalized-phong"):

        def _scattered(loss: str = loss_name, model: str = model_name) -> Any:
            light, view = _samples()
            half = light + view
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            lobe = half[:, 2:] ** 30
            noise = 0.02 * np.random.default_rng(8).standard_normal((len(light), 2))
            values = (np.array([[0.3, 0.2]]) + lobe * [[0.5, 0.8]]) / np.pi * (1 + noise)
            table = brdf.MeasuredBRDF.from_samples(light, view, values)
            return measured(fitting.fit_brdf(table, model, loss=loss))

        case(f"brdf/{model_name}, {loss_name}")(_scattered)


@case("brdf/merl table")
def _merl_table() -> Any:
    table = brdf.merl_table(lambda light, view: 0.1 + 0.2 * (light + view)[:, 2:] ** 8 / 256, name="made up")
    return [repr(table), table.left_out, numbers(table.values), measured(fitting.fit_brdf(table, "phong"))]


# -- the command -------------------------------------------------------------------------------------------------------

CAMERA = """[camera]
type = "orthographic"
position = [0.0, 0.0, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
width = 2.2
resolution = [48, 48]
"""
SPHERE = '[[shapes]]\ntype = "sphere"\ncenter = [0.0, 0.0, 0.0]\nradius = 1.0\n'
AMBIENT = "[ambient]\nintensity = [0.2, 0.25, 0.3]\n"
LIGHT = '[[lights]]\ntype = "directional"\ndirection = [0.5, 0.6, 0.7]\nintensity = [1.0, 0.9, 0.8]\n'
POINT = '[[lights]]\ntype = "point"\nposition = [1, 2, 3]\nintensity = [9.0]\nattenuation = [0, 0, 1]\n'
SCENE = CAMERA + SPHERE + AMBIENT + LIGHT
SCENES = {
    "plain": SCENE,
    "point": CAMERA + SPHERE + POINT,
    "spot": CAMERA
    + SPHERE
    + POINT.replace("point", "spot")
    + "direction = [-1, -2, -3]\ncutoff_angle = 30\nexponent = 2\n",
    "rectangle": SCENE + '[[lights]]\ntype = "rectangle"\ncenter = [1.5, 1.5, 3]\nedge_u = [0, 0.5, -0.25]\n'
    "edge_v = [0.5, 0, -0.25]\nradiance = [12.0]\nsamples = 9\n",
    "polygon": SCENE + '[[lights]]\ntype = "polygon"\nvertices = [[1, 1, 3], [1, 2, 2.5], [2, 2, 2]]\nradiance = 9\n'
    "samples = 9\n",
    "ball light": SCENE + '[[lights]]\ntype = "sphere"\ncenter = [1, 2, 3]\nradius = 0.4\nradiance = 9\nsamples = 9\n',
    "environment": SCENE + '[[lights]]\ntype = "environment"\nradiance = [0.5]\nsamples = 16\n',
    "sky": SCENE + '[[lights]]\ntype = "environment"\nfile = "sky.exr"\nsamples = 16\n',
    "mesh": SCENE + '[[shapes]]\ntype = "triangles"\nfile = "mesh.obj"\nfitted = false\n',
    "wall": SCENE + '[[shapes]]\ntype = "rectangle"\ncenter = [0, 0, -1.2]\nedge_u = [3, 0, 0]\nedge_v = [0, 3, 0]\n',
}
OBJ = "v -0.5 -0.5 1.4\nv 0.7 -0.4 1.5\nv 0.1 0.8 1.3\nv 0.9 0.9 1.0\nf 1 2 3\nf 2 4 3\n"
JSON = {"model": "blinn-phong", "k_a": [0.1], "k_d": [0.5], "k_s": [0.3], "n": 37.5}
MTL = "newmtl a\nKa 0 0 0\nKd 0.5 0.4 0.3\nKs 0.4 0.4 0.4\nNs 30\nillum 2\nnewmtl b\nKd 0.2 0.2 0.9\n"
CORNELL = "# paint\n2\n400 500\n0.2 0 0.3 0 0.5 -0.25\n0.4 0.1 1.2 0 1 2\n"


def _sound(place: Path) -> None:
    """The files that commands work on."""
    (place / "scene.toml").write_text(SCENE)
    (place / "material.json").write_text(json.dumps(JSON))
    (place / "two.mtl").write_text(MTL)
    (place / "ok.brdf").write_text(CORNELL)
    shown = picture(ball()).astype(np.float32)
    brdf.write_image(place / "target.exr", shown)
    brdf.write_image(place / "target8.png", 0.6 * shown, encoding="srgb")
    brdf.write_image(place / "small.exr", np.ones((2, 2, 3), np.float32))
    brdf.write_image(place / "two.exr", np.ones((SIZE, SIZE, 2), np.float32))
    column = np.mgrid[:SIZE, :SIZE][1]
    brdf.write_image(place / "mask.png", (column < 30)[..., None].astype(np.float32))
    (place / "empty").mkdir()
    (place / "empty.exr").mkdir()
    (place / "short.binary").write_bytes(struct.pack("<3i", 90, 90, 180) + bytes(8))
    (place / "damaged.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))


FIT = ("fit", "target.exr", "--scene", "scene.toml")
RENDER = ("render", "material.json", "--scene", "scene.toml", "-o")
RUNS: dict[str, tuple[Any, ...]] = {
    "fit": FIT,
    "fit json": (*FIT, "--json", "--precision", "float64"),
    "fit out": (*FIT, "--model", "phong", "--out", "result"),
    "fit a folder": ("fit", "."),
    "fit 8 bit": ("fit", "target8.png", "--scene", "scene.toml"),
    "fit 8 bit as linear": ("fit", "target8.png", "--scene", "scene.toml", "--encoding", "linear"),
    "fit masked": (*FIT, "--mask", "mask.png", "--saturation", "0.6", "--dark", "0.01"),
    "fit plausible": (*FIT, "--plausible"),
    "fit huber": (*FIT, "--loss", "huber", "--model", "blinn-phong"),
    "fit noise": (*FIT, "--noise", "0.001,0.002", "--exposure", "2", "--model", "blinn-phong"),
    "fit page": (*FIT, "--report", "page.html"),
    "fit a table": ("fit", "ok.brdf", "--model", "lambert"),
    "fit a ball": ("fit", "target.exr", "--sphere", "23.5,23.5,21.8", "--light", "0.5,0.6,0.7", "--ambient"),
    "fit a ball, light": ("fit", "target.exr", "--sphere", "23.5,23.5,21.8", "--light", "fit", "--out", "result"),
    "lights": ("lights", "target.exr", "--sphere", "23.5,23.5,21.8", "--matt"),
    "render": (*RENDER, "out.exr"),
    "render png": (*RENDER, "out.png"),
    "render a preset": ("render", "emerald", "--scene", "scene.toml", "-o", "out.hdr"),
    "check": ("check", "material.json"),
    "check json": ("check", "two.mtl", "--json"),
    "check a preset": ("check", "emerald"),
    "convert": ("convert", "two.mtl", "out.json", "--name", "a"),
    "convert to gltf": ("convert", "material.json", "out.gltf"),
    "convert a preset": ("convert", "emerald", "out.json", "--to", "three"),
    "no command": (),
}
for name, words in RUNS.items():

    def _run(words: tuple[Any, ...] = words) -> Any:
        with folder() as place:
            _sound(place)
            before = {str(path.relative_to(place)) for path in place.rglob("*")}
            return {**command(*words), "files": files(place, skip=tuple(before))}

    case(f"command/{name}", "float64" if "float64" in words else "float32")(_run)


# -- bad input ---------------------------------------------------------------------------------------------------------

BAD_OPTIONS: dict[str, tuple[Any, ...]] = {
    "no such material": ("render", "none.json", "--scene", "scene.toml", "-o", "o.exr"),
    "folder as scene": ("render", "material.json", "--scene", "empty", "-o", "o.exr"),
    "device as picture": ("fit", "/dev/zero", "--scene", "scene.toml"),
    "text as picture": ("fit", "scene.toml", "--scene", "scene.toml"),
    "no picture": ("fit", "none.exr", "--scene", "scene.toml"),
    "no scene": ("fit", "small.exr"),
    "empty folder": ("fit", "empty"),
    "unknown model": (*FIT, "--model", "ward"),
    "unknown precision": (*FIT, "--precision", "half"),
    "unknown encoding": (*FIT, "--encoding", "log"),
    "unknown loss": (*FIT, "--loss", "absolute"),
    "page of another kind": (*FIT, "--report", "o.pdf"),
    "nan saturation": (*FIT, "--saturation", "nan"),
    "text saturation": (*FIT, "--saturation", "much"),
    "saturation of 0": (*FIT, "--saturation", "0"),
    "accuracy of 0": (*FIT, "--accuracy", "0"),
    "bad noise": (*FIT, "--noise", "1"),
    "bad exposure": (*FIT, "--exposure", "-1"),
    "plot without out": (*FIT, "--plot"),
    "plausible phong": (*FIT, "--plausible", "--model", "phong"),
    "unknown option": (*FIT, "--speed", "1"),
    "unknown command": ("melt", "target.exr"),
    "missing argument": ("render",),
    "unknown suffix": (*RENDER, "o.xyz"),
    "out in a missing folder": (*RENDER, "no/o.exr"),
    "out is a folder": (*RENDER, "empty.exr"),
    "out is a file": (*FIT, "--out", "two.mtl"),
    "check a picture": ("check", "target.exr"),
    "check a missing table": ("check", "none.binary"),
    "damaged table": ("fit", "short.binary"),
    "table with a scene": ("fit", "short.binary", "--scene", "scene.toml"),
    "table with an unknown loss": ("fit", "ok.brdf", "--loss", "huber"),
    "plausible table": ("fit", "ok.brdf", "--plausible"),
    "mask of another size": (*FIT, "--mask", "small.exr"),
    "empty mask": (*FIT, "--mask", "none.png"),
    "picture of another size": ("fit", "small.exr", "--scene", "scene.toml"),
    "damaged picture": ("fit", "damaged.png", "--scene", "scene.toml"),
    "two channels": ("fit", "two.exr", "--scene", "scene.toml"),
    "no such preset": ("convert", "unobtainium", "o.json"),
    "name of a preset": ("convert", "emerald", "o.json", "--name", "a"),
    "several materials": ("convert", "two.mtl", "o.json"),
    "unknown name": ("convert", "two.mtl", "o.json", "--name", "c"),
    "unknown format": ("convert", "emerald", "o.json", "--to", "ward"),
    "ball beside the picture": ("fit", "target.exr", "--sphere", "90,9,5", "--light", "0,0,1"),
    "ball of two numbers": ("fit", "target.exr", "--sphere", "9,5", "--light", "0,0,1"),
    "no light": ("fit", "target.exr", "--sphere", "23,23,20"),
    "light of no length": ("fit", "target.exr", "--sphere", "23,23,20", "--light", "0,0,0"),
    "no such lights": ("fit", "target.exr", "--sphere", "23,23,20", "--lights", "none.txt"),
    "mirror ball beside": ("lights", "target.exr", "--sphere", "90,9,5"),
}
for name, words in BAD_OPTIONS.items():

    def _refused(words: tuple[Any, ...] = words) -> Any:
        with folder() as place:
            _sound(place)
            before = {str(path.relative_to(place)) for path in place.rglob("*")}
            return {**command(*words), "files": files(place, skip=tuple(before))}

    case(f"bad/option {name}", "float32")(_refused)

SPOILT = {
    "nan in position": ("[0.0, 0.0, 4.0]", "[nan, 0.0, 4.0]"),
    "zero up": ("[0.0, 1.0, 0.0]", "[0.0, 0.0, 0.0]"),
    "up along view": ("[0.0, 1.0, 0.0]", "[0.0, 0.0, 1.0]"),
    "eye at target": ("[0.0, 0.0, 4.0]", "[0.0, 0.0, 0.0]"),
    "negative width": ("width = 2.2", "width = -2.2"),
    "width is text": ("width = 2.2", 'width = "2.2"'),
    "width is true": ("width = 2.2", "width = true"),
    "no width": ("width = 2.2\n", ""),
    "no camera type": ('type = "orthographic"\n', ""),
    "unknown camera": ('"orthographic"', '"fisheye"'),
    "unknown key": ("width = 2.2", "width = 2.2\nwidht = 3"),
    "zero resolution": ("[48, 48]", "[0, 48]"),
    "huge resolution": ("[48, 48]", "[2147483647, 2147483647]"),
    "fractional resolution": ("[48, 48]", "[8.5, 8]"),
    "negative radius": ("radius = 1.0", "radius = -1.0"),
    "list radius": ("radius = 1.0", "radius = [1.0]"),
    "short center": ("center = [0.0, 0.0, 0.0]", "center = [0.0, 0.0]"),
    "ragged center": ("center = [0.0, 0.0, 0.0]", "center = [[0], 0, 0]"),
    "fitted is text": ("radius = 1.0", 'radius = 1.0\nfitted = "no"'),
    "nothing fitted": ("radius = 1.0", "radius = 1.0\nfitted = false"),
    "shapes is a table": ("[[shapes]]", "[shapes]"),
    "zero direction": ("[0.5, 0.6, 0.7]", "[0, 0, 0]"),
    "negative light": ("[1.0, 0.9, 0.8]", "[1.0, -1.0, 1.0]"),
    "empty light": ("[1.0, 0.9, 0.8]", "[]"),
    "two channels": ("[1.0, 0.9, 0.8]", "[1.0, 0.8]"),
    "unknown light": ('"directional"', '"sun"'),
    "unknown table": ("[ambient]", "[fog]"),
    "negative ambient": ("[0.2, 0.25, 0.3]", "-1"),
    "not TOML": ("[camera]", "this is none"),
    "outside": ("[camera]", '[aov]\nfile = "../../etc/passwd"\n[camera]'),
    "missing layers": ("[camera]", '[aov]\nfile = "none.exr"\n[camera]'),
    "empty": (SCENE, ""),
}
for name, (old, new) in SPOILT.items():

    def _spoilt(old: str = old, new: str = new) -> Any:
        with folder() as place:
            assert old in SCENE
            (place / "scene.toml").write_text(SCENE.replace(old, new))
            return refusal(lambda: brdf.Scene.load(place / "scene.toml"))

    case(f"bad/scene {name}")(_spoilt)

BAD_MATERIALS = {
    "nan.json": '{"model": "lambert", "k_d": [NaN]}',
    "negative.json": '{"model": "lambert", "k_d": [0.5, -0.2]}',
    "n.json": json.dumps(JSON | {"n": -1}),
    "list.json": json.dumps(JSON | {"n": [1, 2]}),
    "text.json": json.dumps(JSON | {"k_s": "white"}),
    "true.json": json.dumps(JSON | {"k_s": [True]}),
    "channels.json": json.dumps(JSON | {"k_s": [1, 1], "k_d": [1, 1, 1]}),
    "nomodel.json": '{"k_d": [0.5]}',
    "model.json": '{"model": "ward", "k_d": [0.5]}',
    "missing.json": '{"model": "phong", "k_d": [0.5]}',
    "null.json": json.dumps(JSON | {"n": None}),
    "array.json": "[1, 2]",
    "none.json": "{",
    "deep.json": "[" * 100_000,
    "empty.json": "",
    "nothing.mtl": "# nothing\n",
    "before.mtl": "Kd 1 1 1\n",
    "text.mtl": "newmtl a\nKd red\n",
    "two.mtl": "newmtl a\nKd 1 1\n",
    "negative.mtl": "newmtl a\nKd 1 -1 1\n",
    "spectral.mtl": "newmtl a\nKd spectral file.rfl\n",
    "several.mtl": "newmtl a\nKd 1 1 1\nnewmtl b\nKd 1 1 1\n",
    "bytes.mtl": "newmtl \0\nKd 1 1 1\n",
    "suffix.txt": "newmtl a\nKd 1 1 1\n",
}


@case("bad/materials")
def _bad_materials() -> Any:
    told = {}
    with folder() as place:
        for name, text in BAD_MATERIALS.items():
            (place / name).write_text(text)
            told[name] = refusal(lambda name=name: brdf.load_material(place / name))
    return told


BAD_TABLES = {
    "short.binary": b"\x5a\0\0\0\x5a\0\0\0\xb4\0\0\0" + bytes(8),
    "sizes.binary": b"\xff" * 12 + bytes(80),
    "empty.brdf": b"",
    "words.brdf": b"one two three",
    "ragged.brdf": b"2\n400 500\n0.2 0 0.3 0 0.5\n",
    "below.brdf": b"1\n400\n2.0 0 0.2 0 0.3\n",
    "header.alta": b"#DIM 3 1\n1 2 3 4\n",
    "unknown.alta": b"#DIM 3 1\n#VS 0\n#PARAM_IN STRANGE\n0.3 0.4 0.0 2.5\n",
    "no.bsdf": b"tensor_file\0\1\0\1\0\0\0",
    "junk.bsdf": b"junk" * 20,
}


@case("bad/tables")
def _bad_tables() -> Any:
    told = {}
    with folder() as place:
        for name, content in BAD_TABLES.items():
            (place / name).write_bytes(content)
            told[name] = refusal(lambda name=name: brdf.load_measured(place / name))
    return told


BAD_ARGUMENTS: dict[str, Callable[[], Any]] = {
    "target of text": lambda: fitting.fit("target.exr", ball()),
    "target of another size": lambda: fitting.fit(np.ones((4, 4, 3)), ball()),
    "target of two channels": lambda: fitting.fit(np.ones((SIZE, SIZE, 2)), ball()),
    "nothing finite": lambda: fitting.fit(np.full((SIZE, SIZE, 3), np.nan), ball()),
    "no pixel": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), mask=np.zeros((SIZE, SIZE), bool)),
    "mask of another size": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), mask=np.ones((4, 4), bool)),
    "negative weight": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), weight=-np.ones((SIZE, SIZE))),
    "two pictures, one scene": lambda: fitting.fit([np.ones((SIZE, SIZE, 3))] * 2, [ball()]),
    "unknown model": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), model="ward"),
    "unknown loss": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), loss="ward"),
    "unknown precision": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), precision="half"),
    "bounds of n": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), n_range=(3, 1)),
    "negative accuracy": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), accuracy=-1.0),
    "negative noise": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), noise=(-1.0, 0.0)),
    "plausible phong": lambda: fitting.fit(np.ones((SIZE, SIZE, 3)), ball(), model="phong", plausible=True),
    "joint solver": lambda: fitting.fit_jointly(
        np.ones((SIZE, SIZE, 3)), ball(), MATERIAL, lambda m, s: m.k_d, solver="x"
    ),
    "joint without leaves": lambda: fitting.fit_jointly(np.ones((SIZE, SIZE, 3)), ball(), MATERIAL, lambda m, s: ()),
    "lights without lights": lambda: fitting.fit_lights_and_material(
        np.ones((SIZE, SIZE, 3)), brdf.Scene(camera=ball().camera, shapes=ball().shapes, ambient=[1.0])
    ),
    "table of text": lambda: fitting.fit_brdf("table"),
    "table's loss": lambda: fitting.fit_brdf(brdf.MeasuredBRDF.from_samples(*_samples(9), np.ones(9)), loss="huber"),
    "few samples": lambda: fitting.fit_brdf(brdf.MeasuredBRDF.from_samples(*_samples(2), np.ones(2)), "phong"),
    "samples of another count": lambda: brdf.MeasuredBRDF.from_samples(*_samples(9), np.ones(8)),
    "negative k_d": lambda: brdf.Lambert(k_d=[0.5, -0.2]),
    "nan n": lambda: brdf.Phong(k_d=0.5, k_s=0.5, n=float("nan")),
    "channels": lambda: brdf.Phong(k_d=[0.5] * 3, k_s=[0.5] * 2, n=1.0),
    "no camera": lambda: brdf.Scene(shapes=(brdf.Sphere(center=(0, 0, 0), radius=1.0),)),
    "no shapes": lambda: brdf.Scene(camera=ball().camera),
    "radius": lambda: brdf.Sphere(center=(0, 0, 0), radius=-1.0),
    "flat rectangle": lambda: brdf.Rectangle(center=(0, 0, 0), edge_u=(1, 0, 0), edge_v=(2, 0, 0)),
    "spot angle": lambda: brdf.SpotLight(position=(0, 0, 1), direction=(0, 0, 1), intensity=1.0, cutoff_angle=200.0),
    "polygon of two": lambda: brdf.PolygonLight(vertices=((0, 0, 0), (1, 0, 0)), radiance=1.0),
    "crossed polygon": lambda: brdf.PolygonLight(vertices=((0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1, 0)), radiance=1.0),
    "black map": lambda: brdf.EnvironmentMap(np.zeros((4, 8, 3))),
    "flat map": lambda: brdf.EnvironmentMap(np.ones((4, 8))),
    "samples": lambda: brdf.ConstantEnvironment(radiance=1.0, samples=1),
    "material's channels": lambda: brdf.render(brdf.Lambert(k_d=[0.1] * 2), ball()),
    "relight": lambda: brdf.relight(np.ones((2, 4, 4, 3)), [1.0, 2.0, 3.0]),
    "normals": lambda: brdf.SurfacePoints.from_normals(np.ones((4, 4))),
    "preset": lambda: brdf.preset("unobtainium"),
    "export": lambda: brdf.export_material(MATERIAL, "ward"),
    "check": lambda: brdf.check(3),
    "albedo": lambda: brdf.directional_albedo(MATERIAL, 2.0),
    "precision": lambda: brdf.render(MATERIAL, ball(), precision="half"),
    "image of text": lambda: brdf.read_image(3),
    "encoding": lambda: brdf.read_picture(DATA / "gold-ball" / "target.exr", encoding="ward"),
    "mesh": lambda: brdf.load_mesh(DATA / "none.obj"),
}


@case("bad/arguments", "float32")
def _bad_arguments() -> Any:
    return {name: refusal(function) for name, function in BAD_ARGUMENTS.items()}


# -- writing and comparing ---------------------------------------------------------------------------------------------


def write(path: Path, pattern: str) -> None:
    """Run the cases and keep what they answer.

    Args:
        path: of the JSON file.
        pattern: of the names of the cases to run.
    """
    told, began = {}, time.perf_counter()
    for name, (function, precision) in CASES.items():
        if not fnmatch.fnmatch(name, pattern):
            continue
        start = time.perf_counter()
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            try:
                answer = plain(function())
            except Exception as error:
                answer = {"raised": masked(f"{type(error).__name__}: {error}")}
                sys.stderr.write(f"{name}:\n{traceback.format_exc(limit=-2)}")
        said = sorted({masked(f"{one.category.__name__}: {one.message}") for one in heard})
        told[name] = {"precision": precision, "answer": answer, "heard": said}
        sys.stdout.write(f"{time.perf_counter() - start:6.1f} s  {name}\n")
        sys.stdout.flush()
    path.write_text(json.dumps(told, indent=1))
    sys.stdout.write(f"{len(told)} cases in {time.perf_counter() - began:.0f} s\n")


def plain(value: Any) -> Any:
    """A value as JSON holds it."""
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return plain(np.asarray(value).tolist())


NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def differences(old: Any, new: Any, precision: str, where: str = "", slack: float = 0.0) -> Iterator[str]:
    """What differs, a line each.

    Args:
        old: an answer.
        new: another.
        precision: whose tolerance holds.
        where: the place in the answer.
        slack: by how much numbers may differ whatever their size.
    """
    if isinstance(old, dict) and isinstance(new, dict):
        if precision == "float32" and isinstance(old.get("error"), float) and math.isfinite(old["error"]):
            slack = old["error"] / 100
        for key in {**old, **new}:
            if key not in old or key not in new:
                yield f"{where}.{key}: {'is new' if key in new else 'is gone'}"
            else:
                yield from differences(old[key], new[key], precision, f"{where}.{key}", slack)
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield f"{where}: has {len(new)} entries, not {len(old)}: {_short(old)} -> {_short(new)}"
        for index, pair in enumerate(zip(old, new, strict=False)):
            yield from differences(*pair, precision, f"{where}[{index}]", slack)
    elif _is_number(old) and _is_number(new):
        if not _close(old, new, precision, slack):
            yield f"{where}: {old!r} -> {new!r}"
    elif isinstance(old, str) and isinstance(new, str):
        yield from _text_differences(old, new, precision, where)
    elif old != new:
        yield f"{where}: {_short(old)} -> {_short(new)}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _close(old: float, new: float, precision: str, slack: float) -> bool:
    if old == new or (old != old and new != new):
        return True
    return abs(old - new) <= max(TOLERANCES[precision] * abs(old), SMALLEST[precision], slack)


def _text_differences(old: str, new: str, precision: str, where: str) -> Iterator[str]:
    before, after = old.splitlines(), new.splitlines()
    if len(before) != len(after):
        yield f"{where}: has {len(after)} lines, not {len(before)}: {_short(old)} -> {_short(new)}"
        return
    for one, other in zip(before, after, strict=True):
        if one != other and not _same_line(one, other, precision):
            yield f"{where}: {one.strip()!r}\n{'':8}-> {other.strip()!r}"


def _same_line(old: str, new: str, precision: str) -> bool:
    """Whether the words of two lines are the same and their numbers close."""
    if NUMBER.sub("#", old).split() != NUMBER.sub("#", new).split():
        return False
    before, after = NUMBER.findall(old), NUMBER.findall(new)
    error = re.search(r"± ([-+.\de]+)", old)
    slack = float(error[1]) / 100 if error and precision == "float32" else 0.0
    return all(
        _close(float(one), float(other), precision, slack + 1.01 * max(_last_digit(one), _last_digit(other)))
        for one, other in zip(before, after, strict=True)
    )


def _last_digit(text: str) -> float:
    """What one in the last digit of a number is worth; nothing where it is a count."""
    mantissa, _, exponent = text.lower().partition("e")
    if "." not in mantissa and not exponent:
        return 0.0
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 160 else f"{text[:75]} ... {text[-75:]}"


def compare(old: Path, new: Path) -> int:
    """Print what differs between two records; 0 where nothing does.

    Args:
        old: a record.
        new: another; cases that only one of them holds are named.
    """
    before, after = json.loads(old.read_text()), json.loads(new.read_text())
    count = 0
    for name in before:
        if name not in after:
            continue
        was, now = before[name], after[name]
        found = list(differences(was["answer"], now["answer"], was["precision"]))
        found += list(differences(was["heard"], now["heard"], was["precision"], " warns"))
        if found:
            count += 1
            sys.stdout.write(f"{name}\n" + "".join(f"    {line}\n" for line in found[:40]))
            if len(found) > 40:
                sys.stdout.write(f"    and {len(found) - 40} more\n")
    missing, added = len(before.keys() - after.keys()), len(after.keys() - before.keys())
    sys.stdout.write(f"{count} of {len(before) - missing} cases differ; {missing} missing, {added} new\n")
    return int(count > 0)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    writing = commands.add_parser("write")
    writing.add_argument("path", type=Path)
    writing.add_argument("--only", default="*", metavar="PATTERN")
    comparing = commands.add_parser("compare")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "write":
        write(arguments.path.resolve(), arguments.only)
    else:
        sys.exit(compare(arguments.old, arguments.new))


if __name__ == "__main__":
    main()
