"""Times each peer in a process of its own, so that neither threads nor memory of one burden the next."""

import multiprocessing
import multiprocessing.connection
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks import engine
from benchmarks.peers import problem as problems
from benchmarks.peers.catalogue import PEERS, Peer
from benchmarks.peers.problem import ACCURACY, Problem, Run, Trace

# A fast run is repeated, and medians are taken.
REPEATS, ENOUGH = 9, 4.0  # runs, seconds in all
PASSES, PASSING = 3, 0.2  # before and after each run; seconds after which one is enough
# What loading a library, drawing the problem and compiling may take beside the runs.
PREPARATION = 120.0


def grow(peer: Peer, sizes: list[int], limit: float, known: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Time a peer at one size after the other, while a run stays within the limit.

    Args:
        peer: what to time.
        sizes: edges of the pictures in pixels.
        limit: seconds for one run; a size is left out where the size before says, by the pixels, that it would pass.
        known: rows of other sizes.

    Yields:
        A row for each size, with the reason where there is no time.
    """
    if peer.version is None:
        yield {"peer": peer.name, "missing": f"{peer.package} is not installed"}
        return
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    worker = context.Process(target=_serve, args=(there, peer.name, limit), daemon=True)
    worker.start()
    there.close()
    done = {row["size"]: row["seconds"] for row in known if row["peer"] == peer.name and "seconds" in row}
    for size in sorted(sizes):
        row = {"peer": peer.name, "version": peer.version, "size": size}
        before = max((other for other in done if other < size), default=None)
        if before and done[before] * (size / before) ** 2 > limit:
            told = f"not run: {done[before]:.3g} s at {before}² makes more than {limit:g} s"
            yield row | {"stopped": told}
            break
        here.send(size)
        row |= _answer(here, worker, limit)
        yield row
        if "seconds" not in row:
            break
        done[size] = row["seconds"]
    here.close()
    worker.join(5)
    if worker.is_alive():
        worker.kill()


def _answer(here: Any, worker: Any, limit: float) -> dict[str, Any]:
    """What the worker has to say, if it does in time."""
    if not here.poll(PREPARATION + REPEATS * limit):
        worker.kill()
        return {"stopped": f"no end after {PREPARATION + REPEATS * limit:g} s"}
    try:
        return here.recv()
    except EOFError:
        worker.join()
        return {"stopped": f"its process died with exit status {worker.exitcode}, as for want of memory"}


def _serve(channel: multiprocessing.connection.Connection, name: str, limit: float) -> None:
    """Time one peer at each size that is asked for."""
    while True:
        try:
            size = channel.recv()
        except EOFError:
            return
        try:
            row = _time(PEERS[name], problems.make(size), limit)
        except Exception as error:  # whatever a peer raises is what the table says of it
            row = {"stopped": f"{type(error).__name__}: {str(error).splitlines()[0][:200]}"}
        channel.send(row)


def _time(peer: Peer, problem: Problem, limit: float) -> dict[str, Any]:
    """Medians over the runs, each between passes over the same pixels."""
    run = peer.prepare(problem, limit)
    first = None
    if peer.compiled:
        first = engine.seconds(lambda: run(Trace()))
    cores = os.cpu_count() or 1
    timed = [_repeat(run, problem, threads) for threads in ({1, cores} if peer.threads else {cores})]
    return min(timed, key=lambda row: row["seconds"]) | {"first_seconds": first, "load": os.getloadavg()[0]}


def _repeat(run: Run, problem: Problem, threads: int) -> dict[str, Any]:
    """Run a few times on so many threads; passes always take all cores."""
    times, reached, units, memory = [], [], [], []
    while not times or (sum(times) < ENOUGH and len(times) < REPEATS):
        units += _passes(problem)
        before = engine.peak_memory(reset=True)
        # Small matrices are slowed by threads that wait for each other, the more so on a busy machine.
        with threadpool_limits(threads):
            trace = Trace()
            answer = run(trace)
            times.append(trace.elapsed())
        memory.append(engine.peak_memory() - before)
        reached.append(trace.reached(problem))
        units += _passes(problem)
    error = problem.error(np.asarray(answer.x, np.float64))
    return {
        "seconds": float(np.median(times)),
        "seconds_to_accuracy": None if None in reached else float(np.median(reached)),
        "pass_seconds": float(np.median(units)),
        "error": error if np.isfinite(error) else None,
        "converged": bool(error <= ACCURACY),
        "says": answer.says,
        "evaluations": len(trace.noted),
        "runs": len(times),
        "threads": threads,
        "memory_mb": max(memory),
    }


def _passes(problem: Problem) -> list[float]:
    """Seconds of a few passes."""
    arrays = problem.n_dot_l, problem.log_cos, problem.target
    times = [engine.seconds(lambda: engine.one_pass(*arrays))]
    while len(times) < PASSES and times[0] < PASSING:
        times.append(engine.seconds(lambda: engine.one_pass(*arrays)))
    return times
