"""How a fit is told, drawn and written: as text, as HTML, in pictures, as files.

`fitting.result` is plain data and knows nothing of this; the functions that its methods call are entered there. Who
makes a result takes the class from here, and a pickled one names the package, which does as well.
"""

from typing import Any

from fitting.report import saving, text
from fitting.result import REPORTS, Cause, FitResult

__all__ = ["FitResult"]


# What is drawn, or asked for now and then, is loaded where it is.
def _plot(result: FitResult, picture: int | None) -> Any:
    from fitting.report.plots import comparison

    return comparison(result, picture)


def _html(result: FitResult) -> str:
    from fitting.report.html import result_html

    return result_html(result)


def _view(result: FitResult, picture: int | None) -> Any:
    from fitting.report.viewer import view

    return view(result, picture)


def _diagnose(result: FitResult) -> tuple[Cause, ...]:
    from fitting.diagnosis import diagnose

    return diagnose(result)


REPORTS |= {"text": text.report, "save": saving.save, "html": _html, "plot": _plot, "view": _view}
REPORTS["diagnose"] = _diagnose
FitResult.__module__ = "fitting"
