"""``--devices all``: every core or accelerator of the machine, and every process that a scheduler has started."""

import os
from typing import Any

from brdf.errors import InputError
from fitting.cli.common import use_compilation_cache

# By what Slurm, Open MPI and `jax.distributed` itself say how many processes there are.
PROCESSES = ("SLURM_NTASKS", "OMPI_COMM_WORLD_SIZE", "JAX_NUM_PROCESSES")


def all_devices(devices: str | None) -> Any:
    """The mesh of all devices; None where none is asked for.

    Args:
        devices: "all", or None.

    Raises:
        InputError: where it is something else.
    """
    if devices is None:
        return None
    if devices != "all":
        raise InputError("--devices", f"must be all, got {devices!r}", "Write --devices all, or leave it out")
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_force_host_platform_device_count" not in flags:
        # Of the host platform alone: where there is an accelerator it is that that is taken.
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={cores}".strip()
    use_compilation_cache()
    import jax

    if any(int(os.environ.get(name, "1")) > 1 for name in PROCESSES) and not jax.distributed.is_initialized():
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize()
    return jax.make_mesh((jax.device_count(),), ("pixels",))


def is_first_process(mesh: Any) -> bool:
    """Whether this process is the one that writes and prints.

    Args:
        mesh: of `all_devices`.
    """
    if mesh is None:
        return True
    import jax

    return jax.process_index() == 0
