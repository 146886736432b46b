"""Descent on the gradient of the cost: PyTorch, Mitsuba 3.

The cost is the mean squared residual over the variance of the noise, so about 1 at the optimum.
"""

import math
from typing import Any

import numpy as np

from benchmarks.peers.problem import NOISE, Answer, Problem, Run, Trace

# A common choice for unknowns between 0 and 1, and the logarithm of n; no search for the best one.
RATE = 0.05
# Adam has no end of its own: it is called converged when this many steps lower the cost by less than this share.
PATIENCE, SHARE = 100, 1e-6


class Plateau:
    """Tells when the cost no longer falls."""

    def __init__(self, trace: Trace, limit: float) -> None:
        """Begin.

        Args:
            trace: its clock.
            limit: seconds after which to give up.
        """
        self.trace, self.limit = trace, limit
        self.costs: list[float] = []

    def says(self, cost: float) -> str | None:
        """Why to stop, if there is a reason."""
        self.costs.append(cost)
        if not math.isfinite(cost):
            return "the cost is not finite"
        if self.trace.elapsed() > self.limit:
            return "no end within the limit"
        steps = len(self.costs)
        if steps > 2 * PATIENCE:
            before, now = min(self.costs[:-PATIENCE]), min(self.costs[-PATIENCE:])
            if now > before * (1 - SHARE):
                return f"converged: no gain in {PATIENCE} of {steps} steps"
        return None


def torch(problem: Problem, dtype: str, method: str, limit: float) -> Run:
    """PyTorch on the CPU, eager: L-BFGS with the strong Wolfe search, or Adam."""
    import torch

    kind = getattr(torch, dtype)
    n_dot_l, log_cos, target = (
        torch.tensor(np.ascontiguousarray(a), dtype=kind) for a in (problem.n_dot_l, problem.log_cos, problem.target.T)
    )
    ambient = torch.ones_like(n_dot_l)

    def run(trace: Trace) -> Answer:
        x = torch.tensor(problem.start, dtype=kind, requires_grad=True)

        def cost() -> Any:
            trace(x.detach().numpy())
            columns = torch.stack([ambient, n_dot_l, torch.exp(torch.exp(x[9]) * log_cos)])
            return torch.mean((x[:9].reshape(3, 3).T @ columns - target) ** 2) / NOISE**2

        def descend() -> Any:
            optimiser.zero_grad()
            value = cost()
            value.backward()
            return value

        if method == "adam":
            optimiser = torch.optim.Adam([x], lr=RATE)
            plateau, says = Plateau(trace, limit), None
            while says is None:
                says = plateau.says(optimiser.step(descend).item())
        else:
            smallest = float(torch.finfo(kind).eps)
            optimiser = torch.optim.LBFGS(
                [x], max_iter=500, tolerance_grad=1e-6, tolerance_change=smallest, line_search_fn="strong_wolfe"
            )
            optimiser.step(descend)
            steps = optimiser.state[x]["n_iter"]
            says = "no end in 500 steps" if steps >= 500 else f"converged in {steps} steps"
        return Answer(x.detach().numpy(), says)

    return run


def mitsuba(problem: Problem, limit: float) -> Run:
    """Mitsuba's Adam on Dr.Jit arrays compiled by LLVM, float32: its optimiser at its best, since no ray is traced."""
    import drjit
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    n_dot_l, log_cos = (mitsuba.Float(a.astype(np.float32)) for a in (problem.n_dot_l, problem.log_cos))
    target = [mitsuba.Float(np.ascontiguousarray(a, np.float32)) for a in problem.target.T]

    def run(trace: Trace) -> Answer:
        names = [f"x{index}" for index in range(10)]
        optimiser = mitsuba.ad.Adam(
            lr=RATE, params={name: mitsuba.Float(value) for name, value in zip(names, problem.start, strict=True)}
        )
        plateau, says = Plateau(trace, limit), None
        while True:
            x = [optimiser[name] for name in names]
            trace([one[0] for one in drjit.detach(x)])
            lobe = drjit.exp(drjit.exp(x[9]) * log_cos)
            cost = mitsuba.Float(0.0)
            for channel in range(3):
                shown = x[channel] + x[3 + channel] * n_dot_l + x[6 + channel] * lobe
                cost += drjit.mean(drjit.square(shown - target[channel]))
            cost /= 3 * NOISE**2
            drjit.backward(cost)
            says = plateau.says(float(drjit.detach(cost)[0]))
            if says:
                return Answer([one[0] for one in drjit.detach(x)], says)
            optimiser.step()

    return run
