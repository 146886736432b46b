"""The peers by name, and how each is set up."""

import importlib.metadata
from collections.abc import Callable
from typing import NamedTuple

from benchmarks.peers.problem import Problem, Run


class Peer(NamedTuple):
    """A solver in one precision.

    Attributes:
        name: in the table.
        package: that it needs, as it is installed.
        prepare: from the problem and the seconds it may take to what is timed.
        colour: of its package in the plot.
        line: style of its line.
        marker: on its line.
        compiled: for each size, in a first run that is not timed.
        threads: whether it takes as many threads as it is told; both one and all are tried, and the faster counts.
    """

    name: str
    package: str
    prepare: Callable[[Problem, float], Run]
    colour: str
    line: str
    marker: str
    compiled: bool = False
    threads: bool = False

    @property
    def version(self) -> str | None:
        """What is installed; None if nothing is."""
        try:
            return importlib.metadata.version(self.package)
        except importlib.metadata.PackageNotFoundError:
            return None


# Okabe and Ito 2008: told apart with any kind of colour vision.
BLACK, ORANGE, SKY, GREEN, BLUE, RED, PURPLE, GREY = (
    "#000000 #E69F00 #56B4E9 #009E73 #0072B2 #D55E00 #CC79A7 #888888".split()
)


def _scipy(method: str, analytic: bool) -> Callable[[Problem, float], Run]:
    def prepare(problem: Problem, limit: float) -> Run:
        from benchmarks.peers.numpy_peers import scipy

        return scipy(problem, method, analytic)

    return prepare


def _numpy(name: str) -> Callable[[Problem, float], Run]:
    def prepare(problem: Problem, limit: float) -> Run:
        from benchmarks.peers import numpy_peers

        return getattr(numpy_peers, name)(problem)

    return prepare


def _torch(dtype: str, method: str) -> Callable[[Problem, float], Run]:
    def prepare(problem: Problem, limit: float) -> Run:
        from benchmarks.peers.gradient_peers import torch

        return torch(problem, dtype, method, limit)

    return prepare


def _mitsuba(problem: Problem, limit: float) -> Run:
    from benchmarks.peers.gradient_peers import mitsuba

    return mitsuba(problem, limit)


def _jax(name: str, *how: str) -> Callable[[Problem, float], Run]:
    def prepare(problem: Problem, limit: float) -> Run:
        from benchmarks.peers import jax_peers

        return getattr(jax_peers, name)(problem, *how)

    return prepare


# Rows of the table; fields that are the same for all of a package come last.
OURS = tuple(
    Peer(f"{title}, {dtype}", "brdf-fitting", _jax(name, dtype), colour, line, "o", compiled=True)
    for title, name, colour in (("engine", "this_engine", RED), ("fitting.fit", "this_front_door", ORANGE))
    for dtype, line in (("float32", "-"), ("float64", "--"))
)
TRF = "SciPy trf, analytic"
_SCIPY = tuple(
    Peer(f"SciPy {method}, {title}", "scipy", _scipy(method, title == "analytic"), BLUE, line, "s", threads=True)
    for method, title, line in (
        ("trf", "analytic", "-"),
        ("trf", "numeric", "--"),
        ("lm", "analytic", ":"),
        ("lm", "numeric", "-."),
    )
)
_TORCH = tuple(
    Peer(f"PyTorch {title}, {dtype}", "torch", _torch(dtype, method), PURPLE, line, "^", threads=True)
    for title, method, dtype, line in (
        ("L-BFGS", "lbfgs", "float32", "-"),
        ("L-BFGS", "lbfgs", "float64", "--"),
        ("Adam", "adam", "float32", ":"),
    )
)
_JAXOPT = tuple(
    Peer(f"jaxopt LM, {dtype}", "jaxopt", _jax("jaxopt", dtype), GREY, line, "D", compiled=True)
    for dtype, line in (("float32", "-"), ("float64", "--"))
)
_OPTIMISTIX = tuple(
    Peer(
        f"optimistix {title}, {dtype}", "optimistix", _jax("optimistix", dtype, method), GREEN, line, "v", compiled=True
    )
    for title, method, dtype, line in (
        ("LM", "lm", "float32", "-"),
        ("LM", "lm", "float64", "--"),
        ("BFGS", "bfgs", "float32", ":"),
        ("BFGS", "bfgs", "float64", "-."),
    )
)
OTHERS = (
    *_SCIPY,
    Peer("lmfit leastsq", "lmfit", _numpy("lmfit"), SKY, "-", "P", threads=True),
    Peer("Ceres LM", "pyceres", _numpy("ceres"), BLACK, "-", "X", threads=True),
    *_TORCH,
    Peer("Mitsuba 3 Adam, float32", "mitsuba", _mitsuba, BLACK, ":", "*", compiled=True),
    *_JAXOPT,
    *_OPTIMISTIX,
)
PEERS = {peer.name: peer for peer in (*OURS, *OTHERS)}
