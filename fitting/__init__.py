"""Fitting reflectance models to pictures: one call, no guess, the global optimum, and how sure it is.

Names load when first used, so that the command's help does not import JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fitting.accuracy.speed_accuracy import tradeoff
    from fitting.accuracy.speed_table import Tradeoff
    from fitting.brdf_fit import fit_brdf
    from fitting.brdf_result import BrdfFitResult
    from fitting.implicit import Sensitivity, sensitivity
    from fitting.joint import fit_jointly
    from fitting.picture_fit import fit
    from fitting.plots.materials import overview, plot_albedo, plot_lobe, plot_reciprocity, plot_stability
    from fitting.relighting import LightFit, fit_lights, fit_lights_and_material
    from fitting.result import FitResult, Parameter

_ROOM_OF = {
    "BrdfFitResult": "brdf_result",
    "FitResult": "result",
    "LightFit": "relighting",
    "Parameter": "result",
    "Tradeoff": "accuracy.speed_table",
    "Sensitivity": "implicit",
    "fit": "picture_fit",
    "fit_brdf": "brdf_fit",
    "fit_jointly": "joint",
    "fit_lights": "relighting",
    "fit_lights_and_material": "relighting",
    "overview": "plots.materials",
    "plot_albedo": "plots.materials",
    "plot_lobe": "plots.materials",
    "plot_reciprocity": "plots.materials",
    "plot_stability": "plots.materials",
    "sensitivity": "implicit",
    "tradeoff": "accuracy.speed_accuracy",
}

__all__ = sorted(_ROOM_OF)


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_ROOM_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__
