"""How far one fit is from another: what an accuracy is an accuracy of."""

import numpy as np

import brdf
from brdf.models.base import SpecularMaterial
from fitting.result import FitResult
from fitting.uncertainty.covariance import TERMS

# A kind of coefficient that is smaller than this share of the largest one counts as if it were so large.
SMALLEST = 0.01


def deviation(result: FitResult, reference: FitResult) -> tuple[float, float, float]:
    """How far a fit is from a reference: what an estimated error is an estimate of.

    Of a coefficient: its difference over the largest channel of its kind in the reference (or over `SMALLEST` of its
    largest coefficient, if that is more); of n: the difference of its logarithms. What the reference does not determine
    is left out. Of the picture: root mean square of the difference over that of the reference's picture.

    Args:
        result: a fit.
        reference: another, of the same targets.

    Returns:
        The error of the parameters, infinite where the models differ in their highlight; that of the picture (RMS), and
        its largest error, over the reference picture's RMS.
    """
    return parameter_deviation(result, reference), *picture_deviation(result, reference)


def parameter_deviation(result: FitResult, reference: FitResult) -> float:
    """The first part of `deviation`.

    Args:
        result: a fit.
        reference: another, of the same targets.
    """
    one, other = result.material, reference.material
    specular = isinstance(other, SpecularMaterial) and bool(np.any(np.asarray(other.k_s) > 0))
    terms = TERMS if isinstance(other, SpecularMaterial) else TERMS[:2]
    largest = max(float(np.max(getattr(other, name))) for name in terms)
    lost, worst = set(reference.undetermined), 0.0
    for name in terms:
        true = np.asarray(getattr(other, name), np.float64)
        if name == "k_s" and not isinstance(one, SpecularMaterial):
            value = np.zeros_like(true)
        else:
            value = np.asarray(getattr(one, name), np.float64)
        off = np.abs(value - true) / max(float(true.max()), SMALLEST * largest, np.finfo(float).tiny)
        known = [not ({name, f"{name}[{channel}]"} & lost) for channel in range(true.size)]
        worst = max([worst, *off[known]])
    if specular and "n" not in lost:
        if type(one) is not type(other) or not float(getattr(one, "n", 0.0)):
            return float("inf")
        worst = max(worst, abs(float(np.log(float(one.n) / float(other.n)))))  # pyright: ignore[reportAttributeAccessIssue]
    return float(worst)


def picture_deviation(result: FitResult, reference: FitResult) -> tuple[float, float]:
    """The other parts of `deviation`.

    Args:
        result: a fit.
        reference: another, of the same targets.
    """
    square, total, worst, count = 0.0, 0.0, 0.0, 0
    for scene in reference.scenes:
        true = np.asarray(brdf.render(reference.material, scene, precision="float64"))
        change = np.asarray(brdf.render(result.material, scene, precision="float64")) - true
        square, total = square + float(np.sum(change**2)), total + float(np.sum(true**2))
        worst, count = max(worst, float(np.max(np.abs(change)))), count + true.size
    total = max(total, np.finfo(float).tiny)
    return float(np.sqrt(square / total)), worst / float(np.sqrt(total / count))
