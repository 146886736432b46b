"""Measured BRDFs as text: Cornell's goniometer tables and ALTA's formats.

Cornell: ``#`` starts a comment; the number of wavelengths, the wavelengths in nm, then a line for each sample,
``theta_i phi_i theta_s phi_s v_1 .. v_N`` (radians, 1/sr).

ALTA: a header of ``#KEY value`` lines (``DIM``: numbers per row of input and output; ``PARAM_IN``, ``PARAM_OUT``;
``VS``: columns with a confidence interval follow), then rows. Parametrisations are those of ALTA's ``params.h``; those
that say nothing of the light are read as ALTA converts them: light along the normal, or both along the half vector.
Source: L. Belcour, R. Pacanowski and P. Barla, "ALTA: a BRDF analysis library", MAM 2014.
"""

import re
from collections import defaultdict
from pathlib import Path

import numpy as np

from brdf.channels import MOST_CHANNELS
from brdf.errors import InputError
from brdf.files import parse_number, read_text
from brdf.measured.table import MeasuredBRDF, from_angles, from_half_angles

# What the columns are: angles of half vector, difference, view and light, or cosines of them. What is not said is 0.
_PARAMETRISATIONS = {
    "COS_TH": "theta_h",
    "COS_TH_TD": "theta_h theta_d",
    "COS_TLV": "theta_v",
    "COS_TLR": "theta_v",
    "RUSIN_TH_TD": "theta_h theta_d",
    "RUSIN_TH_TD_PD": "theta_h theta_d phi_d",
    "RUSIN_TH_PH_TD_PD": "theta_h phi_h theta_d phi_d",
    "ISOTROPIC_TV_TL_DPHI": "theta_v theta_l phi_l",
    "ISOTROPIC_TV_PROJ_DPHI": "x_v y_v",
    "ISOTROPIC_TL_TV_PROJ_DPHI": "theta_l x_v y_v",
    "SPHERICAL_TL_PL_TV_PV": "theta_l phi_l theta_v phi_v",
    "CARTESIAN": "x_v y_v z_v x_l y_l z_l",
}
_NOT_SAID = {"RUSIN_TH_TD": {"phi_d": 0.5 * np.pi}, "COS_TLR": {"phi_v": np.pi}}
_OUTPUTS = ("INV_STERADIAN", "INV_STERADIAN_COSINE_FACTOR", "RGB_COLOR", "UNKNOWN_OUTPUT")
# Of a key: what it is where it is missing, what it may be, what is wrong with others, what to do.
_HEADER = {
    "FORMAT": ("text", "(?i)text", "is {!r}, which is not read", "Save it as text with ALTA"),
    "DIM": (
        "",
        r"[0-9]{1,5}\s+[0-9]{1,5}",
        "must be two whole numbers, got {!r}",
        "Write #DIM and the numbers of input and output columns",
    ),
    "PARAM_OUT": ("UNKNOWN_OUTPUT", "|".join(_OUTPUTS), "is no BRDF value, got {!r}", f"Known: {', '.join(_OUTPUTS)}"),
    "PARAM_IN": ("", "|".join(_PARAMETRISATIONS), "is not known, got {!r}", f"Known: {', '.join(_PARAMETRISATIONS)}"),
    "VS": ("0", "[012]", "must be 0, 1 or 2, got {!r}", "Correct the header"),
}


def load(path: Path) -> MeasuredBRDF:
    """Read an ordinary file of either format; an error names file and line."""
    lines = read_text(path).splitlines()
    # Lines that hold something, each with its place.
    rows = [(f"{path}: line {number}", line.partition("#")[0].split()) for number, line in enumerate(lines, start=1)]
    rows = [row for row in rows if row[1]]
    if any(line.startswith("#DIM") for line in lines):
        heads = [line[1:].partition(" ") for line in lines if line.startswith("#")]
        header = {key: value.strip() for key, _, value in reversed(heads) if key.isupper()}  # the first of a key counts
        light, view, values, names = _alta(path, header, rows)
    else:
        light, view, values, names = _cornell(path, rows)
    return MeasuredBRDF.from_samples(light, view, values, name=path.stem, channels=names)


def _cornell(path, rows):
    if not rows:
        raise InputError(path, "holds no numbers", "Give a table of a measured BRDF")
    where, (first, *_) = rows[0]
    try:
        count = parse_number(first)
    except ValueError:
        count = 0
    if not 1 <= count <= MOST_CHANNELS or count % 1:
        remedy = "The first number says how many wavelengths follow; ALTA files have a #DIM line"
        raise InputError(where, f"is no measured BRDF, got {first[:40]!r}", remedy)
    count, head = int(count), []
    while rows and len(head) <= count:
        (where, words), *rows = rows
        _table(path, [(where, words)], len(words))  # what is no number is told where it stands
        head += words
    wavelengths = _table(path, [(where, head)], 1 + count)[0, 1:]
    table = _table(path, rows, 4 + count)
    theta_i, phi_i, theta_s, phi_s = _within(rows, table[:, :4].T)
    names = tuple(f"{wavelength:g} nm" for wavelength in wavelengths)
    return from_angles(theta_i, phi_i), from_angles(theta_s, phi_s), table[:, 4:], names


def _alta(path, header, rows):
    for key, (default, pattern, what, remedy) in _HEADER.items():
        value = header.setdefault(key, default)
        if not re.fullmatch(pattern, value):
            what = what.format(value[:40]) if value or key != "PARAM_IN" else "is missing"
            raise InputError(f"{path}: {key}", what, remedy)
    inputs, outputs = map(int, header["DIM"].split())
    columns = len(_PARAMETRISATIONS[header["PARAM_IN"]].split())
    if columns != inputs or not 1 <= outputs <= MOST_CHANNELS:
        what = f"says {inputs} input and {outputs} output columns, {header['PARAM_IN']} has {columns}"
        raise InputError(f"{path}: DIM", what, f"Correct the header; there are 1 to {MOST_CHANNELS} outputs")
    table = _table(path, rows, inputs + outputs, int(header["VS"]) * outputs)
    view, light = _directions(header["PARAM_IN"], rows, table[:, :inputs].T)
    values, unit = table[:, inputs:], header["PARAM_OUT"]
    if unit == "INV_STERADIAN_COSINE_FACTOR":
        values = values / np.where(view[:, 2:] > 0, view[:, 2:], 1.0)
    return light, view, values, ("red", "green", "blue") if unit == "RGB_COLOR" and outputs == 3 else None


def _table(path, rows, width, more=0):
    """The first numbers of every row, which may have some more."""
    values = []
    for where, words in rows:
        if not width <= len(words) <= width + more:
            raise InputError(where, f"has {len(words)} numbers instead of {width}", "Give as many as the header says")
        for word in words[:width]:
            try:
                values.append(parse_number(word))
            except ValueError:
                remedy = "Numbers have a decimal point and spaces between them; # starts a comment"
                raise InputError(where, f"must be a number, got {word[:40]!r}", remedy) from None
    if not values:
        raise InputError(path, "holds no samples", "Give a table with rows of numbers")
    return np.array(values).reshape(-1, width)


def _directions(kind, rows, columns):
    """View and light of each row."""
    if kind == "CARTESIAN":
        length = np.linalg.norm(columns.reshape(2, 3, -1), axis=1)
        for row, _ in np.argwhere(~((length > 0) & (length < np.inf)).T):
            raise InputError(rows[row][0], "has a direction that is zero or not finite", "Correct the file")
        return columns[:3].T, columns[3:].T
    if kind.startswith("COS_"):
        _within(rows, columns, 1.0, "a cosine", "It is within -1 and 1")
        columns = 2 * np.arctan2(np.sqrt(1 - columns), np.sqrt(1 + columns))
    columns = dict(zip(_PARAMETRISATIONS[kind].split(), _within(rows, columns), strict=True))
    angles = defaultdict(float, _NOT_SAID.get(kind, {}) | columns)
    if "x_v" in columns:  # the parts of the polar angle along two axes
        x, y = columns["x_v"], columns["y_v"]
        angles |= {"theta_v": np.hypot(x, y), "phi_v": np.arctan2(y, x)}
    if "theta_h" in columns:
        pair = from_half_angles(angles["theta_h"], angles["theta_d"], angles["phi_d"], angles["phi_h"])
    else:
        pair = from_angles(angles["theta_v"], angles["phi_v"]), from_angles(angles["theta_l"], angles["phi_l"])
    return np.broadcast_arrays(*pair)


def _within(rows, columns, largest=2 * np.pi + 1e-6, what="an angle", remedy="Angles are in radians, at most 2 pi"):
    """Columns that hold nothing larger."""
    for row, column in np.argwhere(~(np.abs(columns.T) <= largest)):
        raise InputError(rows[row][0], f"has {what} of {columns[column, row]:g}", remedy)
    return columns
