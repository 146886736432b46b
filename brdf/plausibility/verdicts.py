"""Is it physically plausible? Positivity, reciprocity and energy conservation of a material or of any BRDF."""

from collections.abc import Callable
from typing import Any

from brdf.errors import InputError
from brdf.measured.table import MeasuredBRDF
from brdf.models import Material
from brdf.models.base import check_single
from brdf.plausibility.analytic import KNOWN, check_material
from brdf.plausibility.numeric import check_black_box
from brdf.plausibility.report import Report
from brdf.plausibility.tables import check_table


def check(brdf: Material | MeasuredBRDF | Callable[[Any, Any], Any], *, name: str | None = None) -> Report:
    """Test a material, or any BRDF, for positivity, reciprocity and energy conservation.

    Args:
        brdf: one of the five models, of known numbers; a measured table, whose errors are told in units of its noise;
            or f_r(to_light, to_view) -> (C,), in 1/sr, of unit vectors (3,) in the local frame whose +z axis is the
            normal, written with ``jax.numpy``.
        name: what to call it in the report.

    Returns:
        The report: three findings with verdict, worst case, margin and error bound; ``print`` it, or see its
        ``plausible``. A "cannot tell" means that the numerical error is larger than the margin.

    Raises:
        InputError: it is neither, or it cannot be called as described.

    Example:
        >>> report = brdf.check(brdf.BlinnPhong(k_d=0.3, k_s=0.5, n=50))
        >>> report.plausible, report.energy.verdict
        (False, 'fail')
    """
    if isinstance(brdf, Material):
        check_single(brdf, "Write brdf.check(material)")
        if type(brdf) in KNOWN:
            return check_material(brdf, name or repr(brdf))
        return check_black_box(brdf, name or repr(brdf))
    if isinstance(brdf, MeasuredBRDF):
        return check_table(brdf, name)
    if isinstance(brdf, type) or not callable(brdf):
        what = f"the class {brdf.__name__}" if isinstance(brdf, type) else type(brdf).__name__
        raise InputError("brdf", f"must be a material or a function, got {what}", "Give one with numbers")
    return check_black_box(brdf, name or getattr(brdf, "__name__", type(brdf).__name__))
