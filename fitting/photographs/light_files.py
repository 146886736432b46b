"""Text files of lights, as photometric stereo uses them: a line per photograph."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from brdf.errors import InputError
from brdf.files import parse_number, read_text

# Of a file of lights: some hundred thousand.
MOST_BYTES = 1 << 22


def parse_numbers(text: str, where: str, count: int, words: str) -> list[float]:
    """So many finite numbers with commas between them; ``where`` is the option or line and ``words`` what is wanted."""
    try:
        values = [parse_number(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) != count or not np.all(np.isfinite(values)):
        raise InputError(where, f"must be {count} finite numbers, got {text[:60]!r}", f"Give {words}")
    return values


def read_directions(path: str | Path, count: int | None = None) -> Float[np.ndarray, "K 3"]:
    """Light directions from a text file: three numbers a line, x right, y up, z to the camera.

    Args:
        path: the file; a first line with a single number, the count of the lines that follow, is skipped, and so is
            what follows ``#``.
        count: how many are wanted; None takes what there are.

    Raises:
        InputError: naming file and line.
    """
    return _read_rows(path, count, 3, any, "that are not all 0", "Give x y z of the direction towards the light")


def read_intensities(path: str | Path, count: int | None = None) -> Float[np.ndarray, "K C"]:
    """Light intensities from a text file: one number per channel a line.

    Args:
        path: the file, as for `read_directions`.
        count: how many are wanted; None takes what there are.

    Raises:
        InputError: naming file and line.
    """

    def is_fine(row):
        return min(row) >= 0 and any(row)

    return _read_rows(path, count, None, is_fine, "of 0 or more, not all 0", "Give the intensity of each channel")


def _read_rows(path, count, width, is_fine, words, remedy):
    """The numbers of the lines, of the same width each."""
    lines = [line.partition("#")[0].replace(",", " ") for line in read_text(path, MOST_BYTES).splitlines()]
    rows = {
        f"{path}: line {number}": parse_numbers(line, f"{path}: line {number}", len(line.split()), "plain numbers")
        for number, line in enumerate(lines, start=1)
        if line.strip()
    }
    if not rows:
        raise InputError(path, "holds no numbers", "Give a line per picture")
    first, *others = rows.values()
    if others and len(others[0]) > 1 and first == [len(others)]:
        del rows[next(iter(rows))]
    width = width or len(next(iter(rows.values())))
    for line, row in rows.items():
        if len(row) != width or not is_fine(row):
            raise InputError(line, f"must be {width} numbers {words}, got {row}", remedy)
    if count is not None and len(rows) != count:
        raise InputError(path, f"has {len(rows)} lines for {count} pictures", "Give a line per picture")
    return np.array(list(rows.values()))
