"""The scene of a shiny ball, and pictures of it with noise."""

import numpy as np

import brdf

MATERIAL = brdf.BlinnPhong(k_a=[0.2, 0.3, 0.1], k_d=[0.5, 0.3, 0.2], k_s=[0.4, 0.4, 0.4], n=60.0)


def ball(size=192, lights=None, shapes=None):
    camera = brdf.OrthographicCamera(
        position=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), width=2.2, resolution=(size, size)
    )
    lights = lights or (brdf.DirectionalLight(direction=(0.5, 0.6, 0.7), intensity=1.0),)
    shapes = shapes or (brdf.Sphere(center=(0, 0, 0), radius=1.0),)
    return brdf.Scene(camera=camera, shapes=shapes, ambient=[0.2], lights=lights)


def noisy(scene, share=0.0, material=MATERIAL):
    picture = np.asarray(brdf.render(material, scene, precision="float64"))
    return picture + share * picture.mean() * np.random.default_rng(7).standard_normal(picture.shape)
