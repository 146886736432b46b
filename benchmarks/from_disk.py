"""A picture that is larger than memory should have to be: written, and fitted from the file band by band.

    python -m benchmarks.from_disk                  # 16384 x 16384, 1.6 GB of half floats
    python -m benchmarks.from_disk --size 4096 --model blinn-phong --memory-too

Prints the time against one NumPy pass (see `benchmarks.engine`) over a picture of 1024 x 1024, scaled to the same
number of pixels, the largest resident memory of the process that fits, and the error of the numbers.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

import brdf
import fitting
from benchmarks.engine import peak_memory, prepare

MATERIAL = brdf.BlinnPhong(k_a=[0.05, 0.04, 0.03], k_d=[0.5, 0.3, 0.1], k_s=[0.3, 0.25, 0.2], n=80.0)
NOISE = 0.01
ROWS = 128


def scene(size: int) -> brdf.Scene:
    """A sphere under a directional light."""
    return brdf.Scene(
        camera=brdf.OrthographicCamera(
            position=[0.0, 0.0, 4.0], target=[0.0, 0.0, 0.0], up=[0.0, 1.0, 0.0], width=2.2, resolution=(size, size)
        ),
        shapes=[brdf.Sphere(center=[0.0, 0.0, 0.0], radius=1.0)],
        lights=[brdf.DirectionalLight(direction=[0.5, 0.6, 0.7], intensity=[1.0, 1.0, 1.0])],
        ambient=[0.2, 0.2, 0.2],
    )


def write(path: Path, size: int) -> None:
    """Render the picture band by band, with noise."""
    whole, noise = scene(size), np.random.default_rng(0)
    output = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(size, size, 3, "half")
    spec.attribute("compression", "none")
    if not output.open(str(path), spec):
        sys.exit(output.geterror())
    for first in range(0, size, ROWS):
        pixel = np.arange(first * size, (first + ROWS) * size).reshape(ROWS, size)
        band = np.asarray(brdf.render(MATERIAL, brdf.some_pixels(whole, pixel)))
        band = band + NOISE * noise.standard_normal(band.shape, np.float32)
        output.write_scanlines(first, first + ROWS, 0, np.ascontiguousarray(band, np.float32))
    output.close()


def one_fit(path: Path, size: int, model: str, *, in_memory: bool) -> None:
    """Fit the file and print what it took; in a process of its own, whose memory is measured."""
    place = scene(size)
    fitting.fit(np.asarray(brdf.render(MATERIAL, scene(64))), scene(64), model=model)
    start_memory, start = peak_memory(), time.perf_counter()
    with brdf.ImageReader(path) as reader:
        result = fitting.fit(reader.read() if in_memory else reader, place, model=model)
    seconds, peak = time.perf_counter() - start, peak_memory()
    found, truth = result.material, MATERIAL
    errors = [abs(found.n / truth.n - 1)]  # pyright: ignore[reportAttributeAccessIssue]
    errors += [np.max(np.abs(getattr(found, k) / getattr(truth, k) - 1)) for k in ("k_a", "k_d", "k_s")]
    told = {"seconds": seconds, "peak_mb": peak, "start_mb": start_memory, "error": float(max(errors))}
    print(json.dumps(told | {"model": found.name, "pixels": result.pixels}))


def main() -> None:
    """Write the file, time a pass, fit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=16384)
    parser.add_argument("--model", default="auto")
    parser.add_argument("--memory-too", action="store_true", help="also fit the picture read into memory")
    parser.add_argument("--folder", type=Path, help="where the file is written; a temporary folder by default")
    parser.add_argument("--fit", choices=("disk", "memory"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.fit:
        one_fit(options.folder / "target.exr", options.size, options.model, in_memory=options.fit == "memory")
        return
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        start = time.perf_counter()
        write(Path(folder) / "target.exr", options.size)
        print(f"written in {time.perf_counter() - start:.0f} s")
        _, one_pass = prepare(1024, NOISE, np.float32)
        times = []
        for _ in range(5):
            start = time.perf_counter()
            one_pass()
            times.append(time.perf_counter() - start)
        unit = float(np.median(times)) * (options.size / 1024) ** 2
        for how in ("disk", "memory") if options.memory_too else ("disk",):
            command = [sys.executable, "-m", "benchmarks.from_disk", "--fit", how, "--folder", folder]
            command += ["--size", str(options.size), "--model", options.model]
            told = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            print(
                f"{options.size}², {how}, {told['model']}: "
                f"{told['seconds']:.1f} s = {told['seconds'] / unit:.1f} passes, "
                f"{told['peak_mb']:.0f} MB resident at most ({told['start_mb']:.0f} MB before), "
                f"worst relative error {told['error']:.1e}, {told['pixels']} pixels count"
            )


if __name__ == "__main__":
    main()
