"""Fewer pixels for a quick fit: a stratified subsample, or a level of the picture's pyramid?

``python -m benchmarks.tradeoff_pyramid`` fits a 512 x 512 picture with both, of about as many pixels each, over
exponents and noise, and prints the error of the parameters against the fit of all pixels. A level of the pyramid is the
mean of squares of pixels, and its scene has as many fewer pixels.
"""

import dataclasses

import numpy as np

import brdf
import fitting
from benchmarks.tradeoff import OPTIONS, SIZE, camera, material, scene
from fitting.budget.configurations import Configuration, run
from fitting.budget.deviation import parameter_deviation
from fitting.budget.lamps import Lamps

EXPONENTS, NOISES = (10.0, 60.0, 400.0, 2000.0), (0.0, 0.01, 0.1)
# The subsample takes about twice the number it is asked for.
LEVELS = ((4, 8192), (8, 2048), (16, 512))


def level_of(picture, factor):
    """The means of squares of pixels."""
    height, width, channels = picture.shape
    return picture.reshape(height // factor, factor, width // factor, factor, channels).mean(axis=(1, 3))


def main():
    """Measure and print."""
    place, how = scene(), "blinn-phong"
    print("noise      n   pixels  pyramid  subsample")
    ratios = []
    for noise in NOISES:
        for n in EXPONENTS:
            picture = np.asarray(brdf.render(material(n), place, precision="float64"))
            random = np.random.default_rng(int(n))
            picture = picture + noise * picture.mean() * random.standard_normal(picture.shape)
            best = fitting.fit(picture, place, model=how, precision="float64")
            for factor, asked in LEVELS:
                few = dataclasses.replace(place, camera=camera(SIZE // factor))
                coarse = fitting.fit(level_of(picture, factor), few, model=how)
                some = run([picture], [place], Configuration(how, "float32", asked // 2), OPTIONS, Lamps())
                taken = 0 if some.samples[0] is None else some.samples[0].pixel.size
                errors = [parameter_deviation(one, best) for one in (coarse, some.result)]
                ratios.append(errors[0] / errors[1])
                pixels = f"{(SIZE // factor) ** 2}/{taken}"
                print(f"{noise:5g} {n:6g} {pixels:>11}  {errors[0]:.1e}  {errors[1]:.1e}", flush=True)
    better = np.mean(np.array(ratios) > 1)
    print(f"the subsample is closer in {better:.0%} of {len(ratios)}, by a factor of {np.median(ratios):.1f} (median)")


if __name__ == "__main__":
    main()
