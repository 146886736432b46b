"""A fit as HTML: a table for Jupyter, and a page of its own that needs no network.

The page holds the surface to turn, numbers with their intervals, warnings, pictures, plausibility, and how it was made.
A content policy in its head forbids it to load anything, so that it shows the same in twenty years.
"""

import base64
import contextlib
import datetime
import importlib.metadata
import io
import math
import platform
from html import escape

import brdf
from brdf.display import material_html, report_html
from fitting.report.page import secure_page
from fitting.report.viewer import viewer
from fitting.result import NOT_DETERMINED, FitResult


def result_html(result: FitResult) -> str:
    """What Jupyter shows of a fit: the material, value, error and 95 % interval of each number, and the warnings."""
    summary = f"residual {100 * result.residual:.3g} % of the picture, {result.pixels} pixels, {result.seconds:.2g} s"
    material = material_html(result.material, result.undetermined)
    return f"{material}<p>{summary}, {result.precision}</p>{_numbers(result)}{_warnings(result)}"


def report_page(result: FitResult, *, source: str = "", command: str = "") -> str:
    """One self-contained HTML page about a fit; of several pictures the one that is explained worst is shown.

    It loads nothing and runs no program but the viewer's. Its title names the source, its end the command.
    """
    from fitting.report.material_plots import overview  # Matplotlib takes long to load

    check = brdf.check(result.material, name=result.material.name)
    title = f"{result.surface} fitted to {source or 'a picture'}"
    summary = f"Residual {100 * result.residual:.3g} % of the picture (rms) over {result.pixels} pixels."
    left_out = ", ".join(f"{count} pixels {reason}" for reason, count in result.left_out.items() if count)
    summary += f" Left out: {left_out}." if left_out else ""
    count = len(result.targets)
    summary += f" Of {count} pictures the one that is explained worst is shown." if count > 1 else ""
    made = {
        "command": command,
        "made": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M UTC}",
        "time of the fit": f"{result.seconds:.3g} s, {result.precision}, {result.loss} loss",
        "with": _versions(),
    }
    made = "".join(f"<dt>{name}</dt><dd>{escape(words)}</dd>" for name, words in made.items() if words)
    alternative = "target, fit, residual, the highlight enlarged, a scanline through it, and the profile of n"
    body = f"""<h1>{escape(title)}</h1>
{material_html(result.material, result.undetermined)}
<p>{escape(summary)}</p>
{_warnings(result)}
<h2>The surface, to turn</h2>
{viewer(result)}
<h2>Numbers</h2>
{_numbers(result)}
<h2>Pictures</h2>
{_picture(result.plot(), alternative)}
<h2>Is it plausible?</h2>
{report_html(check)}
{_picture(overview(result.material, check), "a lit sphere, the lobe, the albedo and the reciprocity error")}
<h2>How it was made, and what was compared</h2>
<dl>{made}</dl>
<pre class="wide">{escape(str(result))}</pre>"""
    return secure_page(title, body, "viewer.js")


def _numbers(result):
    """A table without the columns that are empty below their head."""
    rows = [["number", "channel", "value", "± error", "95 % interval", "remark"]]
    for one in result.parameters:
        ends = ("∞" if math.isinf(end) else f"{end:.6g}" for end in one.interval or ())
        value = NOT_DETERMINED if one.value is None else f"{one.value:.6g}"
        error = f"{one.error:.2g}" if one.error else ""
        remark = "at its bound" if one.at_bound else one.reason
        rows.append([one.name, one.label(len(result.noise)), value, error, " to ".join(ends), remark])
    filled = [column for column in zip(*rows, strict=True) if any(column[1:])]
    lines = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in zip(*filled, strict=True)]
    table = "</tr><tr>".join([lines[0].replace("td>", "th>"), *lines[1:]])
    return f'<div class="wide"><table class="numbers"><tr>{table}</tr></table></div>'


def _warnings(result):
    return "".join(f'<p class="warning">⚠ {escape(warning)}</p>' for warning in result.warnings)


def _picture(figure, alternative):
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    data = base64.b64encode(file.getvalue()).decode()
    return f'<p><img alt="{alternative}" src="data:image/png;base64,{data}"></p>'


def _versions():
    found = [f"Python {platform.python_version()}"]
    for name in ("brdf-fitting", "jax", "optimistix", "numpy"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):  # run from a source tree
            found.append(f"{name} {importlib.metadata.version(name)}")
    return ", ".join(found)
