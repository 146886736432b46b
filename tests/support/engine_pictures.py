"""Pictures of a ball as the engine takes them, and what they cost by plain NumPy and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

from brdf.lobes import Lobe
from fitting.solver.normal_equations import Picture

X = np.array([[0.05, 0.03, 0.02], [0.5, 0.3, 0.1], [0.3, 0.4, 0.5]])


def one_light_lobe(log_cos, weight):
    """The lobe of one light sample per pixel: ``weight * exp(n * log_cos)``, of (P,) and (P, C)."""
    return sum_of_lobes(log_cos[:, None], weight[:, None])


def sum_of_lobes(log_cos, weight):
    """Several samples, weights (P, S, C) and cosines (P, S)."""
    with jax.enable_x64(True):
        return Lobe.of_terms(((jnp.asarray(weight), jnp.asarray(log_cos)),))


def ball(size, lights):
    """N·L, logarithm of N·H and gate of each pixel of a sphere seen from +z, for each light; (L, P)."""
    at = (np.arange(size) + 0.5) / size * 2.2 - 1.1
    u, v = np.meshgrid(at, -at)
    on = u**2 + v**2 < 1
    normal = np.stack([u[on], v[on], np.sqrt(1 - u[on] ** 2 - v[on] ** 2)], axis=-1)
    cosines, logs, gates = [], [], []
    for to_light in lights:
        to_light = np.asarray(to_light) / np.linalg.norm(to_light)
        half = to_light + np.array([0, 0, 1])
        half = half / np.linalg.norm(half)
        near = np.minimum(np.sum(np.cross(normal, half) ** 2, axis=-1), 0.99)
        cosine = normal @ half
        logs.append(np.where(cosine > 0.5, 0.5 * np.log1p(-near), np.log(np.maximum(cosine, 1e-30))))
        cosines.append(np.maximum(normal @ to_light, 0))
        gates.append((normal @ to_light > 0) * 1.0)
    return np.stack(cosines), np.stack(logs), np.stack(gates)


def picture(size=64, n=80.0, x=X, noise=0.0, dtype=np.float64, light=(0.5, 0.6, 0.7), seed=0, **more):
    (cosine,), (log_cos,), (gate,) = ball(size, [light])
    basis = np.stack([np.ones_like(cosine), cosine, gate * np.exp(n * log_cos)])
    target = basis.T @ x
    target = target + noise * np.max(target) * np.random.default_rng(seed).standard_normal(target.shape)
    lobe = one_light_lobe(log_cos.astype(dtype), gate[:, None].astype(dtype))
    return Picture(target.astype(dtype), cosine[:, None].astype(dtype), lobe, **more)


def cost_of(pictures, n, x):
    """Sum of weighted squares of one or several pictures, channel by channel, in plain NumPy."""
    total = np.zeros(x.shape[1])
    for one in pictures:
        with jax.enable_x64(True):
            lobe = np.asarray(one.lobe(np.float64(n))[0], float)
        weight = np.ones((1, 1)) if one.weight is None else np.asarray(one.weight, float)
        weight = np.broadcast_to(weight if weight.ndim == 2 else weight[:, None], one.target.shape)
        model = x[0] * one.ambient + x[1] * np.asarray(one.diffuse, float) + x[2] * lobe
        residual = np.where(weight > 0, np.asarray(one.target, float) - model, 0)
        total += np.sum(weight * residual**2, axis=0)
    return total


def best_at(pictures, n):
    """Least cost at one exponent by SciPy's active-set solver."""
    total = 0.0
    for channel in range(pictures[0].target.shape[1]):
        rows, right = [], []
        for one in pictures:
            with jax.enable_x64(True):
                lobe = np.asarray(one.lobe(np.float64(n))[0], float)
            columns = [np.broadcast_to(one.ambient, channel + 1)[channel] * np.ones(len(lobe))]
            columns += [np.asarray(a, float)[:, min(channel, a.shape[1] - 1)] for a in (one.diffuse, lobe)]
            rows.append(np.stack(columns, axis=1))
            right.append(np.asarray(one.target, float)[:, channel])
        total += nnls(np.concatenate(rows), np.concatenate(right))[1] ** 2
    return total
