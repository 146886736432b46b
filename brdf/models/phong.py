"""Phong's lobe about the mirror direction R = 2 (N.L) N - L of the light: the classic form and the normalised one.

| parameter | default | meaning | differentiable |
| --- | --- | --- | --- |
| k_a | 0 | ambient coefficient, a number or (C,), at least 0 | yes |
| k_d | | diffuse coefficient, a number or (C,), at least 0 | yes |
| k_s | | specular coefficient, a number or (C,), at least 0 | yes |
| n | | exponent, one number for all channels, at least 0 | yes |

`Phong`: S = (R.V)+^n. `NormalizedPhong`: S = (n+2)/2 (R.V)+^n (N.L)+.
"""

from typing import Any, cast

from brdf import vectors
from brdf.models.base import SpecularMaterial
from brdf.vectors import Numbers, Scalars


class Phong(SpecularMaterial):
    """A glossy surface as VTK and PyTorch3D draw it: S = (R.V)+^n, R the mirror direction of the light.

    k_a, k_d, k_s at least 0, n at least 0. Not reciprocal and not energy conserving for k_s > 0: the albedo diverges
    at grazing light. Source: B. T. Phong, "Illumination for computer generated pictures", CACM 18 (1975) 311-317.

    Example:
        >>> brdf.Phong(k_d=0.3, k_s=0.5, n=50)
        Phong(k_a=[0], k_d=[0.3], k_s=[0.5], n=50)
    """

    name = "phong"
    log_cosine = staticmethod(vectors.mirror_log_cosine)


class NormalizedPhong(SpecularMaterial):
    """Phong made physically plausible: S = (n+2)/2 (R.V)+^n (N.L)+.

    k_a, k_d, k_s at least 0, n at least 0. Reciprocal. Conserves energy when k_d + k_s <= 1: the lobe alone reflects
    all light at normal incidence and less at grazing angles, where the surface cuts it. Source: R. R. Lewis, "Making
    shaders more physically plausible", Computer Graphics Forum 13 (1994) 109-120; E. P. Lafortune and Y. D. Willems,
    "Using the modified Phong reflectance model for physically based rendering", Report CW 197, K.U. Leuven, 1994.

    Example:
        >>> brdf.check(brdf.NormalizedPhong(k_d=0.3, k_s=0.6, n=50)).plausible
        True
    """

    name = "normalized-phong"
    cosine_weighted = True
    log_cosine = staticmethod(vectors.mirror_log_cosine)

    @staticmethod
    def scale(n: Numbers) -> Scalars:
        """(n+2)/2: the albedo of the lobe at normal incidence is 1."""
        return 0.5 * (cast(Any, n) + 2.0)
