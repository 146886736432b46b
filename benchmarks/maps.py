"""Maps: time a texel beside SciPy's and Adam's, the optimum, its errors, a photographed ball, RTI beside PTM, HSH.

    python -m benchmarks.maps [speed] [files] [errors] [photographs] [ball] [rti]

Real data lie where the environment variable ``BRDF_REAL_DATA`` says (default: ../shared/data).
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import brdf
import fitting

DATA = Path(os.environ.get("BRDF_REAL_DATA", "../shared/data"))
VIEW = np.array([0.0, 0.0, 1.0])


def dome(count: int) -> np.ndarray:
    """Lights spread evenly over the upper sky."""
    turn = np.arange(count) + 0.5
    z, angle = 0.15 + 0.85 * turn / count, np.pi * (1 + 5**0.5) * turn
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def rings(*heights: float, count: int = 32) -> np.ndarray:
    """Lights on circles."""
    each = count // len(heights)
    parts = []
    for place, z in enumerate(heights):
        angle = 2 * np.pi * (np.arange(each) + place / len(heights)) / each
        across = np.sqrt(1 - z * z)
        parts.append(np.stack([across * np.cos(angle), across * np.sin(angle), np.full(each, z)], axis=1))
    return np.concatenate(parts)


def texels(count: int, lights: np.ndarray, noise: float, seed: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Photographs (P, 1, count, 3) of Blinn-Phong texels with grey k_s, and what they are."""
    random = np.random.default_rng(seed)
    tilt, turn = np.abs(random.normal(0, 0.25, count)), random.uniform(0, 2 * np.pi, count)
    normal = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)
    k_d, k_s = random.uniform(0.05, 0.8, (count, 3)), random.uniform(0.05, 0.8, count)
    n = np.exp(random.uniform(np.log(3), np.log(300), count))
    pictures = np.empty((len(lights), 1, count, 3), np.float32)
    for picture, light in zip(pictures, lights, strict=True):
        cosine, lobe = columns(light, normal, n)
        clean = k_d * cosine[:, None] + (k_s * lobe)[:, None]
        picture[0] = clean + noise * random.standard_normal(clean.shape, np.float32)
    return pictures, {"normal": normal, "k_d": k_d, "k_s": k_s, "n": n}


def columns(light: np.ndarray, normal: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The two basis values of texels under a light."""
    half = (light + VIEW) / np.linalg.norm(light + VIEW)
    cosine = np.maximum(normal @ light, 0)
    return cosine, np.where(cosine > 0, np.maximum(normal @ half, 0) ** n, 0)


def best_of(count: int, function):
    """Least wall and processor seconds of some runs, and the last result."""
    wall, cpu, result = [], [], None
    for _ in range(count):
        begin, busy = time.perf_counter(), time.process_time()
        result = function()
        wall.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - busy)
    return min(wall), min(cpu), result


def speed() -> None:
    """Time a texel, and the peers on the same texels."""
    lights = dome(32)
    print(f"load of the machine {os.getloadavg()[0]:.1f}")
    ours = {}
    for count in (100_000, 1_000_000):
        pictures, truth = texels(count, lights, 0.01, 0)
        pictures, normal = pictures.reshape(32, -1, 1000, 3), truth["normal"].reshape(-1, 1000, 3)
        for specular in ("grey", "coloured"):
            # the first of the runs compiles
            wall, cpu, _ = best_of(3, partial(fitting.fit_maps, pictures, lights, normal, specular=specular))
            ours[specular] = wall / count
            print(
                f"{count} texels x 32 RGB, {specular} k_s: "
                f"{1e6 * wall / count:.2f} us a texel ({1e6 * cpu / count:.2f} us of all cores)"
            )
    scipy_seconds = scipy_peer(lights)
    print(
        f"SciPy least_squares from the truth: {1e6 * scipy_seconds:.0f} us a texel, "
        f"{scipy_seconds / ours['grey']:.0f} x"
    )
    adam_seconds, there = adam_peer(lights)
    words = f"{100 * there:.0f} % of the texels within 1 % of the least cost"
    print(f"Adam over all texels: {1e6 * adam_seconds:.0f} us a texel, {adam_seconds / ours['grey']:.0f} x; {words}")


def files(side: int = 1000) -> None:
    """Time a texel and peak memory from 16-bit files, in a process of its own that holds no photograph."""
    lights = dome(32)
    with tempfile.TemporaryDirectory() as folder:
        pictures, truth = texels(side * side, lights, 0.01, 0)
        lines = [str(len(lights))]
        for i, (picture, light) in enumerate(zip(pictures, lights, strict=True)):
            image = picture.reshape(side, side, 3) / 2
            brdf.write_image(Path(folder, f"{i}.tif"), image, dtype="uint16", encoding="linear")
            lines.append(f"{i}.tif {light[0]:.9f} {light[1]:.9f} {light[2]:.9f}")
        Path(folder, "lights.lp").write_text("\n".join(lines))
        np.save(Path(folder, "normals.npy"), truth["normal"].reshape(side, side, 3).astype(np.float32))
        program = (
            "import os, resource, sys, time, fitting\n"
            "for _ in range(2):\n"
            "    begin, busy = time.perf_counter(), time.process_time()\n"
            "    fitting.fit_maps(sys.argv[1], specular='grey')\n"
            "    print(time.perf_counter() - begin, time.process_time() - busy)\n"
            "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
        )
        said = subprocess.run(
            [sys.executable, "-c", program, folder], capture_output=True, text=True, check=True
        ).stdout
        *_, last, peak = said.splitlines()
        wall, cpu = (1e6 * float(word) / side**2 for word in last.split())
        print(
            f"{side * side} texels from 16-bit TIFF, grey k_s: {wall:.2f} us a texel ({cpu:.2f} us of all cores), "
            f"peak {int(peak) / 2**20:.2f} GiB, load of the machine {os.getloadavg()[0]:.1f}"
        )


def scipy_peer(lights: np.ndarray, count: int = 100) -> float:
    """Seconds a texel of SciPy's trf with the analytic Jacobian, started at the truth."""
    pictures, truth = texels(count, lights, 0.01, 1)
    half = (lights + VIEW) / np.linalg.norm(lights + VIEW, axis=1)[:, None]

    def fit(t: int) -> None:
        cosine, values = np.maximum(lights @ truth["normal"][t], 0), pictures[:, 0, t].astype(float)
        log_cosine = np.log(np.maximum(half @ truth["normal"][t], 1e-30))

        def residual(x: np.ndarray) -> np.ndarray:
            return (cosine[:, None] * x[:3] + (x[3] * np.exp(np.exp(x[4]) * log_cosine))[:, None] - values).ravel()

        def jacobian(x: np.ndarray) -> np.ndarray:
            lobe, found = np.exp(np.exp(x[4]) * log_cosine), np.zeros((len(lights), 3, 5))
            for c in range(3):
                found[:, c, c] = cosine
            found[:, :, 3], found[:, :, 4] = lobe[:, None], (x[3] * lobe * np.exp(x[4]) * log_cosine)[:, None]
            return found.reshape(-1, 5)

        start = [*truth["k_d"][t], truth["k_s"][t], np.log(truth["n"][t])]
        scipy.optimize.least_squares(residual, start, jacobian, bounds=([0] * 4 + [-np.inf], np.inf))

    begin = time.perf_counter()
    for t in range(count):
        fit(t)
    return (time.perf_counter() - begin) / count


def adam_peer(lights: np.ndarray, count: int = 20_000, steps: int = 1000) -> tuple[float, float]:
    """Seconds a texel of Adam over all texels together, and the share that comes near the least cost."""
    pictures, truth = texels(count, lights, 0.01, 2)
    half = (lights + VIEW) / np.linalg.norm(lights + VIEW, axis=1)[:, None]
    cosine = jnp.asarray(np.maximum(lights @ truth["normal"].T, 0), jnp.float32)
    log_cosine = jnp.asarray(np.log(np.maximum(half @ truth["normal"].T, 1e-30)), jnp.float32)
    values = jnp.asarray(pictures[:, 0])

    def cost(x: tuple) -> jax.Array:
        lobe = jnp.exp(jnp.exp(x[2]) * log_cosine)
        model = cosine[..., None] * jnp.exp(x[0]) + (jnp.exp(x[1]) * lobe)[..., None]
        return jnp.sum((model - values) ** 2, axis=(0, 2))

    @jax.jit
    def run(x: tuple) -> tuple:
        def step(i, state):
            x, mean, square = state
            slope = jax.grad(lambda x: jnp.sum(cost(x)))(x)
            mean = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, mean, slope)
            square = jax.tree.map(lambda s, g: 0.999 * s + 0.001 * g * g, square, slope)
            rate = 0.02 * jnp.sqrt(1 - 0.999 ** (i + 1.0)) / (1 - 0.9 ** (i + 1.0))
            return jax.tree.map(lambda v, m, s: v - rate * m / (jnp.sqrt(s) + 1e-12), x, mean, square), mean, square

        zero = jax.tree.map(jnp.zeros_like, x)
        return jax.lax.fori_loop(0, steps, step, (x, zero, zero))[0]

    start = (jnp.full((count, 3), -1.0), jnp.full(count, -1.0), jnp.full(count, 3.0))
    compiled = run.lower(start).compile()
    begin = time.perf_counter()
    x = jax.block_until_ready(compiled(start))
    seconds = (time.perf_counter() - begin) / count
    maps = fitting.fit_maps(pictures, lights, truth["normal"][None], specular="grey")
    least = cost((jnp.log(maps.k_d[0] + 1e-9), jnp.log(maps.fitted_k_s[0, :, 0] + 1e-9), jnp.log(maps.fitted_n[0])))
    known = maps.determined[0]
    return seconds, float(np.mean((np.asarray(cost(x)) < 1.01 * np.asarray(least))[known]))


def errors(count: int = 20_000) -> None:
    """The optimum against a dense search in float64, `determined` against the bound at the truth, coverage."""
    for name, lights in {"dome": dome(32), "two rings": rings(0.6, 0.9), "one ring": rings(0.8)}.items():
        pictures, truth = texels(count, lights, 0.01, 3)
        maps = fitting.fit_maps(pictures, lights, truth["normal"][None], specular="grey")
        known = maps.determined[0]
        some = np.flatnonzero(known)[:: max(1, np.count_nonzero(known) // 1000)]
        log_n = np.linspace(0, 16 * np.log(2), 400)
        dense = np.array([least_cost(pictures, lights, truth, some, np.full(some.size, v)) for v in log_n])
        best, at = np.min(dense, axis=0), np.argmin(dense, axis=0)
        low, high = log_n[np.maximum(at - 1, 0)], log_n[np.minimum(at + 1, 399)]
        for _ in range(30):
            left, right = low + 0.382 * (high - low), low + 0.618 * (high - low)
            falls = least_cost(pictures, lights, truth, some, left) > least_cost(pictures, lights, truth, some, right)
            low, high = np.where(falls, left, low), np.where(falls, high, right)
        best = np.minimum(best, least_cost(pictures, lights, truth, some, 0.5 * (low + high)))
        found = np.log(maps.n[0, some].astype(float))
        reached = least_cost(pictures, lights, truth, some, found)
        basin = np.mean(np.abs(found - 0.5 * (low + high)) < 0.05)
        bound = cramer_rao(lights, truth, 0.01)
        should = (bound[1] <= 0.25) & (truth["k_s"] > 2 * bound[0])
        limit = np.minimum(0.25 / bound[1], truth["k_s"] / (2 * bound[0]))
        clear = (limit > 1.5) | (limit < 1 / 1.5)
        covered = [
            np.mean(np.abs(np.log(maps.n[0]) - np.log(truth["n"]))[known] < 1.96 * (maps.n_error / maps.n)[0][known]),
            np.mean(np.abs(maps.k_s[0, :, 0] - truth["k_s"])[known] < 1.96 * maps.k_s_error[0, :, 0][known]),
            np.mean(np.abs(maps.k_d[0] - truth["k_d"])[known] < 1.96 * maps.k_d_error[0][known]),
        ]
        print(f"{name}: determined {np.mean(known):.3f}, rightly so {np.mean((known == should)[clear]):.4f}")
        near = np.mean(reached < best * (1 + 1e-6))
        print(f"    within 1e-6 of the least cost {near:.4f}, in its basin {basin:.4f}")
        print(f"    coverage of ln n {covered[0]:.3f}, k_s {covered[1]:.3f}, k_d {covered[2]:.3f}")


def photographs(side: int = 48, k_s: float = 0.4) -> None:
    """8-bit photographs of a ball with noise in codes, some of it in cast shadows that leave 4 % of the light."""
    across = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(across, -across)
    inside = x * x + y * y < 0.95
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], axis=-1)
    k_d = np.array([0.5, 0.3, 0.2])
    for count, n, encoding, shadow in [
        *((count, 40.0, encoding, 0.0) for count in (16, 48) for encoding in ("linear", "srgb")),
        *((32, n, "srgb", shadow) for n in (40.0, 8.0) for shadow in (0.1, 0.25, 0.4)),
    ]:
        random, lights = np.random.default_rng(5), dome(count)
        pictures = np.zeros((count, side, side, 3))
        for picture, light in zip(pictures, lights, strict=True):
            cosine, lobe = columns(light, normal[inside], n)
            picture[inside] = cosine[:, None] * k_d + k_s * lobe[:, None]
        white = 0.97 / pictures[:, inside].max()
        pictures *= white * np.where(random.random(pictures.shape[:3]) < shadow, 0.04, 1)[..., None]
        codes = 255 * encode(pictures, encoding) + random.normal(0, 0.7, pictures.shape)
        codes = np.clip(np.round(codes), 0, 255).astype(np.uint8)
        for given in (normal, "fit"):
            maps = fitting.fit_maps(codes, lights, given, mask=inside, encoding=encoding)
            known = maps.determined
            off = [
                np.abs(np.log(maps.n / n) / (maps.n_error / maps.n))[known],
                np.abs((maps.k_d - white * k_d) / maps.k_d_error)[known],
                np.abs((maps.k_s - white * k_s) / maps.k_s_error)[known],
            ]
            cover = " ".join(f"{100 * np.mean(one < 1.96):3.0f}" for one in off)
            print(
                f"{count} lights, n {n:g}, {encoding}, {100 * shadow:2.0f} % in shadow, normals "
                f"{'sought' if given is not normal else 'given '}: determined {np.mean(known[inside]):.2f}, coverage "
                f"of ln n, k_d, k_s {cover} %, ln n beyond six errors {100 * np.mean(off[0] > 6):.2f} %",
                flush=True,
            )


def least_cost(pictures, lights, truth, some, log_n) -> np.ndarray:
    """The least cost of some texels at given n, float64."""
    values = pictures[:, 0, some].astype(float)
    basis = [columns(light, truth["normal"][some], np.exp(log_n)) for light in lights]
    d, s = (np.array(one) for one in zip(*basis, strict=True))
    dd, ds, ss = np.sum(d * d, 0), np.sum(d * s, 0), np.sum(s * s, 0)
    bd, bs = np.einsum("pt,ptc->tc", d, values), np.einsum("pt,ptc->tc", s, values)
    cap, k_s, active = 32 * values.max(axis=(0, 2)), np.zeros(some.size), np.ones_like(bd, bool)
    for _ in range(6):
        top = np.sum(bs - np.where(active, bd * (ds / dd)[:, None], 0), axis=1)
        under = np.sum(ss[:, None] - np.where(active, (ds * ds / dd)[:, None], 0), axis=1)
        k_s = np.clip(top / np.maximum(under, 1e-300), 0, cap)
        active = bd > (ds * k_s)[:, None]
    k_d = np.where(active, (bd - (ds * k_s)[:, None]) / dd[:, None], 0)
    return np.sum((values - d[..., None] * k_d - (s * k_s)[..., None]) ** 2, axis=(0, 2))


def cramer_rao(lights: np.ndarray, truth: dict[str, np.ndarray], noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Least standard errors of k_s and ln n."""
    basis = [columns(light, truth["normal"], truth["n"]) for light in lights]
    d, s = (np.array(one) for one in zip(*basis, strict=True))
    slope = truth["k_s"] * s * np.log(np.maximum(s, 1e-300))
    dd = np.sum(d * d, 0)

    def left(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return 3 * (np.sum(a * b, 0) - np.sum(a * d, 0) * np.sum(b * d, 0) / dd)

    ss, sn, nn = left(s, s), left(s, slope), left(slope, slope)
    both = np.maximum(ss * nn - sn * sn, 1e-300)
    return noise * np.sqrt(nn / both), noise * np.sqrt(ss / both)


def ball() -> None:
    """Angular error of the normals of DiLiGenT's ball."""
    data = np.load(DATA / "diligent-ball" / "ball_crop_uint16.npz")
    for model in ("blinn-phong", "normalized-blinn-phong", "phong"):
        maps = fitting.fit_maps(
            data["images"],
            data["light_dirs"],
            "fit",
            intensities=data["light_intensities"],
            mask=data["mask"],
            model=model,
        )
        cosine = np.sum(maps.normal * data["normal"], axis=-1)[data["mask"]]
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        print(f"DiLiGenT ball, {model}: mean angular error {angle.mean():.2f}°, median {np.median(angle):.2f}°")


def rti() -> None:
    """PSNR of unseen lights, in code values, beside PTM, HSH and RBF."""
    print("| set | maps | PTM | HSH 9 | HSH 16 | RBF |\n| --- | --- | --- | --- | --- | --- |")
    sets = ("synth-single-object1-material5", "synth-single-object2-material6", "synth-multi-object1-material5")
    for name in (*sets, "real-item9", "real-item2"):
        folder, synthetic = DATA / "rti" / name, name.startswith("synth")
        encoding = "srgb" if synthetic else "linear"
        codes, lights = read_codes(folder / "Dome" if synthetic else folder)
        if synthetic:
            test_codes, test_lights = read_codes(folder / "Test")
        else:
            tried = np.arange(len(lights)) % 5 == 2
            test_codes, test_lights = codes[tried], lights[tried]
            codes, lights = codes[~tried], lights[~tried]
        normals = folder / "Dome" / "normals.png"
        maps = fitting.fit_maps(codes, lights, normals if normals.is_file() else "fit", encoding=encoding)
        ours = [encode(maps.render(light), encoding) * 255 for light in test_lights]
        row = [psnr(ours, test_codes)]
        for terms in (ptm, lambda v: hsh(v, 9), lambda v: hsh(v, 16), rbf(lights)):
            weights = terms(test_lights) @ np.linalg.pinv(terms(lights))
            row.append(psnr(np.tensordot(weights, codes.astype(np.float32), 1), test_codes))
        print(f"| {name} | {' | '.join(f'{value:.1f}' for value in row)} |", flush=True)


def read_codes(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Photographs as codes, and their lights."""
    from fitting.maps.map_inputs import read_lights

    names, lights = read_lights(folder / "dirs.lp")
    pictures = [np.round(255 * brdf.read_image(name, encoding="linear")).astype(np.uint8) for name in names]
    return np.stack(pictures), lights / np.linalg.norm(lights, axis=1)[:, None]


def encode(values, encoding):
    """From linear light."""
    if encoding == "linear":
        return values
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 0.0031308) ** (1 / 2.4) - 0.055)


def psnr(found, codes) -> float:
    """Mean over the photographs."""
    squares = [np.mean((np.clip(one, 0, 255) - other) ** 2) for one, other in zip(found, codes, strict=True)]
    return float(np.mean(10 * np.log10(255**2 / np.array(squares))))


def ptm(lights):
    """Polynomial texture maps (Malzbender et al. 2001): six terms."""
    x, y, _ = lights.T
    return np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], axis=1)


def hsh(lights, count):
    """Hemispherical harmonics (Gautron et al. 2004) up to 16 terms: spherical ones of 2 cos θ - 1."""
    angle, z = np.arctan2(lights[:, 1], lights[:, 0]), 2 * np.clip(lights[:, 2], 0, 1) - 1
    s = np.sqrt(np.maximum(1 - z * z, 0))
    legendre = {
        (0, 0): 1 + 0 * z, (1, 0): z, (1, 1): s, (2, 0): 1.5 * z * z - 0.5, (2, 1): s * z, (2, 2): s * s,
        (3, 0): 2.5 * z**3 - 1.5 * z, (3, 1): s * (5 * z * z - 1), (3, 2): s * s * z, (3, 3): s**3,
    }  # fmt: skip
    terms = []
    for (_, m), value in legendre.items():
        terms += [value] if m == 0 else [value * np.cos(m * angle), value * np.sin(m * angle)]
    return np.stack(terms[:count], axis=1)


def rbf(centres):
    """Gaussian radial functions about every light of the set, width the mean distance of neighbours."""
    apart = np.linalg.norm(centres[:, None] - centres, axis=2) + 10 * np.eye(len(centres))
    width = apart.min(axis=1).mean()
    return lambda lights: np.exp(-np.sum((lights[:, None] - centres) ** 2, axis=2) / (2 * width**2))


if __name__ == "__main__":
    every = (speed, files, errors, photographs, ball, rti)
    parts = {part.__name__: part for part in every}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*parts, []], metavar="PART")
    for part in parser.parse_args().parts or parts:
        parts[part]()
