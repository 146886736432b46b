"""A page of its own around what WebGL2 draws: one file that asks no network and no kernel for anything.

What is drawn, and what may be moved, is the caller's: its script stands behind `viewer_assets/page.js`, its fragment
shader behind `display.frag`. A fit's surface (`fitting.report.viewer`) and maps (`fitting.maps.map_page`) call here.
"""

import base64
import dataclasses
import functools
import gzip
import hashlib
import html
import json
import math
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from brdf.channels import channel_names
from brdf.display import png_address
from brdf.errors import InputError
from brdf.files import write_text
from fitting.result import FitResult


@dataclasses.dataclass(frozen=True)
class Page:
    """A page of its own; Jupyter shows it in a frame, without a kernel, also in a notebook that is only read.

    Attributes:
        text: the HTML.
    """

    text: str = dataclasses.field(repr=False)

    def _repr_html_(self) -> str:
        """For Jupyter: the page in a frame."""
        frame = "width:100%;height:46rem;border:0"
        return f'<iframe style="{frame}" sandbox="allow-scripts" srcdoc="{html.escape(self.text)}"></iframe>'

    def save(self, path: str | Path) -> None:
        """Write the page, whole or not at all."""
        write_text(path, self.text)


def secure_page(title: str, body: str, script: str) -> str:
    """A whole page. It loads nothing, and runs no program but its own.

    The title is text, the body HTML with a `stage`, and the script an asset, which draws on that.
    """
    style, script = asset("viewer.css"), asset("page.js") + asset(script)

    def digest(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    policy = f"default-src 'none'; img-src data:; style-src-elem {digest(style)}; style-src-attr 'unsafe-inline'"
    policy += f"; script-src {digest(script)}"
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{html.escape(title)}</title>
<style>{style}</style></head>
<body>
{body}
<script>{script}</script></body></html>
"""


def stage(words: str, data: Mapping[str, Any], picture: Float[np.ndarray, "H W 3"]) -> str:
    """What is drawn on and the controls below it, as HTML; the picture is shown where there is no WebGL2.

    An asset holds what is this page's own, by headings; the data are for the script.
    """
    own = dict(re.findall(r"<!-- (\w+) -->\n(.*?)\n(?=<!-- |\Z)", asset(words), re.DOTALL))
    # In a script element nothing but </script and <!-- has a meaning to HTML.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return Template(asset("stage.html")).substitute(own, picture=png_address(picture), data=text)


@functools.cache
def asset(name: str) -> str:
    """The text of a file of `viewer_assets`."""
    return (resources.files("fitting.report") / "viewer_assets" / name).read_text(encoding="utf-8")


def packed(values: np.ndarray) -> str:
    """Numbers as text: gzip, base64."""
    return base64.b64encode(gzip.compress(np.ascontiguousarray(values).tobytes(), mtime=0)).decode()


# -- which picture, which of its pixels and channels are shown ---------------------------------------------------------


def shown_picture(result: FitResult, picture: int | None) -> int:
    """Which of a fit's pictures is shown, from 0: None takes the one that is explained worst."""
    count = len(result.targets)
    if picture is None:
        return 0 if count == 1 else int(np.argmax([_unexplained(result, index) for index in range(count)]))
    if not 0 <= picture < count:
        raise InputError("picture", f"must be from 0 to {count - 1}, got {picture}", "Count the pictures from 0")
    return picture


def _unexplained(result, picture):
    """Squares of the residual of a picture, over its own."""
    values, fitted = (image[result.counted[picture]] for image in (result.targets[picture], result.fitted(picture)))
    return np.sum((fitted - values) ** 2, dtype=float) / max(np.sum(values**2, dtype=float), 1e-300)


def window(counted: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that show what counts, (H, W), and a margin around it: a thing may be small in its picture."""
    if not counted.any():
        counted = ~counted
    ends = [np.flatnonzero(counted.any(axis=axis))[[0, -1]] for axis in (1, 0)]
    margin = 2 + max(last - first for first, last in ends) // 16
    spans = zip(ends, counted.shape, strict=True)
    rows, columns = (slice(max(first - margin, 0), min(last + margin + 1, size)) for (first, last), size in spans)
    return rows, columns


class Shown(NamedTuple):
    """What a page holds of pictures.

    Attributes:
        rows: of them.
        columns: of them.
        data: what the script is told of it: of ``channels`` those ``shown`` as red, green and blue, and the ``window``.
        notes: of what is left out.
    """

    rows: slice
    columns: slice
    data: dict[str, Any]
    notes: list[str]

    @classmethod
    def of(cls, counted: Bool[np.ndarray, "H W"], channels: int, largest: int) -> "Shown":
        """What counts of pictures of so many channels; above the largest size every second, third, ... pixel."""
        names, notes = channel_names(channels), []
        chosen = [0, channels // 2, channels - 1] if channels > 3 else [min(i, channels - 1) for i in range(3)]
        rows, columns = window(counted)
        left, top = int(columns.start), int(rows.start)
        stride = math.ceil(max(rows.stop - top, columns.stop - left) / largest)
        rows, columns = slice(top, rows.stop, stride), slice(left, columns.stop, stride)
        height, width = counted[rows, columns].shape
        if channels > 3:
            notes.append(f"Of {channels} channels three are shown as colours: {', '.join(names[c] for c in chosen)}.")
        if stride > 1:
            notes.append(f"Of the picture every {stride}th column and row is held here.")
        data = {"channels": names, "shown": chosen, "window": [left, top, width, height, stride]}
        return cls(rows, columns, data, notes)

    def pixels(self, image: np.ndarray) -> np.ndarray:
        """Those of a whole image, (H, W, ...), of all channels or of one, in three colours."""
        image = np.asarray(image)[self.rows, self.columns]
        return image[..., np.minimum(self.data["shown"], image.shape[-1] - 1)]


def white(image: Float[np.ndarray, "..."]) -> float:
    """What is shown as white: nothing that only a few pixels of a highlight reach, and none clipped for no reason."""
    return max(float(min(4 * np.quantile(image, 0.999), np.max(image))), 1e-12) if image.size else 1.0
