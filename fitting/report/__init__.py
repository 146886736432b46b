"""How a fit is told, drawn and written: as text, as HTML, in pictures, as files.

`fitting.result` is plain data and knows nothing of this; the functions that its methods call are entered there. Who
makes a result takes the class from here, and a pickled one names the package, which does as well.
"""

from typing import Any

from fitting.diagnosis import diagnose
from fitting.report import html, saving, text, viewer
from fitting.result import REPORTS, FitResult

__all__ = ["FitResult"]


def _plot(result: FitResult, picture: int | None) -> Any:
    from fitting.report.plots import comparison  # Matplotlib takes long to load

    return comparison(result, picture)


REPORTS |= {"text": text.report, "html": html.result_html, "save": saving.save, "plot": _plot, "view": viewer.view}
REPORTS["diagnose"] = diagnose
FitResult.__module__ = "fitting"
