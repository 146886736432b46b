"""Does ``fit(accuracy=...)`` keep its word, and at what price? Twenty scenes of different kinds.

``python -m benchmarks.tradeoff [NAME ...]`` prints one line for each scene and accuracy: the error against a reference
(float64, all pixels, 4096 light samples), the estimate, and the time over that of the cheapest of a grid of plain
configurations that meets the accuracy, all compiled before and measured in turns. A summary follows.
"""

import sys
import time
import zlib

import numpy as np

import brdf
import fitting
from fitting.budget.configurations import Configuration, run
from fitting.budget.subsample import with_samples
from fitting.problem import state_problem
from fitting.speed_accuracy import parameter_deviation, reference

ACCURACIES = (1e-1, 1e-2, 1e-3, 1e-4)
OPTIONS = {"n_range": (0.1, 1e6), "mask": None, "saturation": None}
SIZE, SMALL = 512, 48
# Rounds of timing: the most, the fewest, and the seconds after which no more than the fewest are begun.
REPEATS, FEWEST_REPEATS, PATIENCE = 40, 3, 12.0
# What the reference resolves: its steps end there.
RESOLVED = 1e-9
SUN = brdf.DirectionalLight(direction=(0.5, 0.6, 0.7), intensity=1.0)


def camera(size=SIZE, **changes):
    """An orthographic camera before the ball."""
    values = {"position": (0, 0, 4), "target": (0, 0, 0), "up": (0, 1, 0), "width": 2.2, "resolution": (size, size)}
    return brdf.OrthographicCamera(**(values | changes))


BALL = brdf.Sphere(center=(0, 0, 0), radius=1.0)
FLOOR = brdf.Rectangle(center=(0, -0.6, 0), edge_u=(3, 0, 0), edge_v=(0, 0.5, -3))


def scene(*lights, shapes=(BALL,), look=None, ambient=0.2):
    """A ball under some lights."""
    return brdf.Scene(camera=look or camera(), shapes=shapes, ambient=[ambient], lights=lights or (SUN,))


def material(n=60.0, kind=brdf.BlinnPhong, k_s=0.4):
    """A material of three channels."""
    return kind(k_a=[0.2, 0.3, 0.1], k_d=[0.5, 0.3, 0.2], k_s=[k_s, k_s, 0.8 * k_s], n=n)


def sky(seed):
    """A lat-long map with six bright spots."""
    rows, columns = np.meshgrid(np.arange(32), np.arange(64), indexing="ij")
    bumps = np.random.default_rng(seed).random((6, 3))
    pixels = np.full((32, 64, 3), 0.3)
    for row, column, strength in bumps:
        distance = (rows - 20 * row) ** 2 + (columns - 64 * column) ** 2
        pixels += (4 * strength * np.exp(-distance / 8))[..., None] * np.array([1.0, 0.9, 0.7])
    return pixels


def scenes():
    """Name: scene, material, model to fit, noise as a share of the mean."""
    point = brdf.PointLight(position=(2, 2, 3), intensity=20.0)
    red = brdf.DirectionalLight(direction=(-0.6, 0.1, 0.8), intensity=[0.8, 0.2, 0.1])
    blue = brdf.DirectionalLight(direction=(0.5, 0.6, 0.7), intensity=[0.3, 0.5, 1.0])
    near = brdf.PerspectiveCamera(position=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), fov=35, resolution=(SIZE, SIZE))
    small = camera(SMALL)
    panel = brdf.RectangleLight(center=(2, 2, 3), edge_u=(0, 0.8, -0.5), edge_v=(0.7, 0, -0.7), radiance=3.0)
    bulb = brdf.SphereLight(center=(2, 2, 3), radius=0.6, radiance=6.0)
    dome = brdf.ConstantEnvironment(radiance=0.8)
    little = camera(256)
    yield "clean", scene(look=little), material(), "blinn-phong", 0.0
    yield "noise 1 %", scene(), material(), "blinn-phong", 0.01
    yield "noise 5 %", scene(look=little), material(), "blinn-phong", 0.05
    yield "noise 20 %", scene(), material(), "blinn-phong", 0.2
    yield "broad", scene(), material(4.0), "blinn-phong", 0.01
    yield "narrow", scene(), material(2000.0), "blinn-phong", 0.01
    yield "narrow, clean", scene(), material(20000.0), "blinn-phong", 0.0
    yield "other model", scene(look=little), material(30.0, brdf.Phong), "blinn-phong", 0.0
    yield "phong", scene(), material(30.0, brdf.Phong), "phong", 0.02
    yield "normalised", scene(), material(40.0, brdf.NormalizedPhong, 0.3), "normalized-phong", 0.02
    yield "lambert", scene(look=little), material(40.0), "lambert", 0.02
    yield "point light", scene(point), material(), "blinn-phong", 0.02
    yield "two colours", scene(red, blue), material(), "blinn-phong", 0.02
    yield "perspective", scene(look=near), material(), "blinn-phong", 0.02
    yield "shadow", scene(shapes=(BALL, FLOOR)), material(), "blinn-phong", 0.02
    yield "panel", scene(panel, look=small), material(), "blinn-phong", 0.01
    yield "panel, narrow", scene(panel, look=small), material(400.0), "blinn-phong", 0.0
    yield "bulb", scene(bulb, look=small), material(), "blinn-phong", 0.01
    yield "dome", scene(dome, look=small), material(10.0), "blinn-phong", 0.0
    yield "sky", scene(brdf.EnvironmentMap(sky(3)), look=small), material(20.0), "blinn-phong", 0.01


def samples_of(place):
    """Whether a light's number of samples can be chosen."""
    return any(hasattr(light, "samples") for light in place.lights)


def configurations(place, model):
    """The grid of plain configurations that the price is compared with."""
    pixels = (1024, 4096, 16384, None) if place.resolution[0] > SMALL else (None,)
    samples = (16, 64, 256, 1024) if samples_of(place) else (None,)
    found = [Configuration(model, "float32", p, s) for p in pixels for s in samples]
    return found if samples_of(place) else [*found, Configuration(model, "float64")]


def measure(jobs):
    """The best of each job's times, in turns: the machine is shared with others."""
    times, begun = {name: [] for name in jobs}, time.perf_counter()
    for repeat in range(REPEATS):
        if repeat >= FEWEST_REPEATS and time.perf_counter() - begun > PATIENCE:
            break
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            times[name].append(time.perf_counter() - start)
    return {name: min(each) for name, each in times.items()}


def photograph(name, place, true, noise):
    """What a scene shows under 4096 light samples, with noise, a share of the mean."""
    picture = np.asarray(brdf.render(true, with_samples(place, 4096), precision="float64"))
    random = np.random.default_rng(zlib.crc32(name.encode()))
    picture = picture + noise * picture.mean() * random.standard_normal(picture.shape)
    return picture.astype(np.float32)


def deviation(result, best):
    """The larger one of the errors of the parameters and of the picture (RMS), relative to those of a reference."""
    square, total = 0.0, np.finfo(float).tiny
    for place in best.scenes:
        true = np.asarray(brdf.render(best.material, place, precision="float64"))
        change = np.asarray(brdf.render(result.material, place, precision="float64")) - true
        square, total = square + np.sum(change**2), total + np.sum(true**2)
    return max(parameter_deviation(result.material, best), float(np.sqrt(square / total)))


def study(name, place, picture, model, options=OPTIONS, *, timed=True):
    """All accuracies on one scene."""
    lights, given = {}, {key: value for key, value in options.items() if value is not None}
    problem = state_problem(picture, place, model=model, **given)
    best = reference(problem, lights)
    jobs, errors, rows = {}, {}, []
    for how in configurations(place, model) if timed else ():
        jobs[how] = lambda how=how: run(problem, how, lights)
        errors[how] = deviation(jobs[how]().result, best)
    for accuracy in ACCURACIES:
        jobs[accuracy] = lambda e=accuracy: fitting.fit(picture, place, model=model, accuracy=e, **given)
        result = jobs[accuracy]()
        rows.append([accuracy, deviation(result, best), result.choice])
    times = measure(jobs) if timed else {}
    found = []
    for accuracy, actual, choice in rows:
        meeting = [times[how] for how, error in errors.items() if error <= accuracy]
        took, cheapest = times.get(accuracy, np.nan), min(meeting) if meeting else np.nan
        one = {
            "held": actual <= accuracy,
            "agrees": choice.chosen.error / 3 <= actual <= 3 * choice.chosen.error
            or max(actual, choice.chosen.error) < RESOLVED,
            "price": took / cheapest,
        }
        found.append(one)
        price = f"price {one['price']:5.2f}  {1e3 * took:7.1f} ms  " if timed else ""
        print(
            f"{name:<18}{accuracy:>8.0e}  error {actual:.1e}  estimate {choice.chosen.error:.1e}  "
            f"{'held' if one['held'] else 'BROKEN':<6} {'' if one['agrees'] else 'far off '}{price}"
            f"attempts {len(choice.attempts)}  {choice.chosen.configuration} ({choice.pixels} of {choice.of_pixels})",
            flush=True,
        )
    return found


def summary(found):
    """Of the cases so far."""
    held, agrees = (np.mean([one[name] for one in found]) for name in ("held", "agrees"))
    words = f"  so far {len(found)} cases: held {held:.1%}, estimate within a factor of 3 {agrees:.1%}"
    prices = np.array([one["price"] for one in found])
    prices = prices[np.isfinite(prices)]
    if prices.size:
        words += f", price median {np.median(prices):.2f}, at most 1.5 in {np.mean(prices <= 1.5):.1%}"
    print(words, flush=True)


def main(names):
    """Run the scenes named, or all."""
    found = []
    for name, place, true, model, noise in scenes():
        if not names or name in names:
            found += study(name, place, photograph(name, place, true, noise), model)
            summary(found)


if __name__ == "__main__":
    main(sys.argv[1:])
