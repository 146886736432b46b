"""The front door of maps: photographs, lights and what texels see in, maps out."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

import brdf
from brdf.checks import direction_value
from brdf.errors import InputError, as_numbers
from brdf.precision import Precision, working_precision
from fitting.maps import map_inputs
from fitting.maps.input_guesses import likelier, upside_down, with_prices
from fitting.maps.map_bands import fit_bands
from fitting.maps.map_inputs import Photographs
from fitting.maps.map_residual import left_by_some, lights_apart, with_noise
from fitting.maps.map_result import Maps
from fitting.maps.photograph_levels import in_unit, with_levels
from fitting.maps.shared_exponent import label_map, with_shared_n
from fitting.maps.tiles import MapProblem, Surface
from fitting.problem import model_name
from fitting.solver.devices import spread_over

LOSSY = (
    "{} was compressed with losses, by which neighbours err together, in every photograph alike: errors may be four "
    "times too small, and a faint highlight may be the codec's"
)

MOST_APART = 1.0
"""Degrees by which directions towards a camera that is far away differ."""

NEAR = "the camera is near: maps are rendered as seen from its mean direction, which is up to {:.0f} degrees off"

COPLANAR = 1e-3
"""Singular value of the directions towards lights: in a plane the least is 0."""


def fit_maps(
    pictures: Any,
    lights: Any = None,
    normals: Any = None,
    *,
    intensities: Any = None,
    exposures: Any = None,
    ambient: Any = None,
    to_view: Any = (0.0, 0.0, 1.0),
    model: Any = "blinn-phong",
    specular: str = "coloured",
    mask: Any = None,
    saturation: Any = None,
    encoding: Any = None,
    flip_y: bool = False,
    precision: Precision = "float32",
    labels: Any = None,
    mesh: Any = None,
    keep: str | Path | None = None,
) -> Maps:
    """Fit a material to every texel of one view under many lights: the global optimum of each, with errors.

    Values that are clipped, face away from their light or lie in a cast shadow do not count. Noise is even in codes, or
    grows with brightness, as that of a camera, where some texels say so. Exponents are sought from 1 to 65,536; at an
    end n is not determined.

    Args:
        pictures: photographs of one size, (P, H, W, C) linear values or a list of arrays, `brdf.Picture`,
            `brdf.ImageReader` or files; or a folder with an ``.lp`` file, or with DiLiGenT's text files.
        lights: towards the lights, (P, 3), x right, y up, z to the camera; or directional lights; or scenes with one
            light of any kind each, whose camera and shapes, the same in all, tell what texels see, cast shadows left
            out; or a text file; or an ``.lp`` file, in which files are looked for by name. None for the folder's.
        normals: (H, W, 3), y up, codes being n·0.5 + 0.5; or a file of them (.npy, .exr, or an image); "fit" to find
            them too, under distant lights. None for the scene's or the folder's ``normals.*``, else they are found.
        intensities: of the lights, (P,) or (P, C): photographs are divided by them.
        exposures: of the photographs, (P,), likewise.
        ambient: intensity of the ambient light, a number or (C,), where there is some: k_a is found too. None for the
            scenes'.
        to_view: towards the camera, which is far away; scenes tell it themselves.
        model: "lambert", "phong", "blinn-phong" or a normalised form; "auto" for the simplest of Lambert, Phong and
            Blinn-Phong that serves each texel, by the Bayesian information criterion for few values; where the lobe of
            neither explains a texel better, that which more texels have.
        specular: "coloured", or "grey": the channels share k_s.
        mask: (H, W), or a file: texels to look at. None for the folder's ``mask.*``, else all. Those that a
            photograph has as fully transparent are left out.
        saturation: linear value of the photographs, as they are read, from which on they are clipped. None for the
            largest code of integers, and for the largest value of all where many texels share it, which a note says.
        encoding: of files and arrays: "linear", "srgb" or a gamma; None for what files say, and linear arrays. Where
            files of integers say nothing, a note says as what they were read: under distant lights as that which the
            model explains better, else those of 8 bits as sRGB, of more as linear.
        flip_y: whether y goes down in the normals.
        precision: "float32" or "float64".
        labels: (H, W) whole numbers, or a file, where each colour is one: texels with the same one share n, which then
            is known far better than each could tell; 0 for all texels. None for an n of each.
        mesh: a `jax.sharding.Mesh` of the devices to deal bands of rows out to, on one machine or, under
            `jax.distributed`, on many: each process reads and fits those of its own devices. None for all cores.
        keep: a folder for the bands that are done. A call with the same inputs goes on from there, where one was
            interrupted; processes take the bands of the others from it, so all must see it.

    Returns:
        The maps.

    Raises:
        InputError: naming the photograph or argument.

    Example:
        >>> to_light = np.array([[0, 0, 1], [0.5, 0, 1], [0, 0.5, 1], [-0.5, 0, 1], [0, -0.5, 1], [0.2, 0.2, 1]])
        >>> normals = np.broadcast_to([0.0, 0.0, 1.0], (4, 4, 3))
        >>> truth = brdf.BlinnPhong(k_d=[0.3, 0.2, 0.1], k_s=0.5, n=60)
        >>> points = brdf.SurfacePoints.from_normals(normals)
        >>> scenes = [brdf.Scene(points=points, lights=[brdf.DirectionalLight(v, 1.0)]) for v in to_light]
        >>> maps = fitting.fit_maps([brdf.render(truth, scene) for scene in scenes], to_light, normals)
        >>> round(float(maps.n[0, 0]), 2), np.round(maps.k_d[0, 0], 3)
        (60.0, array([0.3, 0.2, 0.1], dtype=float32))

    Source: variable projection, Golub and Pereyra 1973; see `fitting.maps.texels`.
    """
    if isinstance(pictures, str | Path) and Path(pictures).is_dir():
        found = map_inputs.read_folder(Path(pictures))
        pictures, lights = found["pictures"], found["lights"] if lights is None else lights
        intensities = found.get("intensities") if intensities is None else intensities
        normals = found.get("normals") if normals is None else normals
        mask = found.get("mask") if mask is None else mask
    elif isinstance(pictures, str | Path):
        raise InputError(pictures, "is no folder", "Give a folder of photographs with their lights, or a list of files")
    if specular not in ("coloured", "grey"):
        raise InputError("specular", f"must be coloured or grey, got {specular!r}", "Choose one of them")
    name = model_name(model)
    models = (brdf.Lambert, brdf.Phong, brdf.BlinnPhong) if name == "auto" else (brdf.MODELS[name],)
    given = map_inputs.photographs(pictures, lights, intensities, exposures, encoding)
    with working_precision(precision):
        surface = _surface(given, normals, mask, precision, flip_y)
    to_view, near = np.asarray(direction_value("to_view", to_view)), ()
    if surface.points is not None:
        each = np.asarray(surface.points.to_view, float)[np.asarray(surface.mask)]
        to_view = np.sum(each, axis=0)
        apart = np.degrees(np.arccos(min(1.0, np.min(each @ to_view, initial=np.inf) / np.linalg.norm(to_view))))
        near = (NEAR.format(apart),) if apart > MOST_APART else ()
    else:
        to_light = given.to_light if surface.normal is None else None
        if to_light is not None and np.linalg.svd(to_light, compute_uv=False)[2:].sum() < COPLANAR:
            what = "lie in a plane with the texel, of which normals are not found"
            raise InputError("lights", what, "Give normals, or lights from all sides")
        _refuse_behind(surface, given, to_view, str(normals) if isinstance(normals, str | Path) else "normals")
    problem = MapProblem(given, surface, models, specular == "grey", _ambient(ambient, given), to_view, precision)
    labels = None if labels is None else label_map(labels, problem)
    problem, unit, clipping = with_levels(problem, saturation)
    problem, notes = likelier(problem)
    if (left := left_by_some(problem)) is not None:
        problem = with_noise(problem, left)
        notes += lights_apart(left, [one.name for one in given.each])
    problem = with_prices(problem)
    notes += clipping + near
    if lossy := [one.name for one in given.each if one.lossy]:
        notes += (LOSSY.format(lossy[0]),)
    if guessed := [one for one in given.each if one.layer is not None]:
        notes += (f"{guessed[0].name} is read as its layer {guessed[0].layer}: it names none as the picture",)
    with spread_over(mesh):
        if labels is not None:
            problem = with_shared_n(problem, labels)
        layers = in_unit(fit_bands(problem, None if keep is None else Path(keep)), unit)
    if np.all(np.isnan(layers["k_d"])):
        raise InputError("pictures", "show no texel that counts", "Check mask, normals and clipping")
    notes += upside_down(problem, layers["residual"])
    names = tuple(one.name for one in models)
    to_view /= np.linalg.norm(to_view)
    lights = {"to_light": given.to_light, "intensity": np.mean(given.unit, axis=1)}
    return Maps(models=names, to_view=to_view, notes=notes, **lights, **layers)


def _refuse_behind(surface: Surface, given: Photographs, to_view: np.ndarray, name: str) -> None:
    """Normals, or where they are sought lights, that all lie behind what the camera can see."""
    if surface.normal is not None:
        what = "all point away from the camera"
        with np.errstate(invalid="ignore"):  # infinite where there is no surface
            toward = np.asarray(surface.normal)[surface.mask] @ to_view
    else:
        name, what = "to_view", "is 90 degrees or more from every light"
        toward = given.to_light @ to_view
    if np.any(toward < 0) and not np.any(toward > 0):
        raise InputError(name, what, "Give both in one frame, to_view from the surface to the camera")


def _ambient(ambient: Any, given: Photographs) -> np.ndarray | None:
    if ambient is None and given.ambient is None:
        return None
    values = given.ambient
    if ambient is not None:
        values = as_numbers("ambient", ambient, remedy="Give the intensity of the ambient light").reshape(-1)
        if values.size not in (1, given.size[2]) or not np.all((values > 0) & np.isfinite(values)):
            what = f"must be 1 or {given.size[2]} numbers above 0, got {ambient!r:.60}"
            raise InputError("ambient", what, "Give the intensity of the ambient light")
    columns = values * given.exposure / given.unit
    return columns[:, :1] if np.all(columns == columns[:, :1]) else columns


def _surface(given: Photographs, normals: Any, mask: Any, precision: Precision, flip_y: bool) -> Surface:
    """What the texels see."""
    height, width, _ = given.size
    name = str(mask) if isinstance(mask, str | Path) else "mask"
    if mask is None:
        mask = np.ones((height, width), bool)
    mask = brdf.read_mask(mask) if isinstance(mask, str | Path) else np.asarray(mask, bool)
    if mask.shape != (height, width):
        what = f"is of shape {mask.shape}, the photographs of {(height, width)}"
        raise InputError(name, what, "Give a value for each pixel")
    mask = mask & given.opaque()
    sought = normals is None or (isinstance(normals, str) and normals == "fit")
    if flip_y and (sought or given.scenes is not None):
        raise InputError("flip_y", "turns normals that are given", "Give them, or leave it out")
    if given.scenes is not None:
        if normals is not None:
            raise InputError("normals", "are told by the scenes", "Leave them out")
        points = brdf.cast(given.scenes[0], precision).surface_points()
        if points.mask.shape != (height, width):
            what = f"show {points.mask.shape[1]} x {points.mask.shape[0]} pixels, the photographs {width} x {height}"
            raise InputError("lights", what, "Give scenes of the photographs' size")
        shadows, known = None, [one for scene in given.scenes for one in scene.visibility or [None]]
        if any(one is not None for one in known):
            shadows = np.stack([np.ones((height, width)) if one is None else one for one in known], axis=-1)
        points = dataclasses.replace(points, mask=points.mask & mask, visibility=shadows, area=None)
        return Surface(points.normal, points.mask, points)
    if sought:
        return Surface(None, mask)
    name = str(normals) if isinstance(normals, str | Path) else "normals"
    normals = map_inputs.normal_map(normals, flip_y=flip_y)
    if normals.shape != (height, width, 3):
        what = f"are of shape {normals.shape}, the photographs of {(height, width)}"
        raise InputError(name, what, "Give a normal for each pixel")
    return Surface(normals, mask)
