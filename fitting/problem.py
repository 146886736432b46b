"""What is to be fitted: pictures, their scenes, what counts of them, and how; checked once, where it is made."""

import dataclasses
import math
import operator
import os
from collections.abc import Iterable, Mapping
from functools import cache, partial, reduce
from numbers import Real
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

import brdf
from brdf.errors import InputError
from brdf.images.encoding import Encoding, decode, decode_table, largest_step, parse_encoding
from brdf.precision import Precision
from fitting.codes import Codes, Rounding, find_codes
from fitting.sample_error import SampleError
from fitting.solver.losses import LOSSES, Loss

CLASSIC = ("phong", "blinn-phong")
PLAUSIBLE = ("normalized-phong", "normalized-blinn-phong")
# What counts as the largest value: a few units in the last place of float32 below it, for what follows clamping.
TOP = 1 - 1e-6


class Target(NamedTuple):
    """A picture as the fit takes it.

    Attributes:
        pixels: linear values (H, W, C); or a `brdf.ImageReader`, of which a band of rows is in memory at a time.
        saturation: the value of the largest code, where it is known.
        step: the distance of two codes; 0 where there are none.
        codes: behind the values; None where no rounding touched these.
        least_squares: is asked for, whatever the values are.
        file: path, encoding, its source, whether it has losses, layer and factor of the `brdf.Picture` that it was;
            None where no file holds it.
        opaque: pixels that are not fully transparent, (H, W); None for all.
    """

    pixels: Any
    saturation: float | None = None
    step: float = 0.0
    codes: Codes | None = None
    least_squares: bool = False
    file: dict[str, Any] | None = None
    opaque: np.ndarray | None = None

    @property
    def streamed(self) -> bool:
        """Whether the picture is read by bands of rows."""
        return isinstance(self.pixels, brdf.ImageReader)

    @property
    def widest_step(self) -> float:
        """Distance of two codes where it is largest: no noise is told that is less than it leaves; 0 without codes."""
        return 0.0 if self.codes is None else max(self.step, self.codes.usual_step)


@dataclasses.dataclass(frozen=True)
class FitProblem:
    """What is to be fitted.

    Attributes:
        targets: the pictures.
        scenes: what each shows.
        masks: which pixels of each may count, (H, W); None for all.
        weights: how much each pixel counts, (H, W); None for all alike.
        model: "auto" or the name of a model; the further options are those of `fitting.fit`.
        precision: "float32" or "float64".
        n_range: bounds of the exponent.
        loss: what is minimised.
        saturation: linear value from which on pixels are clipped; None finds out.
        dark: linear value up to which pixels are too dark to count; None for none.
        noise: of the camera, (read, shot); None for the same everywhere.
        plausible: hold k_d + k_s <= 1.
        shown: what results are shown under, where the scenes have other light samples; None for the scenes.
        sample_errors: by model what those leave out; None where nothing is known of it.
    """

    targets: list[Target]
    scenes: list[brdf.Scene]
    masks: list[np.ndarray | None]
    weights: list[np.ndarray | None]
    model: str = "auto"
    precision: Precision = "float32"
    n_range: tuple[float, float] = (0.1, 1e6)
    loss: Loss = "squared"
    saturation: float | None = None
    dark: float | None = None
    noise: tuple[float, float] | None = None
    plausible: bool = False
    shown: list[brdf.Scene] | None = None
    sample_errors: Mapping[str, SampleError] | None = None

    @property
    def streamed(self) -> bool:
        """Whether a picture is read by bands of rows."""
        return any(target.streamed for target in self.targets)

    @property
    def widest_step(self) -> float:
        """Largest of the pictures'."""
        return max(target.widest_step for target in self.targets)

    def sample_error(self, model: str) -> SampleError | None:
        """What the light samples leave out of a model, or of another one; None where nothing is known of it."""
        errors = self.sample_errors or {}
        return errors.get(model, next(iter(errors.values()), None))

    @property
    def families(self) -> tuple[str, ...]:
        """Models with a highlight that are compared where none is named."""
        return PLAUSIBLE if self.plausible else CLASSIC


def model_name(model: Any) -> str:
    """The name of a model that a person gives: "blinn-phong" or "BlinnPhong", or the class itself; or "auto"."""
    if isinstance(model, type) and issubclass(model, brdf.Material):
        model = model.name
    names = {_letters(name): name for name in ("auto", *brdf.MODELS)}
    name = names.get(_letters(model)) if isinstance(model, str) else None
    if name is None:
        what = repr(model) if isinstance(model, str) else f"{type(model).__name__}, no name"
        raise InputError("model", f"is unknown, got {what}", f"Use auto or one of {', '.join(brdf.MODELS)}")
    return name


def _letters(name: str) -> str:
    return "".join(filter(str.isalpha, name.lower()))


def refuse_traced(*given: Any) -> None:
    """Refuse what a transformation of JAX traces: a search over all pixels is a program of its own."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(given)):
        words = "Use fitting.sensitivity for derivatives, fitting.fit_many for batches, fitting.functional inside jax"
        raise InputError("fit", "cannot run inside jax.grad, jax.vmap or jax.jit", words)


def state_problem(
    target: Any,
    scene: Any,
    mask: Any = None,
    weight: Any = None,
    rounding: Rounding = None,
    encoding: Encoding | None = None,
    **options: Any,
) -> FitProblem:
    """Check what was given for one picture or for several.

    Args:
        target: a picture or a list of them.
        scene: a scene for all, or a list.
        mask: likewise, an array or a file; or None.
        weight: likewise.
        rounding: of the values, see `fitting.codes.find_codes`.
        encoding: of the values of a file or an array.
        options: further fields of `FitProblem`.

    Raises:
        InputError: naming what cannot be used.
    """
    options |= {"model": model_name(options["model"])} if "model" in options else {}
    several = isinstance(target, list | tuple)
    targets = list(target) if several else [target]
    if not targets:
        raise InputError("target", "is an empty list", "Give at least one picture")
    lists = []
    for name, values in (("scene", scene), ("mask", mask), ("weight", weight)):
        listed = isinstance(values, list | tuple) and (several or name == "scene")
        lists.append(list(values) if listed else [values] * len(targets))
        if len(lists[-1]) != len(targets):
            what = f"has {len(lists[-1])} entries for {len(targets)} pictures"
            raise InputError(name, what, "Give one for each")
    scenes, masks, weights = lists
    distinct = {id(one): one for one in scenes}  # of many pictures it may be one
    for each in distinct.values():
        if not isinstance(each, brdf.Scene):
            raise InputError("scene", f"must be a brdf.Scene, got {type(each).__name__}", "Use brdf.Scene.load")
    refuse_traced(targets, list(distinct.values()), mask, weight)
    sizes = {key: (one.resolution, one.channels) for key, one in distinct.items()}
    read_mask = cache(brdf.read_mask)  # of all pictures it may be one
    for index, (target, scene) in enumerate(zip(targets, scenes, strict=True)):
        try:
            targets[index] = picture = as_target(target, rounding, encoding)
            _check_picture(picture, scene, *sizes[id(scene)], options.get("noise"))
        except InputError as error:
            raise error.renamed({"target": f"target[{index}]"} if len(targets) > 1 else {}) from None
        shape = picture.pixels.shape[:2]
        mask, weight = masks[index], weights[index]
        count = [] if picture.opaque is None else [picture.opaque]
        if isinstance(mask, str | os.PathLike):
            mask = read_mask(mask)
        if mask is not None:
            count.append(_per_pixel("mask", mask, shape).astype(bool))
        if weight is not None:
            weights[index] = weight = _per_pixel("weight", weight, shape)
            if not np.all(weight >= 0) or not np.any(weight > 0):
                raise InputError("weight", "must be 0 or more, and more somewhere", "Give values of 0 or more")
            # What weighs nothing says nothing of clipping or rounding either.
            count.append(weight > 0)
        masks[index] = reduce(operator.and_, count) if count else None
    counts = {picture.pixels.shape[2] for picture in targets}
    if len(counts) > 1:
        raise InputError("target", f"pictures have {counts} channels", "Give pictures with the same number")
    if any(picture.codes is not None and picture.codes.fine for picture in targets):
        options["precision"] = "float64"
    problem = FitProblem(targets, scenes, masks, weights, **options)
    _check_options(problem)
    return problem


def as_target(given: Any, rounding: Rounding = None, encoding: Encoding | None = None) -> Target:
    """A picture as the fit takes it.

    Args:
        given: the path of a picture, an array, a `brdf.Picture`, a `brdf.ImageReader`, or what this returned.
        rounding: of the values, see `fitting.codes.find_codes`.
        encoding: of a file or an array; None for what the file says, and for linear values in an array.

    Raises:
        InputError: where it holds no values.
    """
    if isinstance(given, str | os.PathLike):
        given, encoding = brdf.read_picture(given, encoding=encoding), None
    curve = parse_encoding("encoding", encoding)
    if isinstance(given, Target | brdf.ImageReader | brdf.Picture) and curve is not None:
        raise InputError("encoding", "is that of a file or an array, this picture is decoded", "Leave it out")
    if isinstance(given, Target):
        return given
    if isinstance(given, brdf.ImageReader):
        largest, step = given.codes
        return Target(given, None if largest is None else largest * TOP, step, opaque=given.read_opaque())
    if isinstance(given, brdf.Picture):
        return _of_picture(given, rounding)
    if isinstance(given, bytes) or not hasattr(given, "__array__"):
        what = f"must be an array or the path of a picture, got {type(given).__name__}"
        raise InputError("target", what, "Read it with brdf.read_picture")
    if np.ma.is_masked(given):
        remedy = "Give its data, and mask=~np.any(target.mask, axis=-1)"
        raise InputError("target", "is a masked array, whose mask would be lost", remedy)
    return _of_array(np.asarray(given), rounding, curve or "linear")


def _of_picture(picture: brdf.Picture, rounding: Rounding, stored: np.ndarray | None = None) -> Target:
    """Of a file or an array; the codes themselves where they are at hand."""
    codes, step, top, pixels = None, 0.0, picture.saturation, picture.pixels
    curve = None if top is None else picture.encoding
    find = partial(find_codes, pixels, curve, picture.bits, unit=picture.factor, stored=stored)
    if rounding is not None or not picture.lossy or top is not None:
        codes = find(rounding)
    if codes is not None:
        # Steps that the user states are not the codes that were compressed.
        jpeg = picture.jpeg if rounding is None or isinstance(rounding, str) else None
        codes = codes._replace(lossy=picture.lossy, jpeg=jpeg)
        pixels = codes.middle(pixels)
    if top is not None:
        step = largest_step(picture.encoding, picture.bits) * float(np.max(picture.factor))
        # Fewer bits may end below the file's largest code; steps that a user states are not those of the file.
        of_file = codes if codes is not None and np.isfinite(codes.ends[1]) else find(None)
        top = TOP * min(top, np.inf if of_file is None else of_file.largest)
    least, file = rounding is not None and codes is None, None
    if picture.path is not None:
        file = {"path": str(picture.path), "encoding": picture.encoding, "source": picture.source}
        file |= {"lossy": picture.lossy, "factor": np.asarray(picture.factor).tolist(), "layer": picture.layer}
    return Target(pixels, top, step, codes, least, file, picture.opaque)


def _of_array(values: np.ndarray, rounding: Rounding, encoding: Encoding) -> Target:
    kind, bits, stored = values.dtype, 8 * values.dtype.itemsize, None
    if kind in (np.uint8, np.uint16):
        stored, values = np.atleast_3d(values), decode_table(encoding, bits).astype(np.float32)[values]
    elif kind.kind != "f":
        what = f"must hold floating-point values, or codes of 8 or 16 bits, got {kind}"
        raise InputError("target", what, "Read it with brdf.read_picture, or divide by the largest code")
    elif encoding != "linear":
        values = decode(values, encoding)
    values = values.astype(np.float32) if kind == np.float16 else values
    if values.ndim == 2:
        values = values[..., None]
    if values.ndim != 3 or 0 in values.shape:
        raise InputError("target", f"must be of shape (H, W, C), got {values.shape}", "Give one picture")
    picture = brdf.Picture(values, None, encoding, "given", bits, None if stored is None else 1.0)
    target = _of_picture(picture, rounding, stored)
    return target._replace(step=float(np.finfo(kind).eps)) if kind == np.float16 else target


def _per_pixel(name: str, values: Any, shape: tuple[int, int]) -> np.ndarray:
    values = np.asarray(values)
    if values.shape != shape:
        raise InputError(name, f"is of shape {values.shape}, the target {shape}", "Give a value per pixel")
    if values.dtype.kind not in "biuf" or not np.all(np.isfinite(values)):
        raise InputError(name, f"must hold finite numbers, got {values.dtype}", "Give a value per pixel")
    return values


def _check_picture(target: Target, scene: brdf.Scene, resolution: tuple[int, int], of_light: int, noise: Any) -> None:
    height, width, channels = target.pixels.shape
    if (width, height) != resolution:
        what = f"is {width} x {height}, the scene's camera {resolution[0]} x {resolution[1]}"
        raise InputError("target", what, "Give a picture and a camera of the same resolution")
    if of_light not in (1, channels):
        what = f"has {channels} channels, the scene's light {of_light}"
        remedy = "Give both the same number of channels; light of one serves every picture"
        raise InputError("target", what, remedy)
    if target.streamed and noise is not None:
        remedy = "Give the picture in memory, or weight in place of noise"
        raise InputError("noise", "needs the whole picture at once, the target is read by bands", remedy)
    if target.streamed and has_pixel_areas(scene):
        remedy = "Take samples out of the camera, or give the picture in memory"
        raise InputError("target", "is read by bands, where every pixel is seen at its centre", remedy)


def has_pixel_areas(scene: brdf.Scene) -> bool:
    """Whether a pixel of a scene is more than its centre."""
    if scene.camera is not None and scene.camera.samples > 1:
        return True
    return scene.points is not None and scene.points.area is not None


def check_choice(loss: str, losses: Iterable[str], n_range: tuple[float, float]) -> None:
    """Refuse what is no loss and no range of exponents."""
    if loss not in losses:
        raise InputError("loss", f"is unknown, got {loss!r}", f"Use one of {', '.join(losses)}")
    check_exponents(n_range)


def check_exponents(n_range: tuple[float, float]) -> None:
    """Refuse what is no range of exponents."""
    try:
        low, high = (float(bound) for bound in n_range)
    except (TypeError, ValueError):
        low = high = math.nan
    if not 0 < low < high < math.inf:
        raise InputError("n_range", f"must be 0 < lower < upper, got {n_range}", "Correct the bounds")


def _check_options(problem: FitProblem) -> None:
    model = problem.model
    check_choice(problem.loss, LOSSES, problem.n_range)
    if problem.plausible and model in CLASSIC:
        remedy = f"Use auto, normalized-{model}, or a normalised form of your choice"
        raise InputError("model", f"{model} is neither reciprocal nor energy conserving, so never plausible", remedy)
    for name in ("saturation", "dark"):
        value = getattr(problem, name)
        if value is not None and (isinstance(value, bool) or not isinstance(value, Real) or math.isnan(value)):
            raise InputError(name, f"must be a linear value, got {value!r}", "Give a number")
    if problem.saturation is not None and not problem.saturation > 0:
        raise InputError("saturation", f"must be above 0, got {problem.saturation}", "Give the value of clipped pixels")
    if problem.dark is not None and problem.dark < 0:
        raise InputError("dark", f"must be at least 0, got {problem.dark}", "Leave it out where no pixel is too dark")
    if problem.noise is None:
        return
    words = "Give (read, shot): the variance of a value is read² + shot · value"
    try:
        read, shot = (float(part) for part in problem.noise)
    except (TypeError, ValueError):
        raise InputError("noise", f"must be two numbers, got {problem.noise!r}", words) from None
    if not (0 <= read and read * read < math.inf and 0 <= shot < math.inf and read + shot > 0):
        what = f"must be two numbers of 0 or more, not both 0, whose squares are finite, got {problem.noise!r}"
        raise InputError("noise", what, words)
