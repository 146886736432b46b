"""The stability map: how far float32 is from float64, and whether every derivative is finite, over n and angle.

python -m benchmarks.stability stability.png
"""

import sys
from pathlib import Path

import numpy as np

import brdf
from fitting.report.material_plots import plot_stability


def main(path: Path) -> None:
    """Draw the maps of all models.

    Args:
        path: the picture to write.
    """
    maps = [brdf.stability_map(model) for model in brdf.MODELS.values()]
    for one in maps:
        broken = np.count_nonzero(~one.finite)
        print(f"{one.model:<24} largest error {one.error.max():.1e} of the peak, {broken} not finite")
    plot_stability(maps).savefig(path, dpi=120)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "stability.png"))
