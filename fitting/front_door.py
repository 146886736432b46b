"""The front door: from pictures and scenes to a material, its errors, and what they cannot tell."""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.sharding import Mesh

import brdf
from brdf.errors import InputError
from brdf.images.encoding import Encoding
from brdf.precision import Precision
from fitting.budget.escalation import fit_within
from fitting.budget.light_samples import with_enough_samples
from fitting.codes import Rounding
from fitting.core import fit_pictures
from fitting.pixels import in_memory
from fitting.problem import state_problem
from fitting.progress import waiting
from fitting.report import FitResult
from fitting.solver.devices import spread_over
from fitting.solver.losses import Loss


def fit(
    target: Any,
    scene: brdf.Scene | Sequence[brdf.Scene],
    *,
    model: str | type[brdf.Material] = "auto",
    precision: Precision = "float32",
    mask: Any = None,
    saturation: float | None = None,
    n_range: tuple[float, float] = (0.1, 1e6),
    loss: Loss = "squared",
    dark: float | None = None,
    noise: tuple[float, float] | None = None,
    weight: Any = None,
    rounding: Rounding = None,
    encoding: Encoding | None = None,
    plausible: bool = False,
    accuracy: float | None = None,
    seconds: float | None = None,
    mesh: Mesh | None = None,
) -> FitResult:
    """Fit a material to a picture, or to several pictures of one material: the global optimum, with no start to give.

    Args:
        target: the path of a picture, a `brdf.Picture`, or an array (H, W, C) or (H, W): linear values, or codes of
            8 or 16 bits; a `brdf.ImageReader` for a file that is larger than memory, which is read by bands of rows,
            several times, and fitted by least squares, or where codes are coarser than the noise or were compressed
            with losses to every so many rows and columns, up to 1024 each; or a list.
        scene: what the picture shows; a list of as many where there are several pictures.
        model: "auto" for the simplest adequate of Lambert, Phong and Blinn-Phong, or a model: its class or its
            name.
        precision: "float32" or "float64".
        mask: (H, W), or a file as for `brdf.read_mask`: pixels to look at; a list where there are several pictures.
            Pixels that a picture has as fully transparent do not count.
        saturation: linear value from which on pixels are clipped: all that they say is that they were no darker. None
            takes the largest code of an integer file, or the largest value where many pixels share it exactly.
        n_range: bounds of the exponent, 0 < lower < upper.
        loss: "squared"; "relative" or "log" for high dynamic range; "huber" or "cauchy" where some pixels show what the
            scene does not know. See `fitting.solver.losses` for what to use when.
        dark: linear value up to which pixels are too dark to count. By the value itself: where noise is large that
            leaves out what noise made darker, and ``noise`` is the better way.
        noise: of the camera, (read, shot): the variance of a value before it is rounded is read² + shot · value, and
            values weigh by its inverse. None weighs all alike, or where values are rounded, clipped or cut off by what
            the residual tells of it.
        weight: (H, W), how much each pixel counts beside that, at least 0; a list where there are several pictures.
            Inverse variances or not, as of a soft mask or a region of interest: errors are those of the noise.
        rounding: the full step between neighbouring values of the picture, in its linear unit, a number or per value;
            0 for plain least squares; "floor" where the writer truncated. None finds out, see `fitting.codes`.
        encoding: "linear", "srgb" or a gamma: how a file or an array holds its values. None for what the file says; an
            array is linear.
        plausible: hold k_d + k_s <= 1 inside the fit, with a normalised form or Lambert, so that `brdf.check` passes;
            see `fitting.plausible`.
        accuracy: relative error that is good enough: the cheapest number of pixels and light samples and the cheapest
            precision that keep it are chosen, see `fitting.budget.escalation`; the result's ``choice`` says which and
            why. None looks at all pixels under the lights as they are.
        seconds: the same for the time to spend; what it buys is the most accurate fit. The first attempt is always
            made, and a number of pixels that is fitted for the first time may take some seconds more to compile.
        mesh: of the devices to spread the pixels over, on one machine or, under `jax.distributed`, on many: each
            process calls this with the same arguments and has the same result. A file is read by bands of rows, of
            which every pass takes those of its own devices. None takes the one device that JAX does.

    Returns:
        The result.

    Raises:
        InputError: naming the argument, where it cannot be used.

    Example:
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> result = fitting.fit(target, scene, model="blinn-phong")
        >>> round(float(result.material.n), 2)
        51.2

    Source: Golub and Pereyra 1973, variable projection; see `fitting.solver.profile`.
    """
    problem = state_problem(
        target,
        scene,
        mask,
        weight,
        rounding,
        encoding,
        model=model,
        precision=precision,
        n_range=n_range,
        loss=loss,
        saturation=saturation,
        dark=dark,
        noise=noise,
        plausible=plausible,
    )
    if accuracy is None and seconds is None:
        with waiting("fitting"):
            start = time.perf_counter()
            problem = with_enough_samples(problem)
            with spread_over(mesh):
                result = fit_pictures(problem)
                if problem.streamed and loss == "squared" and dark is None:
                    # Beside a picture that is read by bands no codes are fitted as such, and none err together.
                    some = in_memory(problem, rounding)
                    lossy = any(one.codes is not None and one.codes.lossy for one in some.targets)
                    if lossy or np.min(result.noise) < some.widest_step:
                        result = fit_pictures(with_enough_samples(some))
            return dataclasses.replace(result, seconds=time.perf_counter() - start)
    if mesh is not None:
        raise InputError(
            "mesh", "spreads all pixels over devices; accuracy and seconds choose some", "Give one of them"
        )
    if problem.streamed:
        words = "is read by bands of rows; accuracy and seconds choose among pixels in memory"
        raise InputError("target", words, "Read it with brdf.read_image, or leave accuracy and seconds out")
    with waiting("fitting"):
        return fit_within(problem, accuracy, seconds)
