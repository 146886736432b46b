"""What the separable engine costs, in passes.

One pass is the least that anything that looks at all pixels in NumPy can do: in float64, over the same pixels,
``s = exp(n * log_cos); A = stack([1, N.L, s]); A @ A.T; A @ target``. Both are timed in turn, so a change of the
machine's speed touches both alike, and the ratio of the medians is printed.

    python -m benchmarks.engine                      # 512 x 512 in float32 and float64
    python -m benchmarks.engine --sizes 64 512 4096 --repeats 10
    python -m benchmarks.engine --parts              # where the time goes
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from brdf.lobes import Lobe
from fitting.solver import normal_equations, profile, refinement, subsample
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import search

N = 80.0
TO_LIGHT = np.array([0.5, 0.6, 0.7]) / np.linalg.norm([0.5, 0.6, 0.7])
X = np.array([[0.05, 0.03, 0.02], [0.5, 0.3, 0.1], [0.3, 0.4, 0.5]])


def normals(size: int) -> np.ndarray:
    """Normals of a rectangular picture full of directions, a paraboloid, (size, size, 3)."""
    at = np.linspace(-0.8, 0.8, size)
    slope_u, slope_v = np.meshgrid(at, at)
    return np.stack([slope_u, slope_v, np.ones_like(slope_u)], -1) / np.sqrt(1 + slope_u**2 + slope_v**2)[..., None]


def cosines(size: int) -> tuple[np.ndarray, np.ndarray]:
    """N.L and log(N.H) of those normals under one directional light, the view along z."""
    half = TO_LIGHT + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    normal = normals(size).reshape(-1, 3)
    # |N - H|^2 / 2 = 1 - N.H without cancellation near the peak.
    return np.maximum(normal @ TO_LIGHT, 0), np.log1p(-np.sum((normal - half) ** 2, axis=1) / 2)


def observe(size: int, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """N.L, log(N.H) and the noisy target over the pixels, in float64."""
    n_dot_l, log_cos = cosines(size)
    target = (X.T @ np.stack([np.ones_like(n_dot_l), n_dot_l, np.exp(N * log_cos)])).T
    return n_dot_l, log_cos, target + noise * np.random.default_rng(0).standard_normal(target.shape)


def one_pass(n_dot_l: np.ndarray, log_cos: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit: the least that anything that looks at all pixels in NumPy can do."""
    columns = np.stack([np.ones_like(n_dot_l), n_dot_l, np.exp(N * log_cos)])
    return columns @ columns.T, columns @ target


def on_device(n_dot_l: np.ndarray, log_cos: np.ndarray, target: np.ndarray, dtype: type) -> Picture:
    """The arrays of the engine."""
    with jax.enable_x64(True):
        kept = [jax.device_put(a.astype(dtype)) for a in (np.ones((log_cos.size, 1, 1)), log_cos[:, None])]
        lobe = Lobe.of_terms((tuple(kept),))
        return Picture(*(jax.device_put(a.astype(dtype)) for a in (target, n_dot_l[:, None])), lobe)


def prepare(size: int, noise: float, dtype: type) -> tuple[Picture, Callable[[], Any]]:
    """The arrays of the engine on the device, and the pass over the same pixels."""
    arrays = observe(size, noise)
    return on_device(*arrays, dtype), lambda: one_pass(*arrays)


def peak_memory(*, reset: bool = False) -> float:
    """Largest resident memory since the last reset, in MB, as Linux counts it; not a number elsewhere."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        status = Path("/proc/self/status").read_text()
    except OSError:
        return float("nan")
    return next(float(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024


def seconds(run: Callable[[], Any]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def parts(picture: Picture, repeats: int) -> None:
    """Print the time spent in each function of the engine."""
    spent: dict[str, list[float]] = {}

    def timed(module: Any, name: str) -> None:
        inner = getattr(module, name)

        def outer(*arguments: Any, **more: Any) -> Any:
            start = time.perf_counter()
            result = jax.block_until_ready(inner(*arguments, **more))
            spent.setdefault(name, []).append(time.perf_counter() - start)
            return result

        setattr(module, name, outer)

    for module, name in [
        (profile, "subsample"),
        (subsample, "_lobes"),
        (profile, "_sampling_errors"),
        (profile, "gauss_newton"),
        (profile, "solve_linear"),
        (refinement, "solve_linear"),
        (normal_equations, "_pass"),
        (normal_equations, "_unpack"),
    ]:
        timed(module, name)
    search([picture])
    spent.clear()
    for _ in range(repeats):
        search([picture])
    for name, times in spent.items():
        print(f"    {name:18} {1e3 * sum(times) / repeats:8.3f} ms in {len(times) / repeats:.1f} calls")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[512], help="edge lengths in pixels")
    parser.add_argument("--noise", type=float, default=0.01, help="standard deviation, the brightest pixel being 1.4")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--parts", action="store_true", help="where the time goes")
    options = parser.parse_args()
    print(" size   dtype    first s   ms    passes  ns/pixel   error of n, x without noise   memory above start MB")
    for size in options.sizes:
        for dtype in (np.float32, np.float64):
            exact, _ = prepare(size, 0.0, dtype)
            found = search([exact])
            error = max(abs(found.n / N - 1), float(np.max(np.abs(found.x / X - 1))))
            del exact
            picture, one_pass = prepare(size, options.noise, dtype)
            jax.clear_caches()
            before = peak_memory(reset=True)
            first = seconds(lambda picture=picture: search([picture]))
            memory = peak_memory() - before
            pairs = [(seconds(one_pass), seconds(lambda p=picture: search([p]))) for _ in range(options.repeats)]
            unit, mine = np.median(np.array(pairs), axis=0)
            print(
                f"{size:5}  {dtype.__name__:8} {first:7.2f} {1e3 * mine:8.2f} {mine / unit:7.2f}"
                f" {1e9 * mine / size**2:8.1f}    {error:20.1e} {memory:22.0f}",
                flush=True,
            )
            if options.parts:
                parts(picture, options.repeats)


if __name__ == "__main__":
    sys.exit(main())
