"""A fit as HTML: a table for Jupyter, and a page of its own that needs no network.

The page holds the surface to turn, numbers with their intervals, warnings, pictures, plausibility, and how it was made.
A content policy in its head forbids it to load anything, so that it shows the same in twenty years.
"""

import base64
import contextlib
import datetime
import html
import importlib.metadata
import io
import math
import platform

import brdf
from brdf.display import material_html, report_html
from fitting.report.page import secure_page
from fitting.report.text import standing
from fitting.report.viewer import viewer
from fitting.result import NOT_DETERMINED, FitResult

SENTENCE = 45  # letters, from which on the text in a cell is broken over lines


def result_html(result: FitResult) -> str:
    """What Jupyter shows of a fit: the material, value, error and 95 % interval of each number, and the warnings.

    Args:
        result: of a fit.
    """
    summary = f"residual {100 * result.residual:.3g} % of the picture, {result.pixels} pixels, {result.seconds:.2g} s"
    return f"{material_html(result.material)}<p>{summary}, {result.precision}</p>{_numbers(result)}{_warnings(result)}"


def report_page(result: FitResult, *, source: str = "", command: str = "") -> str:
    """One self-contained HTML page about a fit.

    Args:
        result: of a fit; of several pictures the one that is explained worst is shown.
        source: what was fitted, for the title.
        command: how it was made.

    Returns:
        The page's text; it loads nothing and runs no program but the viewer's.
    """
    from fitting.report.material_plots import overview  # Matplotlib takes long to load

    check = brdf.check(result.material, name=result.material.name)
    title = f"{result.surface} fitted to {source or 'a picture'}"
    summary = f"Residual {100 * result.residual:.3g} % of the picture (rms) over {result.pixels} pixels."
    left_out = [f"{count} pixels {reason}" for reason, count in result.left_out.items() if count]
    summary += f" Left out: {', '.join(left_out)}." if left_out else ""
    count = len(result.targets)
    summary += f" Of {count} pictures the one that is explained worst is shown." if count > 1 else ""
    made = {
        "command": command,
        "made": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "time of the fit": f"{result.seconds:.3g} s, {result.precision}, {result.loss} loss",
        "with": _versions(),
    }
    alternative = "target, fit, residual, the highlight enlarged, a scanline through it, and the profile of n"
    body = f"""<h1>{html.escape(title)}</h1>
{material_html(result.material)}
<p>{html.escape(summary)}</p>
{_warnings(result)}
<h2>The surface, to turn</h2>
{viewer(result)}
<h2>Numbers</h2>
{_numbers(result)}
<h2>Pictures</h2>
{_picture(result.plot(), alternative)}
{_candidates(result)}
<h2>Is it plausible?</h2>
{report_html(check)}
{_picture(overview(result.material, check), "a lit sphere, the lobe, the albedo and the reciprocity error")}
<h2>How it was made</h2>
{_table([[key, value] for key, value in made.items() if value])}
<details><summary>The report as text</summary><pre class="wide">{html.escape(str(result))}</pre></details>"""
    return secure_page(title, body, "viewer.js")


def _numbers(result):
    channels = result.material.k_d.shape[0]
    rows = [["", "channel", "value", "± error", "95 % interval", ""]]
    for one in result.parameters:
        ends = ("∞" if math.isinf(end) else f"{end:.6g}" for end in one.interval or ())
        channel = one.label(channels)
        value = NOT_DETERMINED if one.value is None else f"{one.value:.6g}"
        error = f"{one.error:.2g}" if one.error else ""
        remark = "at its bound" if one.at_bound else one.reason
        rows.append([one.name, channel, value, error, " to ".join(ends), remark])
    return _table(rows, head=True)


def _candidates(result):
    if len(result.candidates) < 2:
        return ""
    rows = [["model", "", "unknowns", "rms", "held out", "excess ± its error", "BIC"]]
    for one in result.candidates:
        excess = f"{one.excess:.4g} ± {one.excess_error:.2g}"
        numbers = [f"{one.rms:.3e}", f"{one.held_out:.3e}", excess, f"{one.bic:.4g}"]
        rows.append([one.name, standing(one), str(one.unknowns), *numbers])
    return (
        "<h2>What the scene requires</h2><p>The simplest adequate model is chosen: its squared error expected on "
        "held-out pixels exceeds that of the best, in noise variances, by no more than its standard error.</p>"
        + _table(rows, head=True)
    )


def _warnings(result):
    return "".join(f'<p class="warning">⚠ {html.escape(warning)}</p>' for warning in result.warnings)


def _table(rows, head=False):
    """A table, its first row a head or not, without the columns that are empty below it; the first names the rows."""
    filled = [any(column[head:]) for column in zip(*rows, strict=True)]
    left, lines = "text-align:left", ""
    for index, row in enumerate(rows):
        first, *others = (html.escape(cell) for cell, keep in zip(row, filled, strict=True) if keep)
        if head and not index:
            lines += f'<tr><th style="{left}">{first}</th><th>{"</th><th>".join(others)}</th></tr>'
            continue
        lines += f'<tr><td style="{left}">{first}</td>'
        for cell in others:
            # Numbers are not broken over lines; on a narrow screen the table is pushed sideways instead.
            whole = "text-align:right;white-space:nowrap" if len(cell) < SENTENCE else "text-align:right"
            lines += f'<td style="{whole if head else left}">{cell}</td>'
        lines += "</tr>"
    return f'<div class="wide"><table>{lines}</table></div>'


def _picture(figure, alternative):
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    data = base64.b64encode(file.getvalue()).decode()
    return f'<p><img alt="{html.escape(alternative)}" src="data:image/png;base64,{data}"></p>'


def _versions():
    found = [f"Python {platform.python_version()}"]
    for name in ("brdf-fitting", "jax", "optimistix", "numpy"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):  # run from a source tree
            found.append(f"{name} {importlib.metadata.version(name)}")
    return ", ".join(found)
