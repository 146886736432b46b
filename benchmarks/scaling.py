"""Weak and strong scaling of a fit over one and two processes, and a model on paper of 64 nodes.

Usage: python -m benchmarks.scaling [--size 1024] [--repeats 5]

Each process has one device and calls `fitting.fit(mesh=...)`; sums cross through gloo. Strong: the same picture; weak:
as many pixels for each process. On a machine whose cores are busy, or fewer than the processes, it says little, so the
load is printed. The model: t = P / (D r) + passes (α log2 D + bytes / β) + h, with the rate r, the host's part h and
the gather's α measured here; β is that of a network of 10 Gbit/s. It holds for the passes: what each process looks at
for the whole picture, which pixels count and how neighbours err, is not shortened by more of them.
"""

import argparse
import json
import math
import os
import socket
import subprocess
import sys
import time

import numpy as np

PASSES, BANDWIDTH, CHANNELS = 5, 1.25e9, 3
NODES, CORES, PIXELS = 64, 32, 4e9


def work(rank: int, processes: int, port: int, rows: list[tuple[int, int]], repeats: int) -> None:
    """What one process does: print the median time of a fit for each size, and that of a gather."""
    import jax

    if processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=processes, process_id=rank)
    import brdf
    import fitting
    from fitting.solver.devices import gathered, spread_over

    mesh = jax.make_mesh((processes,), ("pixels",))
    material = brdf.BlinnPhong(k_a=[0.1, 0.2, 0.3], k_d=[0.5, 0.4, 0.3], k_s=[0.3, 0.35, 0.4], n=50.0)

    def median(run) -> float:
        run()
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            run()
            times.append(time.perf_counter() - start)
        return float(np.median(times))

    found = []
    for height, width in rows:
        camera = brdf.OrthographicCamera(
            position=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), width=2.2 * width / height, resolution=(width, height)
        )
        light = brdf.DirectionalLight(direction=(0.5, 0.6, 0.7), intensity=1.0)
        scene = brdf.Scene(camera=camera, shapes=[brdf.Sphere(center=(0, 0, 0), radius=1)], ambient=1.0, lights=[light])
        picture = np.asarray(brdf.render(material, scene))
        picture = picture + np.float32(0.01) * np.random.default_rng(0).standard_normal(picture.shape, np.float32)
        found.append(median(lambda p=picture, s=scene: fitting.fit(p, s, model="blinn-phong", mesh=mesh)))
    with spread_over(mesh):
        sums = np.zeros((1, 22 * CHANNELS))
        gather = median(lambda: gathered({rank: sums}, processes, sums.shape))
    if rank == 0:
        print(json.dumps({"fits": found, "gather": gather}))


def run(processes: int, rows: list[tuple[int, int]], repeats: int) -> dict:
    """Start the processes, and what the first of them found."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "benchmarks.scaling", "--work", json.dumps([rank, processes, port, rows, repeats])],
            stdout=subprocess.PIPE,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            text=True,
        )
        for rank in range(processes)
    ]
    said = [one.communicate()[0] for one in started]
    return json.loads(said[0].splitlines()[-1])


def main() -> None:
    """Print the table and the model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--work", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        work(*json.loads(given.work))
        return
    size = given.size
    rows = [(size // 8, size // 8), (size, size), (size, 2 * size)]
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors", flush=True)
    one, two = (run(processes, rows, given.repeats) for processes in (1, 2))
    (host, single, double), (_, halved, weak) = one["fits"], two["fits"]
    print(f"strong, {size}²: one process {1e3 * single:.0f} ms, two {1e3 * halved:.0f} ms: {single / halved:.2f} times")
    print(
        f"weak, {size}² each: one process {1e3 * single:.0f} ms, two {1e3 * weak:.0f} ms: "
        f"efficiency {single / weak:.2f}; one process for both {1e3 * double:.0f} ms"
    )
    print(f"a gather of two: {1e6 * two['gather']:.0f} µs; a picture of {size // 8}² takes {1e3 * host:.0f} ms")
    rate = size**2 / max(double - single, 1e-9)
    print(f"model: r = {rate:.2e} pixels/s a process, h = {1e3 * host:.0f} ms, α = {1e6 * two['gather']:.0f} µs")
    for nodes in (1, 2, 8, NODES):
        devices = nodes * CORES
        gather = PASSES * (two["gather"] * math.log2(max(devices, 2)) + 8 * 22 * CHANNELS * devices / BANDWIDTH)
        pixels = PIXELS / (devices * rate)
        print(
            f"  {nodes:3} nodes of {CORES} cores, {PIXELS:.0e} pixels: {pixels:8.2f} s of pixels + {gather:.3f} s of "
            f"gathers + {host:.3f} s = {pixels + gather + host:.2f} s"
        )


if __name__ == "__main__":
    main()
