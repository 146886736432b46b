"""Solvers that call NumPy: SciPy, lmfit, Ceres; all in float64."""

import os
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks.peers.problem import Answer, Problem, Run, Trace


def scipy(problem: Problem, method: str, analytic: bool) -> Run:
    """``scipy.optimize.least_squares`` with its own tolerances (1e-8); trf with k >= 0, lm knows no bounds."""
    bounds = (np.append(np.zeros(9), -np.inf), np.full(10, np.inf)) if method == "trf" else (-np.inf, np.inf)

    def run(trace: Trace) -> Answer:
        def residual(x: np.ndarray) -> np.ndarray:
            trace(x)
            return problem.residual(x)

        jacobian = problem.jacobian if analytic else "2-point"
        found = least_squares(residual, problem.start, jacobian, bounds, method)
        return Answer(found.x, found.message)

    return run


def lmfit(problem: Problem) -> Run:
    """``lmfit.minimize`` as its manual does it: k bounded below, MINPACK, numeric Jacobian, its own tolerances."""
    import lmfit

    names = [f"{k}{channel}" for k in ("k_a", "k_d", "k_s") for channel in range(3)] + ["log_n"]

    def run(trace: Trace) -> Answer:
        start = lmfit.Parameters()
        for name, value in zip(names, problem.start, strict=True):
            start.add(name, value=value, min=-np.inf if name == "log_n" else 0.0)

        def values(parameters: Any) -> np.ndarray:
            return np.array([parameters[name].value for name in names])

        def residual(parameters: Any) -> np.ndarray:
            x = values(parameters)
            trace(x)
            return problem.residual(x)

        found = lmfit.minimize(residual, start)
        return Answer(values(found.params), str(found.message))

    return run


def ceres(problem: Problem) -> Run:
    """Ceres through pyceres: one block of residuals, analytic Jacobian, dense normal equations, k >= 0."""
    import pyceres

    def run(trace: Trace) -> Answer:
        class Cost(pyceres.CostFunction):
            def __init__(self) -> None:
                pyceres.CostFunction.__init__(self)
                self.set_num_residuals(problem.target.size)
                self.set_parameter_block_sizes([10])

            def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802  # Ceres calls it so
                x = np.array(parameters[0])
                trace(x)
                residuals[:] = problem.residual(x)
                if jacobians is not None:
                    jacobians[0][:] = problem.jacobian(x).ravel()
                return True

        x = problem.start.copy()
        task, cost = pyceres.Problem(), Cost()
        task.add_residual_block(cost, None, [x])
        for index in range(9):
            task.set_parameter_lower_bound(x, index, 0.0)
        options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
        options.linear_solver_type = pyceres.LinearSolverType.DENSE_NORMAL_CHOLESKY
        options.num_threads = os.cpu_count() or 1
        options.function_tolerance = options.parameter_tolerance = 1e-8
        pyceres.solve(options, task, summary)
        return Answer(x, summary.BriefReport())

    return run
