"""A process of two that fit together over a mesh: rank, port, folder of the results, and when to be killed.

Run as a program by the tests; what it finds is written whole as ``RANK.npz``.
"""

import os
import signal
import sys
from pathlib import Path
from typing import NoReturn

import jax

rank, port, folder, how = int(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), sys.argv[4]
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=2, process_id=rank, heartbeat_timeout_seconds=20)

import numpy as np  # noqa: E402
from small_ball import SIZE, ball_scene, pictured  # noqa: E402

import brdf  # noqa: E402
import fitting  # noqa: E402
from fitting.solver import normal_equations  # noqa: E402


def told(error: brdf.InputError) -> NoReturn:
    """As the command does."""
    print(f"error: {error}", file=sys.stderr, flush=True)  # noqa: T201
    os._exit(2)


def killed_while_writing(file, **_):
    """What a band begins with, and no more."""
    file.write(b"PK")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)


if how == "maps die" and rank == 1:
    np.savez = killed_while_writing
if how == "dies" and rank == 1:
    gather, calls = normal_equations.gathered, []

    def killed(*arguments):
        """The second pass over the pixels is the last."""
        calls.append(0)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return gather(*arguments)

    normal_equations.gathered = killed

material = brdf.BlinnPhong(k_a=[0.2, 0.1, 0.15], k_d=[0.5, 0.4, 0.3], k_s=[0.3, 0.3, 0.4], n=35.0)
picture = pictured(material, ball_scene(), 0.01)
mesh = jax.make_mesh((jax.device_count(),), ("pixels",))
to_light = np.array([[0, 0, 1], [0.5, 0, 1], [0, 0.5, 1], [-0.5, 0, 1], [0, -0.5, 1], [0.2, 0.2, 1]])
photographs = np.random.default_rng(0).uniform(0.1, 0.9, (6, 4, 5, 3))
try:
    if how != "maps die":
        result = fitting.fit(picture, ball_scene(), model="blinn-phong", precision="float64", mesh=mesh)
    maps = fitting.fit_maps(photographs, to_light, np.ones((4, 5, 3)), mesh=mesh, keep=folder / "keep")
except brdf.InputError as error:
    told(error)
assert result.pixels < SIZE * SIZE
numbers = [[float(one), one.error] for one in result.parameters]
pictures = np.stack([picture, 0.5 * picture, 2 * picture])
layers = {f"maps {name}": values for name, values in maps.layers().items()}
many = fitting.fit_many(pictures, ball_scene(), model="blinn-phong", precision="float64", mesh=mesh)
with (folder / f"{rank}.part").open("wb") as file:
    np.savez(file, numbers=np.array(numbers), n=many.n, k_d=many.k_d, **layers)
(folder / f"{rank}.part").rename(folder / f"{rank}.npz")
