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
    rows = _number_rows(path)
    for number, row in rows:
        if len(row) != 3 or not any(row):
            came = f"must be three numbers that are not all 0, got {row}"
            raise InputError(f"{path}: line {number}", came, "Give x y z of the direction towards the light")
    return _as_many(path, [row for _, row in rows], count)


def read_intensities(path: str | Path, count: int | None = None) -> Float[np.ndarray, "K C"]:
    """Light intensities from a text file: one number per channel a line.

    Args:
        path: the file, as for `read_directions`.
        count: how many are wanted; None takes what there are.

    Raises:
        InputError: naming file and line.
    """
    rows = _number_rows(path)
    for number, row in rows:
        if len(row) != len(rows[0][1]) or min(row) < 0 or not any(row):
            came = f"must be {len(rows[0][1])} numbers of 0 or more, got {row}"
            raise InputError(f"{path}: line {number}", came, "Give the intensity of each channel")
    return _as_many(path, [row for _, row in rows], count)


def _number_rows(path: str | Path) -> list[tuple[int, list[float]]]:
    rows = []
    for number, line in enumerate(read_text(path, MOST_BYTES).splitlines(), start=1):
        text = line.partition("#")[0].strip()
        if text:
            place = f"{path}: line {number}"
            rows.append((number, parse_numbers(text, place, len(text.replace(",", " ").split()), "plain numbers")))
    if len(rows) > 1 and len(rows[0][1]) == 1 and len(rows[1][1]) > 1 and rows[0][1][0] == len(rows) - 1:
        rows = rows[1:]
    if not rows:
        raise InputError(path, "holds no numbers", "Give a line per picture")
    return rows


def _as_many(path: str | Path, rows: list[list[float]], count: int | None) -> np.ndarray:
    if count is not None and len(rows) != count:
        raise InputError(path, f"has {len(rows)} lines for {count} pictures", "Give a line per picture")
    return np.array(rows)
