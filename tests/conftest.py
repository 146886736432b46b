"""Compiled programs are kept in out/compiled for all processes and the next run; docs/conf.py names the same folder."""

import atexit
import gc
import os
from pathlib import Path

import pytest
from project_paths import ROOT

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / "out" / "compiled"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# jaxlib warns of programs that it takes from there, see `fitting.cli.main`.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# A program that another process is just writing is compiled again.
os.environ.setdefault("PYTHONWARNINGS", "ignore:Error reading persistent compilation cache entry")
# Tracing makes many objects that live: to look for cycles as often as Python does is a fifth of what is not compiling.
gc.set_threshold(200_000, 20, 100)


@pytest.fixture(scope="module", autouse=True)
def few_pieces_of_memory():
    """Linux lets a process have 65,530, of which each compiled program takes a dozen: beyond them it crashes."""
    yield
    pieces = Path("/proc/self/maps")
    if pieces.exists() and pieces.read_bytes().count(b"\n") > 32_000:
        import jax  # what is set above holds when it loads

        jax.clear_caches()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A worker is not taken apart piece by piece at its end, which took several seconds of each."""
    if hasattr(session.config, "workerinput"):
        gc.freeze()
        atexit.register(os._exit, 0)
