"""Fits over several devices, and over two processes, give the numbers of one; a process that dies is told."""

import dataclasses
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from project_paths import ROOT
from small_ball import CAMERA, ball_scene, pictured

import brdf
import fitting

MATERIAL = brdf.BlinnPhong(k_a=[0.2, 0.1, 0.15], k_d=[0.5, 0.4, 0.3], k_s=[0.3, 0.3, 0.4], n=35.0)
PATH = os.pathsep.join([str(ROOT), str(ROOT / "tests/support")])


def numbers(result: fitting.FitResult) -> np.ndarray:
    return np.array([[float(one), one.error] for one in result.parameters])


def expected() -> np.ndarray:
    picture = pictured(MATERIAL, ball_scene(), 0.01)
    return numbers(fitting.fit(picture, ball_scene(), model="blinn-phong", precision="float64"))


def codes() -> np.ndarray:
    clean = pictured(MATERIAL, ball_scene())
    return np.round(250 * clean / np.max(clean)).astype(np.uint8)


def run_two(folder: Path, how: str) -> list[tuple[int, str]]:
    """Exit status and what was said on standard error, of each process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program = ROOT / "tests/support/two_processes.py"
    environment = {**os.environ, "PYTHONPATH": PATH, "JAX_PLATFORMS": "cpu"}
    pair = [
        subprocess.Popen(
            [sys.executable, str(program), str(rank), str(port), str(folder), how],
            env=environment,
            cwd=ROOT,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in (0, 1)
    ]
    try:
        said = [one.communicate(timeout=300)[1] for one in pair]
    finally:
        for one in pair:
            one.kill()
    return [(one.returncode, text) for one, text in zip(pair, said, strict=True)]


def test_two_devices_of_one_process(tmp_path):
    program = (
        "import jax, numpy as np, test_devices as t, fitting\n"
        "from small_ball import CAMERA, ball_scene, pictured\n"
        "mesh = jax.make_mesh((2,), ('pixels',))\n"
        "one = pictured(t.MATERIAL, ball_scene(), 0.01)\n"
        "fit = fitting.fit(one, ball_scene(), model='blinn-phong', precision='float64', mesh=mesh)\n"
        "of_codes = fitting.fit(t.codes(), ball_scene(), model='blinn-phong', precision='float64', mesh=mesh)\n"
        "np.savez('numbers', numbers=t.numbers(fit), of_codes=t.numbers(of_codes))\n"
    )
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    path = os.pathsep.join([PATH, str(ROOT / "tests/fitting")])
    environment = {**os.environ, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    subprocess.run([sys.executable, "-c", program], env=environment, cwd=tmp_path, check=True, timeout=300)
    with np.load(tmp_path / "numbers.npz") as found:
        np.testing.assert_allclose(found["numbers"], expected(), rtol=1e-12)
        # By least squares, as these are not, they were up to 60 errors off.
        one = numbers(fitting.fit(codes(), ball_scene(), model="blinn-phong", precision="float64"))
        np.testing.assert_allclose(found["of_codes"], one, rtol=1e-6)


def test_what_an_accelerator_takes_at_a_time_gives_the_same(monkeypatch):
    scene = ball_scene(camera=dataclasses.replace(CAMERA, resolution=(550, 530)))
    picture = pictured(MATERIAL, scene, 0.01)
    lights = np.random.default_rng(0).normal([0, 0, 1], 0.5, (16, 3))
    normals = np.broadcast_to([0.1, 0.0, 1.0], (30, 40, 3))
    values = np.maximum(normals @ (lights / np.linalg.norm(lights, axis=1)[:, None]).T, 0).transpose(2, 0, 1)[..., None]
    values = values * [0.5, 0.4, 0.3] + np.random.default_rng(1).normal(0, 0.01, (16, 30, 40, 3))

    def found():
        fit = fitting.fit(picture, scene, model="blinn-phong", precision="float64")
        return numbers(fit), fitting.fit_maps(values, lights, normals, model="lambert").k_d

    on_processor = found()
    monkeypatch.setattr(fitting.pixels, "KEPT_PIXELS", 0)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(brdf.precision, "WIDE", 2)
    for one, other in zip(found(), on_processor, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def test_two_processes(tmp_path):
    ended = run_two(tmp_path, "live")
    assert [status for status, _ in ended] == [0, 0], ended
    assert len(list((tmp_path / "keep").iterdir())) == 2  # bands of the maps
    to_light = np.array([[0, 0, 1], [0.5, 0, 1], [0, 0.5, 1], [-0.5, 0, 1], [0, -0.5, 1], [0.2, 0.2, 1]])
    photographs = np.random.default_rng(0).uniform(0.1, 0.9, (6, 4, 5, 3))
    maps, one = fitting.fit_maps(photographs, to_light, np.ones((4, 5, 3))), expected()
    picture = pictured(MATERIAL, ball_scene(), 0.01)
    pictures = np.stack([picture, 0.5 * picture, 2 * picture])
    many = fitting.fit_many(pictures, ball_scene(), model="blinn-phong", precision="float64")
    for rank in (0, 1):
        with np.load(tmp_path / f"{rank}.npz") as found:
            np.testing.assert_allclose(found["numbers"], one, rtol=1e-12)
            np.testing.assert_allclose(found["n"], many.n, rtol=1e-12)
            np.testing.assert_allclose(found["k_d"], many.k_d, rtol=1e-12)
            for name, values in maps.layers().items():
                np.testing.assert_allclose(found[f"maps {name}"], values, rtol=1e-5, equal_nan=True)


@pytest.mark.parametrize(("how", "whole"), [("dies", 0), ("maps die", 1)])
def test_a_process_that_dies_is_told_and_leaves_nothing_that_looks_whole(tmp_path, how, whole):
    start = time.monotonic()
    (status, said), _ = run_two(tmp_path, how)
    assert time.monotonic() - start < 120
    assert status == 2, said
    assert "error: mesh: has lost a process" in said
    assert not list(tmp_path.glob("*.npz"))
    bands = list(tmp_path.glob("keep/[!.]*.npz"))  # of the process that lived
    assert len(bands) == whole
    assert all(dict(np.load(band)) for band in bands)


def test_a_mesh_of_one_device_and_what_is_none():
    picture = pictured(MATERIAL, ball_scene(), 0.01)
    mesh = jax.make_mesh((1,), ("pixels",))
    found = fitting.fit(picture, ball_scene(), model="blinn-phong", precision="float64", mesh=mesh)
    np.testing.assert_allclose(numbers(found), expected(), rtol=1e-12)
    with pytest.raises(brdf.InputError, match=r"mesh: must be a jax.sharding.Mesh, got int"):
        fitting.fit(picture, ball_scene(), mesh=2)
    with pytest.raises(brdf.InputError, match="accuracy and seconds choose some"):
        fitting.fit(picture, ball_scene(), mesh=mesh, accuracy=0.1)
