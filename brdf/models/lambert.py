"""A perfectly matt surface: S = 0, f_r = k_d / pi.

| parameter | default | meaning | differentiable |
| --- | --- | --- | --- |
| k_a | 0 | ambient coefficient, a number or (C,), at least 0 | yes |
| k_d | | diffuse coefficient, a number or (C,), at least 0: the albedo | yes |
"""

from brdf.models.base import Material


class Lambert(Material):
    """A perfectly matt surface: S = 0, f_r = k_d / pi.

    Reciprocal. Conserves energy when k_d <= 1. Source: J. H. Lambert, Photometria, 1760.

    Args:
        k_a: ambient coefficient, a scalar or (C,), at least 0.
        k_d: diffuse coefficient, a scalar or (C,), at least 0.

    Raises:
        InputError: a number is negative or not finite, or the shapes do not fit.

    Example:
        >>> float(brdf.Lambert(k_d=0.5).reflectance([0, 0, 1], [0, 0.6, 0.8])[0])  # k_d / pi
        0.159...
    """

    name = "lambert"
