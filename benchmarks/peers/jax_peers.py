"""Solvers compiled by JAX: jaxopt, optimistix on the whole image, and this project.

What is compiled is run before it is timed.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import brdf
import fitting
from benchmarks import engine
from benchmarks.peers.problem import NOISE, Answer, Problem, Run, Trace
from brdf.precision import Precision
from fitting.solver.profile import search

# Where a solver may stop: relative changes as small as sums in each precision can show.
TOLERANCE = {"float32": 1e-6, "float64": 1e-8}


def _residual(problem: Problem, dtype: str) -> tuple[Any, Any]:
    """The residual as a function of the unknowns and the arrays, and the arrays."""
    arrays = tuple(
        jnp.asarray(np.ascontiguousarray(a), dtype) for a in (problem.n_dot_l, problem.log_cos, problem.target.T)
    )

    def residual(x: Any, arrays: Any) -> Any:
        n_dot_l, log_cos, target = arrays
        columns = jnp.stack([jnp.ones_like(n_dot_l), n_dot_l, jnp.exp(jnp.exp(x[9]) * log_cos)])
        return (jnp.matmul(x[:9].reshape(3, 3).T, columns, precision="highest") - target).ravel()

    return residual, arrays


def _compiled(solve: Any, problem: Problem, dtype: str) -> Run:
    """Run a solver that is compiled as a whole; its evaluations are noted as they happen.

    Args:
        solve: from the residual, which notes, the start and the arrays to the answer and whether it converged.
        problem: to solve.
        dtype: of the arrays.
    """
    clock = [Trace()]
    with jax.enable_x64(dtype == "float64"):
        plain, arrays = _residual(problem, dtype)
        start = jnp.asarray(problem.start, dtype)

    def noting(x: Any, arrays: Any) -> Any:
        jax.debug.callback(lambda value: clock[0](value), x)
        return plain(x, arrays)

    whole = jax.jit(lambda start, arrays: solve(noting, start, arrays))

    def run(trace: Trace) -> Answer:
        clock[0] = trace
        with jax.enable_x64(dtype == "float64"):
            x, converged, steps = jax.block_until_ready(whole(start, arrays))
        jax.effects_barrier()
        return Answer(np.asarray(x, np.float64), f"{'converged' if converged else 'no end'} in {int(steps)} steps")

    return run


def optimistix(problem: Problem, dtype: str, method: str) -> Run:
    """Levenberg-Marquardt by normal equations, or BFGS on the mean square over the noise's variance.

    BFGS takes its first step for the gradient itself, and on the plain sum of many pixels that is far too long.
    """
    import lineax
    import optimistix

    size = TOLERANCE[dtype]
    if method == "lm":
        solver = optimistix.LevenbergMarquardt(rtol=size, atol=size, linear_solver=lineax.Normal(lineax.Cholesky()))
    else:
        solver = optimistix.BFGS(rtol=size, atol=size)
    scale = 1.0 if method == "lm" else 1 / (NOISE * problem.target.size**0.5)

    def solve(residual: Any, start: Any, arrays: Any) -> Any:
        def scaled(x: Any, arrays: Any) -> Any:
            return scale * residual(x, arrays)

        found = optimistix.least_squares(scaled, solver, start, arrays, max_steps=1000, throw=False)
        return found.value, found.result == optimistix.RESULTS.successful, found.stats["num_steps"]

    return _compiled(solve, problem, dtype)


def jaxopt(problem: Problem, dtype: str) -> Run:
    """Levenberg-Marquardt by normal equations."""
    import jaxopt

    size = TOLERANCE[dtype]

    def solve(residual: Any, start: Any, arrays: Any) -> Any:
        solver = jaxopt.LevenbergMarquardt(
            residual,
            maxiter=1000,
            stop_criterion="madsen-nielsen",
            xtol=size,
            gtol=size,
            solver="cholesky",
            materialize_jac=True,
            implicit_diff=False,
        )
        found = solver.run(start, arrays)
        return found.params, found.state.iter_num < 1000, found.state.iter_num

    return _compiled(solve, problem, dtype)


def this_engine(problem: Problem, dtype: str) -> Run:
    """The separable engine on prepared arrays: no start, the whole range of n."""
    picture = engine.on_device(problem.n_dot_l, problem.log_cos, problem.target, getattr(np, dtype))

    def run(trace: Trace) -> Answer:
        found = search([picture])
        x = np.append(found.x.ravel(), np.log(found.n))
        trace(x)
        return Answer(x, "converged")

    return run


def this_front_door(problem: Problem, dtype: Precision) -> Run:
    """All of ``fitting.fit``, from a normal map to error bars: no start, the whole range of n."""
    normal = engine.normals(problem.size)
    scene = brdf.Scene(
        points=brdf.SurfacePoints.from_normals(normal),
        ambient=[1.0] * 3,
        lights=[brdf.DirectionalLight(direction=engine.TO_LIGHT, intensity=[1.0] * 3)],
    )
    image = problem.target.reshape(problem.size, problem.size, 3).astype(dtype)

    def run(trace: Trace) -> Answer:
        material = fitting.fit(image, scene, model="blinn-phong", precision=dtype).material
        *k, n = (np.asarray(getattr(material, name), np.float64) for name in ("k_a", "k_d", "k_s", "n"))
        x = np.append(np.concatenate(k), np.log(n))
        trace(x)
        return Answer(x, "converged")

    return run
