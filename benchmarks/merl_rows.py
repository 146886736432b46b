"""Real materials: the 47 sound Blinn-Phong rows fitted to MERL by Ngan et al. (2005), rendered with noise and fitted.

Usage: python -m benchmarks.merl_rows [--size 512] [--noise 0.01] [--of brightest|mean|value] [--draws 1]

Noise is a share of the picture's brightest value, of its mean, or of each value. Told for each row: n and its 95 %
interval, whether the truth is inside, how many pixels carry the highlight, and whether a warning says that it is
smaller than a pixel. The data lie in the folder that BRDF_REAL_DATA names (default ../shared/data).
"""

import argparse
import csv
import os
from pathlib import Path

import numpy as np

import brdf
import fitting
from benchmarks.calibration import ball

TABLE = "merl/ngan2005_BlinnPhong_half.csv"
# MERL's scale of the channels, which the fits leave out.
CHANNELS = np.array([1.0, 1.15, 1.66])


def materials(folder: Path) -> dict[str, brdf.Material]:
    """The sound rows, as normalised Blinn-Phong: f = k_d / pi + k_s (n + 2) / (2 pi) (N.H)^n.

    Args:
        folder: of the real data.
    """
    found = {}
    with (folder / TABLE).open() as file:
        for row in csv.DictReader(file):
            if row["suspect"] == "1":
                continue
            k_d, k_s = (np.array([float(row[f"{term}_{c}"]) for c in "rgb"]) * CHANNELS for term in "ds")
            n = float(row["n"])
            k_s = k_s * (n + 2) / 2 / float(brdf.NormalizedBlinnPhong.scale(np.float64(n)))
            found[row["material"]] = brdf.NormalizedBlinnPhong(k_d=k_d, k_s=k_s, n=n)
    return found


def main() -> None:
    """Print a line for each row and the verdict."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--of", choices=["brightest", "mean", "value"], default="brightest")
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--precision", default="float32")
    given = parser.parse_args()
    scene = ball(given.size)
    inside, narrow, close = [], 0, 0
    for seed, (name, truth) in enumerate(materials(Path(os.environ.get("BRDF_REAL_DATA", "../shared/data"))).items()):
        clean = np.asarray(brdf.render(truth, scene, precision="float64"))
        size = {"brightest": clean.max(), "mean": clean[clean > 0].mean(), "value": clean}[given.of] * given.noise
        n = float(truth.n)  # pyright: ignore[reportAttributeAccessIssue]
        for draw in range(given.draws):
            random = np.random.default_rng([seed, draw])
            noisy = clean + size * random.standard_normal(clean.shape)
            result = fitting.fit(
                noisy, scene, model=truth.name, precision=given.precision, saturation=np.inf, n_range=(0.1, 1e7)
            )
            parameter = result.parameters[-1]
            low, high = parameter.interval or (0.0, np.inf)
            inside.append(low <= n <= high)
            if high / n - low / n < 0.02:
                narrow += 1
                close += parameter.value is not None and abs(parameter.value / n - 1) < 0.01
            told = "not determined" if parameter.value is None else f"{parameter.value:.5g}"
            small = "; smaller than a pixel" if any("smaller than a pixel" in text for text in result.warnings) else ""
            print(
                f"{name:<28} n {n:8.6g}: {told:>14}, 95 % {low:.5g} to {high:.5g}  {'' if inside[-1] else 'MISSED'}  "
                f"on {result.highlight_pixels or 0:.3g} pixels{small}"
            )
    print(f"inside the interval: {sum(inside)} of {len(inside)} ({100 * np.mean(inside):.1f} %)")
    print(f"interval within 1 %: {narrow}, of these n within 1 %: {close}")


if __name__ == "__main__":
    main()
