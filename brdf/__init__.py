"""Differentiable reflectance: models, lights, scenes, pictures and plausibility checks.

Names load when first used, so that importing the package does not import JAX; `__init__.pyi` says from where.
"""

from typing import Any

import lazy_loader

from brdf.formatters import html as _html

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name != "__version__":
        return _load(name)
    import importlib.metadata

    return importlib.metadata.version("brdf-fitting")


def _material_html(material: Any) -> str:
    from brdf.display import material_html  # late: it imports JAX

    return material_html(material)


def _report_html(report: Any) -> str:
    from brdf.display import report_html

    return report_html(report)


_html.update(material=_material_html, report=_report_html)
