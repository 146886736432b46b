"""What formats of other programs need to know of a highlight: its exponent there, and how bright it comes out.

Formats differ most where a highlight peaks: light and view mirror each other about the normal. There every lobe has a
closed form, so that an export can say by how much another program's picture differs, instead of that it does.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from brdf.conversions import half_from_mirror
from brdf.models import Material, NormalizedPhong, Phong, SpecularMaterial

Colour = Float[np.ndarray, "3"]

_GRAZING = 60.0  # degrees from the normal: far out, and still seen on a tenth of a ball


def rgb(values: Any) -> Colour:
    """Three channels in float64; one channel is grey.

    Args:
        values: (1,) or (3,).
    """
    return np.broadcast_to(np.asarray(values, np.float64), (3,)).copy()


def half_exponent(material: SpecularMaterial) -> float:
    """The exponent of N·H that gives nearly the highlight of this material.

    Args:
        material: with a highlight.
    """
    n = float(material.n)
    return float(half_from_mirror(n)) if isinstance(material, Phong | NormalizedPhong) else n


def height(material: SpecularMaterial) -> float:
    """The constant before the lobe, 1 in the classic forms.

    Args:
        material: with a highlight.
    """
    return float(material.scale(np.float64(material.n)))


def brightness(material: Material, drawn: Callable[[float], Colour]) -> list[str]:
    """How bright another program draws the peak of the highlight, in words.

    Args:
        material: any of the five models, with 1 or 3 channels.
        drawn: the radiance that the other program shows of a light of intensity 1 where light and view mirror each
            other at an angle of this cosine, (3,).

    Returns:
        A sentence with the ratio of the means over the channels at 0° and at 60° from the normal; nothing where there
        is no highlight, or where both ratios are 1 to a thousandth.
    """
    if not isinstance(material, SpecularMaterial) or not np.any(material.k_s):
        return []
    ratios = []
    for cosine in (1.0, float(np.cos(np.radians(_GRAZING)))):
        weight = height(material) * (cosine if material.cosine_weighted else 1.0)
        ratios.append(float(np.sum(drawn(cosine)) / np.sum(rgb(material.k_d) * cosine + rgb(material.k_s) * weight)))
    if np.allclose(ratios, 1.0, rtol=0, atol=1e-3):
        return []
    facing, grazing = (f"{ratio:.2f}" if ratio < 10 else f"{ratio:.0f}" for ratio in ratios)
    return [
        f"at its peak the highlight comes out {facing} times as bright where light and view stand along the normal, "
        f"{grazing} times where they stand {_GRAZING:g}° from it"
    ]
