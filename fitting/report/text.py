"""A fit as text: what the command prints, and what a person pastes into a paper."""

from pathlib import Path

import numpy as np

from brdf.channels import channel_names
from fitting.result import FitResult

# Correlations above this are told, so many at most.
STRONG, MOST_CORRELATIONS = 0.9, 3


def report(result: FitResult) -> str:
    """The text that a person reads."""
    channels = len(result.noise)
    labels = channel_names(channels)
    count = f"{len(result.targets)} pictures, " if len(result.targets) > 1 else ""
    plural = "channel" if channels == 1 else "channels"
    loss = "" if result.loss == "squared" else f", {result.loss} loss"
    lines = [
        f"{result.surface} fitted to {count}{result.pixels} pixels x {channels} {plural} "
        f"in {result.seconds:.2g} s ({result.precision}{loss})"
    ]
    width = max((len(parameter.name) for parameter in result.parameters), default=3)
    for parameter in result.parameters:
        lines.append(f"  {parameter.name:<{width}} {parameter.label(channels):<6} {parameter}")
    lines.append(f"  residual    {100 * result.residual:.3g} % of the picture (rms)")
    lines += [f"  left out    {pixels} pixels {reason}" for reason, pixels in result.left_out.items() if pixels]
    lines += _silent(result.files)
    guessed = next((file for file in result.files if file is not None and file.get("layer") is not None), None)
    if guessed is not None:
        lines.append(f"  read as     layer {guessed['layer']}: {Path(guessed['path']).name} names none as the picture")
    lines += [f"  read as     codes: all values lie on the levels of {result.levels}"] if result.levels else []
    if result.highlight_pixels is not None:
        lines.append(f"  highlight   on {result.highlight_pixels:.{0 if result.highlight_pixels >= 10 else 1}f} pixels")
    lines += [] if result.choice is None else result.choice.lines()
    lines += _correlations(result, labels)
    lines += _candidates(result.candidates) if result.candidates else []
    lines += [f"  warning: {warning}" for warning in result.warnings]
    lines += [f"  cause?      {cause}" for cause in result.causes_of_structure[:1]]
    return "\n".join(lines)


def _silent(files):
    """How files were read that do not say how they hold light."""
    silent = [file for file in files if file is not None and file.get("source") == "assumed"]
    if not silent:
        return []
    encoding = {"srgb": "sRGB"}.get(silent[0]["encoding"], silent[0]["encoding"])
    others = f" and {len(silent) - 1} more do" if len(silent) > 1 else " does"
    return [f"  read as     {encoding}: {Path(silent[0]['path']).name}{others} not say how values are encoded"]


def _correlations(result, labels):
    """The strongest correlations, as far as they are worth a line."""
    free, matrix = result.free_parameters, result.correlation
    names = [f"{one.name} {one.label(len(labels))}".rstrip() for one in free]
    # A grey k_s is one number in all channels.
    strong = [
        (abs(matrix[i, j]), i, j)
        for i, j in np.argwhere(np.tril(np.abs(matrix) > STRONG, -1))
        if free[i].name != free[j].name or abs(matrix[i, j]) < 1 - 1e-9
    ]
    strong = sorted(strong, reverse=True)[:MOST_CORRELATIONS]
    words = [f"{names[j]} and {names[i]} {matrix[i, j]:+.2f}" for _, i, j in strong]
    return [f"  correlated  {', '.join(words)}"] if words else []


def _candidates(candidates):
    width = max(len(one.name) for one in candidates)
    lines = [
        "  what the scene requires (squared error expected on held-out pixels, over the best, in noise variances):",
        f"    {'model':<{width}}{'unknowns':>9}{'rms':>11}{'held out':>11}{'excess ± its error':>26}{'BIC':>12}",
    ]
    for one in candidates:
        mark = "  <- chosen" if one.chosen else "  adequate" if one.excess <= one.excess_error else ""
        excess = f"{one.excess:.1f} ± {one.excess_error:.1f}" if one.excess < 1e6 else f"{one.excess:.2e}"
        bic = f"{one.bic:.1f}" if one.bic < 1e6 else f"{one.bic:.2e}"
        errors = f"{one.rms:>11.3e}{one.held_out:>11.3e}{excess:>26}{bic:>12}"
        lines.append(f"    {one.name:<{width}}{one.unknowns:>9}{errors}{mark}".rstrip())
    return lines
