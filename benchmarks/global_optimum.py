"""Is the optimum global? Random problems, each also given to SciPy from many starts.

    python -m benchmarks.global_optimum                                # 1 000 problems, 30 starts each
    python -m benchmarks.global_optimum --record out/optima.jsonl      # goes on where a run was cut off
    python -m benchmarks.global_optimum --sizes 128 --problems 50      # pictures that the search takes subsamples of

A problem is a ball under 1 to 3 directional lights, Phong or Blinn-Phong: n log-uniform in 0.3 to 1e5, k_s log-uniform
in 1e-3 to 1, noise up to 5 % of the brightest pixel (none at all in every twentieth), some k 0. `fitting.fit` gets the
picture and the scene. SciPy's ``least_squares`` (trf, bounded, analytic Jacobian, all ten unknowns) starts from 30
exponents log-uniform in the whole range, each with the best non-negative k of that exponent, and the best of the 30
starts again from where it stopped. Neither looks at exponents so high that no pixel shows more than exp(-60) of the
highlight's peak, where k_s would have no meaning. Both costs are taken by the same NumPy formula, which shares no code
with the fit; the fit's is that of `result.optimum`, since the material leaves out what noise hides.

A loss is a cost above (1 + 1e-6) times SciPy's. Without noise both costs are rounding, so a residual of 1e-7 of the
picture is allowed beside that. The exit status is 1 if there is a loss, a failure or a number that is not finite.
"""

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares, nnls

import brdf
import fitting

N_RANGE = (0.1, 1e6)
WIDTH = 2.2  # of the picture, where the ball's radius is 1
AMBIENT = 0.5
TOLERANCE = 1e-6
ROUNDING = 1e-7  # residual, relative to the picture
UNSEEN = 60.0  # logarithm of what a highlight may lose up to the nearest pixel, as in `fitting.fit`
REACHED = 1e-4  # a start that ends within this of the least cost has found the optimum


class Problem(NamedTuple):
    """A picture of a ball and what it shows.

    Attributes:
        scene: for the fit.
        model: "phong" or "blinn-phong".
        image: linear values.
        pixels: which of them show the ball.
        ambient_diffuse: the two basis images that do not depend on the exponent.
        log_cos: logarithm of the lobe's cosine for each light; -inf where there is no reflection.
        intensity: of each light.
    """

    scene: brdf.Scene
    model: str
    image: Float[np.ndarray, "H W 3"]
    pixels: Any
    ambient_diffuse: Float[np.ndarray, "P 2"]
    log_cos: Float[np.ndarray, "P L"]
    intensity: Float[np.ndarray, " L"]

    @property
    def target(self) -> Float[np.ndarray, "P 3"]:
        """The pixels of the ball."""
        return self.image[self.pixels]

    def basis(self, n: float, peak: float = 0.0) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, " P"]]:
        """Ambient, diffuse, lobe, and the lobe's derivative by log n; the lobe over its value where log cos = peak."""
        seen = np.isfinite(self.log_cos)
        exponent = np.where(seen, self.log_cos - peak, 0.0)
        lobes = np.where(seen, self.intensity * np.exp(n * exponent), 0.0)
        slope = n * np.sum(lobes * exponent, axis=1)
        return np.column_stack([self.ambient_diffuse, lobes.sum(axis=1)]), slope

    def cost(self, k: Float[np.ndarray, "3 3"], n: float) -> float:
        """Sum of squared residuals; rows of ``k`` are k_a, k_d, k_s."""
        return float(np.sum((self.basis(n)[0] @ k - self.target) ** 2))


def ball_normals(size: int) -> tuple[Any, Float[np.ndarray, "P 3"]]:
    """Which pixels of a square picture show the unit ball, and its normals there."""
    at = ((np.arange(size) + 0.5) / size - 0.5) * WIDTH
    x, y = np.meshgrid(at, -at)
    inside = x**2 + y**2 < 1
    return inside, np.stack([x, y, np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))], axis=-1)[inside]


def make(seed: int, index: int, size: int) -> Problem:
    """Draw a problem."""
    random = np.random.default_rng([seed, index])
    model = random.choice(["phong", "blinn-phong"])
    count = random.integers(1, 4)
    to_light = random.standard_normal((count, 3))
    to_light[:, 2] = np.abs(to_light[:, 2]) + 0.2
    to_light /= np.linalg.norm(to_light, axis=1, keepdims=True)
    intensity = random.uniform(0.3, 1.0, count)
    n = math.exp(random.uniform(math.log(0.3), math.log(1e5)))
    k = np.stack([random.uniform(0, 1, 3), random.uniform(0, 1, 3), np.exp(random.uniform(math.log(1e-3), 0, 3))])
    k *= np.array([random.random() > 0.2, random.random() > 0.1, 1.0])[:, None]
    noise = 0.0 if index % 20 == 0 else random.uniform(0, 0.05)
    pixels, normal = ball_normals(size)
    n_dot_l = normal @ to_light.T
    to_view = np.array([0.0, 0.0, 1.0])
    if model == "phong":
        mirror = 2 * n_dot_l[..., None] * normal[:, None, :] - to_light
        apart, cosine = np.sum((mirror - to_view) ** 2, axis=-1), mirror @ to_view
    else:
        half = to_light + to_view
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        apart, cosine = np.sum((normal[:, None, :] - half) ** 2, axis=-1), normal @ half.T
    # 1 - cos = |a - b|^2 / 2 without cancellation near the peak.
    seen = (n_dot_l > 0) & (cosine > 0)
    log_cos = np.where(seen, np.log1p(-np.where(seen, apart, 0.0) / 2), -np.inf)
    diffuse = np.maximum(n_dot_l, 0) @ intensity
    problem = Problem(
        scene=brdf.Scene(
            camera=brdf.OrthographicCamera(
                position=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), width=WIDTH, resolution=(size, size)
            ),
            shapes=(brdf.Sphere(center=(0, 0, 0), radius=1.0),),
            ambient=[AMBIENT] * 3,
            lights=[
                brdf.DirectionalLight(direction=one, intensity=[strength] * 3)
                for one, strength in zip(to_light, intensity, strict=True)
            ],
        ),
        model=model,
        image=np.zeros((size, size, 3)),
        pixels=pixels,
        ambient_diffuse=np.column_stack([np.full_like(diffuse, AMBIENT), diffuse]),
        log_cos=log_cos,
        intensity=intensity,
    )
    clean = problem.basis(n)[0] @ k
    problem.image[pixels] = clean + noise * clean.max() * random.standard_normal(clean.shape)
    return problem


def best_of_scipy(problem: Problem, starts: int, random: np.random.Generator) -> list[float]:
    """The cost where each start ended; the last is the best of them, started again."""
    target = problem.target
    count = target.size // 3
    # Relative to the brightest pixel's, so that k_s keeps to one scale where no pixel sees the highlight's centre.
    peak = float(np.max(problem.log_cos))

    def residual(x: np.ndarray) -> np.ndarray:
        return (problem.basis(math.exp(x[9]), peak)[0] @ x[:9].reshape(3, 3) - target).T.ravel()

    def jacobian(x: np.ndarray) -> np.ndarray:
        columns, slope = problem.basis(math.exp(x[9]), peak)
        found = np.zeros((3, count, 10))
        for channel in range(3):
            found[channel, :, channel:9:3] = columns
            found[channel, :, 9] = slope * x[6 + channel]
        return found.reshape(-1, 10)

    low, high = math.log(N_RANGE[0]), math.log(min(N_RANGE[1], -UNSEEN / min(peak, -1e-300)))
    bounds = np.append(np.zeros(9), low), np.append(np.full(9, np.inf), high)
    tolerances = {"ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-14, "max_nfev": 300}

    def run(x: np.ndarray) -> Any:
        return least_squares(residual, x, jacobian, bounds=bounds, method="trf", **tolerances)

    costs, best = [], None
    for log_n in random.uniform(low, high, starts):
        columns, _ = problem.basis(math.exp(log_n), peak)
        k = np.stack([nnls(columns, target[:, channel])[0] for channel in range(3)], axis=1)
        # trf starts inside the bounds.
        found = run(np.append(np.maximum(k, 1e-6).ravel(), log_n))
        costs.append(2 * found.cost)
        if best is None or found.cost < best.cost:
            best = found
    return costs if best is None else [*costs, 2 * run(best.x).cost]


def study(seed: int, index: int, size: int, starts: int) -> dict[str, Any]:
    """Solve one problem both ways."""
    problem = make(seed, index, size)
    begin = time.perf_counter()
    try:
        # Told that nothing is clipped: the largest value of a noisy picture is no plateau.
        result = fitting.fit(
            problem.image,
            problem.scene,
            model=problem.model,
            precision="float64",
            mask=problem.pixels,
            saturation=np.inf,
            n_range=N_RANGE,
        )
    except Exception as error:  # whatever it is, it is a failure to be counted
        return {"index": index, "failure": f"{type(error).__name__}: {error}"}
    seconds = time.perf_counter() - begin
    optimum = result.optimum
    numbers = [optimum.n, optimum.x, optimum.cost, *(getattr(result.material, k) for k in ("k_a", "k_d", "k_s", "n"))]
    stated = [v for one in result.parameters for v in (one.value, one.error) if v is not None]
    ours = problem.cost(optimum.x, optimum.n)
    begin = time.perf_counter()
    costs = best_of_scipy(problem, starts, np.random.default_rng([seed, index, 1]))
    least = min(costs)
    allowed = ROUNDING**2 * float(np.sum(problem.target**2))
    return {
        "index": index,
        "size": size,
        "model": problem.model,
        "n": optimum.n,
        "finite": bool(all(np.all(np.isfinite(np.asarray(value, float))) for value in [*numbers, *stated])),
        "cost": ours,
        "scipy": least,
        "allowed": allowed,
        "lost": bool(not ours <= (1 + TOLERANCE) * least + allowed),
        "won": bool(least > (1 + TOLERANCE) * ours + allowed),
        "reached": int(sum(cost <= (1 + REACHED) * min(least, ours) + allowed for cost in costs[:starts])),
        "seconds": seconds,
        "scipy_seconds": time.perf_counter() - begin,
    }


def report(rows: list[dict[str, Any]], starts: int) -> bool:
    """Print what came out; whether all is well."""
    failures = [row for row in rows if "failure" in row]
    solved = [row for row in rows if "failure" not in row]
    lost = [row for row in solved if row["lost"]]
    broken = [row for row in solved if not row["finite"]]
    for row in failures:
        print(f"  problem {row['index']} failed: {row['failure']}")
    for row in lost:
        excess = row["cost"] / row["scipy"] - 1
        print(f"  problem {row['index']}, {row['size']}², lost: n = {row['n']:.6g}, cost {excess:.2e} above SciPy's")
    print(f"{len(rows)} problems: lost {len(lost)}, failed {len(failures)}, not finite {len(broken)}")
    if solved:
        noisy = [row["cost"] / row["scipy"] - 1 for row in solved if row["scipy"] > 100 * row["allowed"]]
        reached = np.array([row["reached"] for row in solved])
        print(
            f"cost over SciPy's best of {starts} starts, less 1: at most {max(noisy, default=math.nan):.1e}; "
            f"SciPy's best was the worse one in {sum(row['won'] for row in solved)}"
        )
        print(
            f"of {starts} starts {np.median(reached):.0f} found the optimum in the median, "
            f"fewer than 3 in {np.count_nonzero(reached < 3)} problems, none in {np.count_nonzero(reached == 0)}"
        )
        mine, theirs = (np.median([row[key] for row in solved]) for key in ("seconds", "scipy_seconds"))
        print(f"median time of the fit {1e3 * mine:.1f} ms, of SciPy's starts {1e3 * theirs:.0f} ms")
    return not (failures or lost or broken)


def main() -> int:
    """Solve the problems that are not on record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=1000)
    parser.add_argument("--starts", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sizes", type=int, nargs="+", default=[24, 32], help="of the pictures, in turn")
    parser.add_argument("--record", type=Path, help="JSON lines; problems found there are not solved again")
    given = parser.parse_args()
    known: dict[int, dict[str, Any]] = {}
    if given.record and given.record.exists():
        known = {row["index"]: row for row in map(json.loads, given.record.read_text().splitlines())}
    for index in range(given.problems):
        if index not in known:
            known[index] = study(given.seed, index, given.sizes[index % len(given.sizes)], given.starts)
            if given.record:
                given.record.parent.mkdir(parents=True, exist_ok=True)
                with given.record.open("a") as file:
                    file.write(json.dumps(known[index]) + "\n")
    return 0 if report([known[index] for index in range(given.problems)], given.starts) else 1


if __name__ == "__main__":
    sys.exit(main())
