"""Balls drawn by VTK, off screen, through OSMesa (Debian package ``libosmesa6``).

VTK shades every pixel, with interpolated normals, and its highlight is Phong's:

    colour = ambient + sum_i attenuation_i spot_i I_i [ k_d (N.L_i)+ + k_s (R_i.V)+^n ],  no highlight where N.L_i <= 0

V points to the camera's position **even in a parallel projection**: such a scene needs ``viewer = "local"``. VTK has no
ambient light, only an ambient colour of the material: k_a I_a is folded into it. Nothing casts a shadow.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersSources import vtkSphereSource
from vtkmodules.vtkRenderingCore import vtkActor, vtkLight, vtkPolyDataMapper, vtkRenderer, vtkWindowToImageFilter
from vtkmodules.vtkRenderingOpenGL2 import (
    vtkFramebufferPass,
    vtkOSOpenGLRenderWindow,
    vtkRenderStepsPass,
    vtkTextureObject,
)

__all__ = ["draw_ball"]


def draw_ball(scene: Mapping[str, Any], material: Mapping[str, Any], eight_bit: bool = False) -> np.ndarray:
    """Draws the spheres of a scene.

    Args:
        scene: A parsed ``scene.toml``: either camera, spheres, ``ambient``, directional, point and spot lights.
        material: ``k_a``, ``k_d``, ``k_s`` (three numbers each, in [0, 1]) and ``n`` in [0, 128], Phong.
        eight_bit: Take a screenshot as VTK saves it, in steps of 1/255 and clamped at 1, instead of the float
            framebuffer.

    Returns:
        (height, width, 3) float32, linear, row 0 at the top.

    Raises:
        ValueError: The scene holds what is not drawn here.
    """
    if not 0 <= material["n"] <= 128:
        raise ValueError(f"n: VTK cuts it off at 128, got {material['n']}")
    renderer = vtkRenderer()
    renderer.SetBackground(0.0, 0.0, 0.0)
    renderer.AutomaticLightCreationOff()
    _set_camera(renderer, scene["camera"])
    ambient = np.array(material["k_a"]) * scene.get("ambient", {}).get("intensity", [0.0, 0.0, 0.0])
    for shape in scene["shapes"]:
        renderer.AddActor(_actor(shape, ambient, material))
    for light in scene["lights"]:
        renderer.AddLight(_lamp(light))
    width, height = scene["camera"]["resolution"]
    # Not vtkRenderWindow(): without a screen that one first tries X and EGL, and warns.
    window = vtkOSOpenGLRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(width, height)
    window.AddRenderer(renderer)
    picture = _screenshot(window) if eight_bit else _framebuffer(window, renderer)
    window.Finalize()
    return picture


def _screenshot(window: vtkOSOpenGLRenderWindow) -> np.ndarray:
    grab = vtkWindowToImageFilter()
    grab.SetInput(window)
    grab.ReadFrontBufferOff()
    grab.Update()
    image = grab.GetOutput()
    width, height, _ = image.GetDimensions()
    pixels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, -1)
    return pixels[::-1, :, :3].astype(np.float32) / 255


def _framebuffer(window: vtkOSOpenGLRenderWindow, renderer: vtkRenderer) -> np.ndarray:
    steps, target = vtkRenderStepsPass(), vtkFramebufferPass()
    target.SetDelegatePass(steps)
    target.SetColorFormat(vtkTextureObject.Float32)
    renderer.SetPass(target)
    window.Render()
    texture = target.GetColorTexture()
    size, channels = [texture.GetWidth(), texture.GetHeight()], texture.GetComponents()
    pixels = np.zeros((size[1], size[0], channels), np.float32)
    texture.Download().Download2D(texture.GetVTKDataType(), pixels, size, channels, [0, 0])
    target.ReleaseGraphicsResources(window)
    return pixels[::-1, :, :3].copy()


def _set_camera(renderer: vtkRenderer, camera: Mapping[str, Any]) -> None:
    width, height = camera["resolution"]
    view = renderer.GetActiveCamera()
    view.SetPosition(camera["position"])
    view.SetFocalPoint(camera["target"])
    view.SetViewUp(camera["up"])
    if camera["type"] == "orthographic":
        view.ParallelProjectionOn()
        view.SetParallelScale(camera["width"] * height / width / 2)
    else:
        view.SetViewAngle(camera["fov"])


def _actor(shape: Mapping[str, Any], ambient: np.ndarray, material: Mapping[str, Any]) -> vtkActor:
    if shape["type"] != "sphere":
        raise ValueError(f"shapes: spheres are drawn here, got {shape['type']!r}")
    source = vtkSphereSource()
    source.SetCenter(shape["center"])
    source.SetRadius(shape["radius"])
    source.SetThetaResolution(1024)
    source.SetPhiResolution(512)
    mapper = vtkPolyDataMapper()
    mapper.SetInputConnection(source.GetOutputPort())
    actor = vtkActor()
    actor.SetMapper(mapper)
    look = actor.GetProperty()
    look.SetInterpolationToPhong()
    look.SetAmbient(1.0)
    look.SetDiffuse(1.0)
    look.SetSpecular(1.0)
    look.SetAmbientColor(*ambient)
    look.SetDiffuseColor(*material["k_d"])
    look.SetSpecularColor(*material["k_s"])
    look.SetSpecularPower(material["n"])
    return actor


def _lamp(light: Mapping[str, Any]) -> vtkLight:
    lamp = vtkLight()
    lamp.SetLightTypeToSceneLight()
    lamp.SetColor(*light["intensity"])
    if light["type"] == "directional":
        lamp.SetPosition(*light["direction"])
        lamp.SetFocalPoint(0.0, 0.0, 0.0)
        return lamp
    if light["type"] not in ("point", "spot"):
        raise ValueError(f"lights: VTK knows directional, point and spot, got {light['type']!r}")
    lamp.PositionalOn()
    lamp.SetPosition(*light["position"])
    lamp.SetAttenuationValues(*light.get("attenuation", [0.0, 0.0, 1.0]))
    lamp.SetConeAngle(90.0)  # VTK: a cone of 90 degrees or more is a point light
    if light["type"] == "spot":
        lamp.SetFocalPoint(*np.add(light["position"], light["direction"]))
        lamp.SetConeAngle(light["cutoff_angle"])
        lamp.SetExponent(light["exponent"])
    return lamp
