"""Are the numbers and their errors true on the files that people have? Balls of an independent renderer, many draws.

    python -m benchmarks.truth [TABLE] [--rows PATTERN] [--draws N] [--size PIXELS] [--json FILE] [--picture FILE]

TABLE is coverage, selection, dropped, structure, diagnosis or noise.

Every ball is drawn here in plain NumPy (nothing of the toolkit), its brightest pixel at 0.97 of white; noise is a
standard deviation, of white for float pictures and in codes for files; draw i has the seed i. Files are written by
OpenImageIO and read back as a user would read them. Beside each row stands plain least squares (``rounding=0``).

* Coverage: share of all draws with the truth inside the 95 % interval; "not determined" counts as a miss. ``stated`` is
  the mean stated error over the root mean square of the real one.
* Found: ``result.surface`` has a specular term. On Lambert balls that is an invention.
* Mesh normals: drawn with normals interpolated over a latitude-longitude mesh of R rings, fitted as a sphere.
* Diagnosis: one thing is wrong, by 15 times the error that the sound picture gives it; draws in which that is no small
  change do not determine it. ``first``: the first named cause is the right one, or one of those named together.
"""

import argparse
import dataclasses
import fnmatch
import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

import brdf
import fitting
from brdf.precision import working_precision
from fitting.diagnosis import Residual

WIDTH = 2.2  # of the picture, the ball's radius being 1


@dataclass(frozen=True)
class Ball:
    """A ball under one distant light: what is drawn and what the fit is told.

    Attributes:
        model: "lambert", "phong" or "blinn-phong".
        k: k_a, k_d, k_s, (3, C).
        n: exponent.
        to_light: unit vector that is drawn.
        size: pixels on a side.
    """

    model: str
    k: np.ndarray
    n: float
    to_light: np.ndarray
    size: int

    def scene(self, to_light: np.ndarray | None = None) -> brdf.Scene:
        """What the fit is told, with this light."""
        camera = brdf.OrthographicCamera(
            position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=WIDTH, resolution=(self.size, self.size)
        )
        light = brdf.DirectionalLight(direction=self.to_light if to_light is None else to_light, intensity=[1.0])
        shapes = (brdf.Sphere(center=[0, 0, 0], radius=1),)
        return brdf.Scene(camera=camera, shapes=shapes, ambient=[1.0], lights=(light,))

    def drawn(self, normals: Callable[[np.ndarray], np.ndarray] | None = None) -> np.ndarray:
        """Linear radiance, (H, W, C); black beside the ball."""
        place = (np.arange(self.size) - (self.size - 1) / 2) * (WIDTH / self.size)
        x, y = place[None, :], -place[:, None]
        inside = x**2 + y**2 < 1
        normal = np.stack(np.broadcast_arrays(x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))), axis=-1)
        if normals is not None:
            normal = normals(normal)
        view = np.array([0.0, 0.0, 1.0])
        lit = normal @ self.to_light
        if self.model == "phong":
            cosine = 2 * lit * normal[..., 2] - self.to_light[2]
        else:
            half = self.to_light + view
            cosine = normal @ (half / np.linalg.norm(half))
        seen = (lit > 0) & (cosine > 0) & (normal[..., 2] > 0)
        lobe = np.where(seen, np.maximum(cosine, 1e-300) ** self.n, 0.0)
        shown = self.k[0] + np.maximum(lit, 0)[..., None] * self.k[1] + lobe[..., None] * self.k[2]
        return np.where(inside[..., None], shown, 0.0)


def ball(
    seed: int, *, model: str = "", channels: int = 1, size: int = 128, k_s: float | None = None, ambient: bool = True
) -> Ball:
    """The ball of a seed, brightest pixel 0.97; ``k_s`` as a share of white where it is given."""
    random = np.random.default_rng(seed)
    model = model or ("phong", "blinn-phong")[seed % 2]
    tilt, turn = random.uniform(0.15, 0.85), random.uniform(0, 2 * np.pi)
    to_light = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    n = float(np.exp(random.uniform(np.log(5), np.log(300))))
    k = np.stack(
        [random.uniform(0.02, 0.1, channels), random.uniform(0.3, 0.7, channels), random.uniform(0.1, 0.5, channels)]
    )
    if model == "lambert":
        k[2] = 0
    if not ambient:
        k[0] = 0
    if k_s is not None:
        k[2] = 0
    drawn = Ball(model, k, n, to_light, size)
    k = k * ((0.97 - (k_s or 0.0)) / drawn.drawn().max())
    if k_s is not None:
        k[2] = k_s
    return Ball(model, k, n, to_light, size)


def meshed(rings: int) -> Callable[[np.ndarray], np.ndarray]:
    """Normals of a latitude-longitude mesh of the ball, interpolated in its quadrilaterals; poles up and down."""

    def interpolated(normal: np.ndarray) -> np.ndarray:
        polar = np.arccos(np.clip(normal[..., 1], -1, 1)) * rings / np.pi
        around = np.arctan2(normal[..., 0], normal[..., 2]) * rings / np.pi
        row, column = np.floor(polar), np.floor(around)
        mixed = np.zeros_like(normal)
        for up in (0, 1):
            for along in (0, 1):
                theta, phi = (row + up) * np.pi / rings, (column + along) * np.pi / rings
                corner = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1)
                share = (polar - row if up else 1 - polar + row) * (around - column if along else 1 - around + column)
                mixed += share[..., None] * corner
        return mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)

    return interpolated


def encoded(linear: np.ndarray, curve: str) -> np.ndarray:
    """IEC 61966-2-1, or as it is."""
    if curve == "linear":
        return linear
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class File:
    """How a picture is kept.

    Attributes:
        noise: standard deviation: of white without codes, else in codes of the file.
        curve: "linear" or "srgb".
        top: largest code; 0 for floats.
        suffix: of the file, "" where an array is handed over.
        kind: OpenImageIO's data type.
        step: so many codes of the file are one step of the picture: 16 for 12 bits in 16.
        quality: of a JPEG.
        channels: of the ball.
        as_rgb: grey saved as RGB.
        light_noise: standard deviation, of white, of noise that comes before the encoding.
        shot: variance of that noise over the value: it grows as a camera's.
    """

    noise: float = 0.0
    curve: str = "linear"
    top: int = 255
    suffix: str = ".png"
    kind: str = "uint8"
    step: int = 1
    quality: int = 0
    channels: int = 1
    as_rgb: bool = False
    light_noise: float = 0.0
    shot: float = 0.0

    def picture(self, linear: np.ndarray, seed: int, folder: Path) -> Any:
        """What the fit is given: a `brdf.Picture` read back from a file, or an array."""
        random = np.random.default_rng([seed, 1])
        if not self.top:
            shown = linear + self.noise * random.standard_normal(linear.shape)
            if not self.suffix:
                return shown.astype(np.float32)
            codes = shown.astype(np.float32)
        else:
            white = np.iinfo(self.kind).max / self.step
            if self.light_noise:
                spread = np.sqrt(self.light_noise**2 + self.shot * np.maximum(linear, 0))
                linear = linear + spread * random.standard_normal(linear.shape)
            codes = encoded(linear, self.curve) * white + self.noise * random.standard_normal(linear.shape)
            codes = (np.clip(np.rint(codes), 0, self.top) * self.step).astype(self.kind)
        if self.as_rgb:
            codes = np.repeat(codes, 3, axis=2)
        path = folder / f"ball{self.suffix}"
        spec = oiio.ImageSpec(codes.shape[1], codes.shape[0], codes.shape[2], self.kind)
        spec["CompressionQuality"] = self.quality or 100
        if self.quality:
            spec["compression"] = f"jpeg:{self.quality}"
        file = oiio.ImageOutput.create(str(path))
        file.open(str(path), spec)
        file.write_image(np.ascontiguousarray(codes))
        file.close()
        return brdf.read_picture(path, encoding=self.curve if self.top else None)


FLOAT = File(0.01, top=0, suffix="", kind="float")
CAMERA = {"light_noise": 0.002, "shot": 0.001}
COVERAGE = {
    "float, noise 0.01": FLOAT,
    "linear 8 bit": File(),
    "sRGB 8 bit": File(curve="srgb"),
    "sRGB 8 bit, colour": File(curve="srgb", channels=3),
    "grey as RGB": File(curve="srgb", as_rgb=True),
    "linear 8 bit, noise 0.2": File(0.2),
    "linear 8 bit, noise 1": File(1.0),
    "linear 8 bit, noise 3": File(3.0),
    "sRGB 8 bit, noise 0.2": File(0.2, curve="srgb"),
    "sRGB 8 bit, noise 1": File(1.0, curve="srgb"),
    "sRGB 8 bit, noise 3": File(3.0, curve="srgb"),
    "sRGB 8 bit, colour, noise 1": File(1.0, curve="srgb", channels=3),
    "sRGB 8 bit, light noise 0.0005": File(curve="srgb", light_noise=0.0005),
    "sRGB 8 bit, light noise 0.01": File(curve="srgb", light_noise=0.01),
    "linear 8 bit, camera": File(**CAMERA),
    "sRGB 8 bit, camera": File(curve="srgb", **CAMERA),
    "sRGB 8 bit, colour, camera": File(curve="srgb", channels=3, **CAMERA),
    "12 in 16 bit": File(top=4095, kind="uint16", step=16),
    "12 in 16 bit, noise 1": File(1.0, top=4095, kind="uint16", step=16),
    "linear 16 bit": File(top=65535, kind="uint16"),
    "sRGB 16 bit": File(top=65535, kind="uint16", curve="srgb"),
    "half": File(top=0, suffix=".exr", kind="half"),
    "RGBE": File(top=0, suffix=".hdr", kind="float", channels=3),
    "JPEG q95, noise 1": File(1.0, curve="srgb", suffix=".jpg", quality=95),
    "JPEG q90, noise 1": File(1.0, curve="srgb", suffix=".jpg", quality=90),
    "JPEG q75, noise 1": File(1.0, curve="srgb", suffix=".jpg", quality=75),
    "JPEG q95": File(curve="srgb", suffix=".jpg", quality=95),
    "JPEG q90": File(curve="srgb", suffix=".jpg", quality=90),
    "JPEG q75": File(curve="srgb", suffix=".jpg", quality=75),
    "colour JPEG q90": File(curve="srgb", suffix=".jpg", quality=90, channels=3),
    "colour JPEG q90, noise 1": File(1.0, curve="srgb", suffix=".jpg", quality=90, channels=3),
    "colour JPEG q75": File(curve="srgb", suffix=".jpg", quality=75, channels=3),
    "colour JPEG q75, noise 1": File(1.0, curve="srgb", suffix=".jpg", quality=75, channels=3),
}
LAMBERT = {
    "linear": File(),
    "sRGB": File(curve="srgb"),
    "sRGB, no ambient": File(curve="srgb"),
    "linear, no ambient": File(),
    "colour": File(curve="srgb", channels=3),
    "dithered": File(0.5, curve="srgb"),
    "linear, camera": File(**CAMERA),
    "sRGB, camera": File(curve="srgb", **CAMERA),
    "colour JPEG q90": File(curve="srgb", suffix=".jpg", quality=90, channels=3),
    "colour JPEG q90, noise 1": File(1.0, curve="srgb", suffix=".jpg", quality=90, channels=3),
    "mesh of 24 rings": File(curve="srgb"),
    "mesh of 48 rings": File(curve="srgb"),
    "mesh of 96 rings": File(curve="srgb"),
}


def rows(table: dict[str, File], pattern: str) -> Iterator[tuple[str, File]]:
    """Those whose name fits."""
    return ((name, file) for name, file in table.items() if fnmatch.fnmatch(name, f"*{pattern}*"))


def coverage(pattern: str, draws: int, size: int, first: int) -> list[dict[str, Any]]:
    """Errors of each number, and how often its interval holds the truth."""
    said = []
    head = f"{'':30}{'covered (%)':>24}{'rms error of k_a, k_d, k_s, ln n':>40}{'stated / real':>24}"
    print(head, flush=True)
    for name, file in rows(COVERAGE, pattern):
        for method, options in (("", {}), ("  least squares", {"rounding": 0})):
            inside, wrong, stated = [], [], []
            for seed in range(first, first + draws):
                one = ball(seed, channels=file.channels, size=size)
                with tempfile.TemporaryDirectory() as folder:
                    picture = file.picture(one.drawn(), seed, Path(folder))
                result = fitting.fit(picture, one.scene(), model=one.model, **options)
                kept = {"k_a": [], "k_d": [], "k_s": [], "n": []}
                for parameter in result.parameters:
                    index = {"k_a": 0, "k_d": 1, "k_s": 2, "n": 3}[parameter.name]
                    channel = min(parameter.channel or 0, one.k.shape[1] - 1)
                    true = one.n if index == 3 else one.k[index, channel]
                    low, high = parameter.interval or (np.nan, np.nan)
                    if parameter.value is None or not parameter.error:
                        kept[parameter.name].append((False, np.nan, np.nan))
                    else:
                        unit = true if index == 3 else 1.0
                        kept[parameter.name].append(
                            (low <= true <= high, (parameter.value - true) / unit, parameter.error / unit)
                        )
                table = np.array([np.mean(kept[key], axis=0) for key in kept])
                inside.append([np.mean([row[0] for row in kept[key]]) for key in kept])
                wrong.append(np.array([np.sqrt(np.mean(np.square([row[1] for row in kept[key]]))) for key in kept]))
                stated.append(table[:, 2])
            share, rms = 100 * np.mean(inside, axis=0), np.sqrt(np.nanmean(np.square(wrong), axis=0))
            ratio = np.nanmean(stated, axis=0) / rms
            print(
                f"{name + method:30.30}{''.join(f'{v:6.1f}' for v in share)}{''.join(f'{v:10.1e}' for v in rms)}"
                f"{''.join(f'{v:6.2f}' for v in ratio)}",
                flush=True,
            )
            said.append(
                {"row": name + method, "covered": share.tolist(), "rms": rms.tolist(), "stated": ratio.tolist()}
            )
    return said


def selection(pattern: str, draws: int, size: int, first: int) -> list[dict[str, Any]]:
    """Highlights invented on Lambert balls, and found where k_s is 0.01."""
    said = []
    print(f"{'':30}{'invented (%)':>14}{'k_s = 0.01 found (%)':>22}", flush=True)
    for name, file in rows(LAMBERT, pattern):
        ambient = "no ambient" not in name
        normals = meshed(int(name.split()[2])) if name.startswith("mesh") else None
        counts = {0.0: 0, 0.01: 0}
        for k_s in counts:
            for seed in range(first, first + draws):
                model = "lambert" if k_s == 0 else ""
                one = ball(seed, model=model, channels=file.channels, size=size, k_s=k_s or None, ambient=ambient)
                with tempfile.TemporaryDirectory() as folder:
                    picture = file.picture(one.drawn(normals), seed, Path(folder))
                counts[k_s] += "phong" in fitting.fit(picture, one.scene()).surface
        shares = [100 * count / draws for count in counts.values()]
        print(f"{name:30}{shares[0]:14.1f}{shares[1]:22.1f}", flush=True)
        said.append({"row": name, "invented": shares[0], "found": shares[1]})
    return said


JUST_FOUND = {"float, noise 0.01": (0.01, "linear"), "linear 8 bit, noise 1": (1 / 255, "linear")}
JUST_FOUND |= {"sRGB 8 bit, noise 1": (1 / 255, "srgb"), "sRGB 8 bit, noise 3": (3 / 255, "srgb")}
THRESHOLD = 4.3  # in standard errors of k_s: of so large highlights about half are found


def just_found(seed: int, size: int, noise: float, curve: str) -> float:
    """A k_s that is found in about half of the draws of its noise."""
    matt, alone = ball(seed, size=size, k_s=1e-9), ball(seed, size=size, k_s=1e-9)
    alone = dataclasses.replace(alone, k=np.array([[0.0], [0.0], [1.0]]))
    lit = dataclasses.replace(alone, k=np.array([[0.0], [1.0], [0.0]]))
    shown = matt.drawn().ravel()
    columns = np.stack([np.ones(shown.size), lit.drawn().ravel(), alone.drawn().ravel()])[:, shown > 0]
    slope = np.gradient(encoded(np.linspace(0, 1, 1001), curve), 1e-3)
    weight = np.interp(shown[shown > 0], np.linspace(0, 1, 1001), slope) ** 2
    return THRESHOLD * noise * float(np.sqrt(np.linalg.inv((columns * weight) @ columns.T)[2, 2]))


def dropped(pattern: str, draws: int, size: int, first: int) -> list[dict[str, Any]]:
    """Coverage of what stays where a highlight was dropped that is about as large as one just found."""
    said = []
    print(f"{'':30}{'dropped (%)':>14}{'covered: k_a, k_d (%)':>24}{'stated / real':>16}", flush=True)
    for name, file in rows({name: COVERAGE[name] for name in JUST_FOUND}, pattern):
        found = []
        for seed in range(first, first + draws):
            one = ball(seed, size=size, k_s=just_found(seed, size, *JUST_FOUND[name]))
            with tempfile.TemporaryDirectory() as folder:
                picture = file.picture(one.drawn(), seed, Path(folder))
            result = fitting.fit(picture, one.scene())
            if "phong" not in result.surface:
                pair = result["k_a"][0], result["k_d"][0]
                true = one.k[:2, 0]
                inside = [p.interval[0] <= value <= p.interval[1] for p, value in zip(pair, true, strict=True)]
                off = [p.value - value for p, value in zip(pair, true, strict=True)]
                found.append([inside, off, [p.error for p in pair]])
        inside, off, error = np.array(found).transpose(1, 0, 2)
        covered, ratio = 100 * inside.mean(axis=0), error.mean(axis=0) / np.sqrt(np.mean(off**2, axis=0))
        share = 100 * len(found) / draws
        words = f"{covered[0]:16.1f}{covered[1]:8.1f}{ratio[0]:10.2f}{ratio[1]:6.2f}"
        print(f"{name:30}{share:14.1f}{words}", flush=True)
        said.append({"row": name, "dropped": share, "covered": covered.tolist(), "stated": ratio.tolist()})
    return said


def structure(pattern: str, draws: int, size: int, first: int) -> list[dict[str, Any]]:
    """How often a light that is off is warned of, and nothing wrong."""
    said = []
    print(f"{'':30}{'warned (%)':>12}", flush=True)
    for degrees, noise in ((1.0, 0.01), (1.0, 0.02), (0.3, 0.01), (0.0, 0.01), (0.0, 0.02)):
        name = f"light {degrees:g} degrees off, noise {noise:g}"
        if not fnmatch.fnmatch(name, f"*{pattern}*"):
            continue
        warned = 0
        for seed in range(first, first + draws):
            one = ball(seed, size=size)
            random = np.random.default_rng([seed, 2])
            aside = np.cross(one.to_light, random.standard_normal(3))
            aside /= np.linalg.norm(aside)
            told = np.cos(np.radians(degrees)) * one.to_light + np.sin(np.radians(degrees)) * aside
            picture = File(noise, top=0, suffix="", kind="float").picture(one.drawn(), seed, Path())
            result = fitting.fit(picture, one.scene(told), model=one.model)
            warned += any("structure" in words for words in result.warnings)
        print(f"{name:42}{100 * warned / draws:6.1f}", flush=True)
        said.append({"row": name, "warned": 100 * warned / draws})
    return said


LINEAR = {"light": 10.0, "intensity": 30.0, "ball": 1.5, "radius": 1.5, "gamma": 30.0, "black": 10.0}
TIMES = 15.0


def scenes_of(kind: str, seed: int, size: int) -> tuple[Ball, np.ndarray, brdf.Scene]:
    """A ball on which such a cause can be seen, what it shows, and what is true of it."""
    one = ball(seed, size=size, ambient=kind != "black")
    shown, scene = one.drawn(), one.scene()
    if kind == "black":
        scene = dataclasses.replace(scene, ambient=None)
    if kind == "intensity":
        beside = dataclasses.replace(one, to_light=one.to_light * [-1, -1, 1], k=one.k * [[0], [0.5], [0.5]])
        light = brdf.DirectionalLight(direction=beside.to_light, intensity=[0.5])
        shown, scene = shown + beside.drawn(), dataclasses.replace(scene, lights=(*scene.lights, light))
        factor = 0.97 / shown.max()
        one, shown = dataclasses.replace(one, k=one.k * factor), shown * factor
    return one, shown, scene


def made_wrong(
    kind: str, shown: np.ndarray, scene: brdf.Scene, size: float, seed: int
) -> tuple[np.ndarray, brdf.Scene]:
    """Picture and scene with one thing wrong, by so many degrees, pixels or per cent."""
    random = np.random.default_rng([seed, 2])
    pixel = WIDTH / scene.resolution[0]
    lights, sphere = list(scene.lights), scene.shapes[0]
    if kind == "light":
        to_light = np.asarray(lights[0].direction)
        aside = np.cross(to_light, random.standard_normal(3))
        aside /= np.linalg.norm(aside)
        told = np.cos(np.radians(size)) * to_light + np.sin(np.radians(size)) * aside
        lights[0] = dataclasses.replace(lights[0], direction=told)
    if kind == "intensity":
        lights[1] = dataclasses.replace(lights[1], intensity=np.asarray(lights[1].intensity) * (1 + size / 100))
    if kind == "ball":
        angle = random.uniform(0, 2 * np.pi)
        sphere = dataclasses.replace(sphere, center=size * pixel * np.array([np.cos(angle), np.sin(angle), 0]))
    if kind == "radius":
        sphere = dataclasses.replace(sphere, radius=1 + random.choice([-1, 1]) * size * pixel)
    if kind == "gamma":
        shown = shown ** (1 + size / 100)
    if kind == "black":
        shown = shown + size / 100
    if kind.startswith("mirrored"):
        shown = np.flip(shown, 1 if "left" in kind else 0)
    return shown, dataclasses.replace(scene, lights=tuple(lights), shapes=(sphere,))


def diagnosis(pattern: str, draws: int, size: int, first: int) -> list[dict[str, Any]]:
    """How often what is wrong is named."""
    said = []
    files = {"float": FLOAT, "sRGB 8 bit": File(1.0, curve="srgb"), "sRGB 8 bit, no noise": File(curve="srgb")}
    kinds = ("sound", *LINEAR, "mirrored left-right", "mirrored upside down")
    print(f"{'':42}{'draws':>7}{'named':>7}{'first':>7}{'size / true':>13}{'within 2 sigma':>16}", flush=True)
    for name, file, kind in ((f"{name}: {kind}", file, kind) for name, file in files.items() for kind in kinds):
        if not fnmatch.fnmatch(name, f"*{pattern}*"):
            continue
        found = []
        for seed in range(first, first + draws):
            one, shown, scene = scenes_of(kind, seed, size)
            wrong = 0.0
            if kind in LINEAR:
                sound = _fitted(file, shown, scene, one.model, seed)
                errors = _errors_of_causes(sound, kind)
                wrong = TIMES * max(errors, default=np.inf)
                if wrong > LINEAR[kind]:
                    continue
            elif kind != "sound":
                # It moves the light, by that much; less than so many errors of the light are not seen.
                axis = 0 if "left" in kind else 1
                moved = 2 * np.degrees(np.arcsin(abs(one.to_light[axis])))
                sound = _fitted(file, shown, scene, one.model, seed)
                if moved < TIMES * _errors_of_causes(sound, "light")[0]:
                    continue
            shown, told = made_wrong(kind, shown, scene, wrong, seed)
            causes = _fitted(file, shown, told, one.model, seed).diagnosis
            names = (
                [word.removesuffix(" 0").removesuffix(" 1") for word in causes[0].name.split(" or ")] if causes else []
            )
            right = next((cause for cause in causes if cause.name.split()[0] == kind), None)
            ratio, inside = (np.nan, np.nan)
            if right is not None:
                off = abs(abs(causes[0].size) - wrong)
                ratio, inside = abs(causes[0].size) / wrong, off < 2 * causes[0].error
            found.append((bool(causes), kind in names, ratio, inside))
            if kind != "sound" and kind not in names:
                print(
                    "   ",
                    seed,
                    wrong,
                    [(c.name, round(c.size, 3), round(c.error, 3), round(c.share, 2)) for c in causes],
                )
        table = np.array(found, float).reshape(-1, 4)
        row = [
            100 * table[:, 0].mean(),
            100 * table[:, 1].mean(),
            np.nanmean(table[:, 2]),
            100 * np.nanmean(table[:, 3]),
        ]
        print(f"{name:42}{len(table):7d}{row[0]:7.1f}{row[1]:7.1f}{row[2]:13.3f}{row[3]:16.1f}", flush=True)
        said.append({"row": name, "draws": len(table), "named": row[0], "first": row[1]})
    return said


def against_noise(pattern: str, draws: int, size: int, first: int) -> list[dict[str, Any]]:
    """Errors of sRGB files of 8 bits over the noise before rounding."""
    said = []
    print(f"{'noise in codes':16}{'rms of k_d':>24}{'of ln n':>24}   (likelihood, least squares)", flush=True)
    for noise in (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 2.0):
        wrong = []
        for seed in range(first, first + draws):
            one = ball(seed, size=size)
            with tempfile.TemporaryDirectory() as folder:
                picture = File(noise, curve="srgb").picture(one.drawn(), seed, Path(folder))
            pair = [fitting.fit(picture, one.scene(), model=one.model, **way) for way in ({}, {"rounding": 0})]
            wrong.append([[one.k[1, 0] - fit.material.k_d[0], np.log(fit.material.n / one.n)] for fit in pair])
        rms = np.sqrt(np.mean(np.square(wrong), axis=0))
        print(f"{noise:<16g}{''.join(f'{value:12.1e}' for value in rms.T.ravel())}", flush=True)
        said.append({"noise": noise, "k_d": rms[:, 0].tolist(), "n": rms[:, 1].tolist()})
    return said


def drawn(said: list[dict[str, Any]], path: Path) -> None:
    """The picture of errors over noise."""
    from matplotlib.figure import Figure  # late: the tables need none

    figure = Figure(figsize=(7.2, 2.9), layout="constrained")
    for axes, name, label in zip(
        figure.subplots(1, 2), ("k_d", "n"), ("error of $k_d$", "error of $\\ln n$"), strict=True
    ):
        # No noise has a place of its own.
        noise = [max(row["noise"], 0.008) for row in said]
        for way, marker, colour, words in ((1, "s", "#777777", "least squares"), (0, "o", "#D55E00", "likelihood")):
            axes.loglog(noise, [row[name][way] for row in said], marker=marker, color=colour, label=words, markersize=4)
        ticks = {0.008: "none", 0.02: "0.02", 0.1: "0.1", 0.5: "0.5", 2.0: "2"}
        axes.set_xticks(list(ticks), list(ticks.values()))
        axes.minorticks_off()
        axes.set(xlabel="noise before rounding, in codes", ylabel=label)
        axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


def _errors_of_causes(result: fitting.FitResult, kind: str) -> list[float]:
    """Of all small changes of a kind that the scene determines, whatever they explain."""
    with working_precision("float64"):
        causes = [test.cause for test in Residual(result).tests()]
    return [cause.error for cause in causes if cause.name.split()[0] == kind]


def _fitted(file: File, shown: np.ndarray, scene: brdf.Scene, model: str, seed: int) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        return fitting.fit(file.picture(shown, seed, Path(folder)), scene, model=model)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    tables = {"coverage": (coverage, 400), "selection": (selection, 100), "structure": (structure, 100)}
    tables |= {"dropped": (dropped, 400), "diagnosis": (diagnosis, 30), "noise": (against_noise, 40)}
    parser.add_argument("table", nargs="?", choices=tables)
    parser.add_argument("--rows", default="")
    parser.add_argument("--draws", type=int)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path, help="of the errors over noise")
    options = parser.parse_args()
    said = {}
    for name, (run, draws) in tables.items():
        if options.table in (None, name):
            said[name] = run(options.rows, options.draws or draws, options.size, options.first)
    if options.picture and "noise" in said:
        drawn(said["noise"], options.picture)
    if options.json:
        options.json.write_text(json.dumps(said, indent=1) + "\n")


if __name__ == "__main__":
    main()
