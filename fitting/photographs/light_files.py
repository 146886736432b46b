"""Text files of lights, as photometric stereo uses them: a line per photograph."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from brdf.errors import InputError
from brdf.files import parse_number, read_text

# Of a file of lights: some hundred thousand.
MOST_BYTES = 1 << 22


def parse_numbers(text: str, where: str, count: int, words: str) -> list[float]:
    """Numbers with commas between them.

    Args:
        text: what was typed.
        where: the option or line, for the message.
        count: how many are wanted.
        words: what they are.

    Raises:
        InputError: where they are not so many finite numbers.
    """
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
    rows = _read_rows(path, count)
    for line, row in rows.items():
        if len(row) != 3 or not any(row):
            came = f"must be three numbers that are not all 0, got {row}"
            raise InputError(line, came, "Give x y z of the direction towards the light")
    return np.array(list(rows.values()))


def read_intensities(path: str | Path, count: int | None = None) -> Float[np.ndarray, "K C"]:
    """Light intensities from a text file: one number per channel a line.

    Args:
        path: the file, as for `read_directions`.
        count: how many are wanted; None takes what there are.

    Raises:
        InputError: naming file and line.
    """
    rows = _read_rows(path, count)
    channels = len(next(iter(rows.values())))
    for line, row in rows.items():
        if len(row) != channels or min(row) < 0 or not any(row):
            came = f"must be {channels} numbers of 0 or more, got {row}"
            raise InputError(line, came, "Give the intensity of each channel")
    return np.array(list(rows.values()))


def _read_rows(path: str | Path, count: int | None) -> dict[str, list[float]]:
    """The numbers of each line, by what a message calls it."""
    rows = {}
    for number, line in enumerate(read_text(path, MOST_BYTES).splitlines(), start=1):
        text = line.partition("#")[0].replace(",", " ").strip()
        if text:
            where = f"{path}: line {number}"
            rows[where] = parse_numbers(text, where, len(text.split()), "plain numbers")
    if not rows:
        raise InputError(path, "holds no numbers", "Give a line per picture")
    first, *others = rows
    if others and len(rows[first]) == 1 < len(rows[others[0]]) and rows[first][0] == len(others):
        del rows[first]
    if count is not None and len(rows) != count:
        raise InputError(path, f"has {len(rows)} lines for {count} pictures", "Give a line per picture")
    return rows
