"""Small sound files of every format that is read, to be damaged by `benchmarks.fuzz` and by the tests."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from brdf.materials.material_file import load_materials
from brdf.measured import merl as measured_merl
from brdf.measured import rgl as measured_rgl
from brdf.measured.loading import load_measured
from brdf.scene import Scene

CAMERA = """[camera]
type = "orthographic"
position = [0.0, 0.0, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
width = 2.2
resolution = [8, 8]
"""
SPHERE = '[[shapes]]\ntype = "sphere"\ncenter = [0.0, 0.0, 0.0]\nradius = 1.0\n'
RECTANGLE = '[[shapes]]\ntype = "rectangle"\ncenter = [0, 0, 0]\nedge_u = [1, 0, 0]\nedge_v = [0, 1, 0]\n'
AMBIENT = "[ambient]\nintensity = [0.2, 0.2, 0.2]\n"
LIGHT = '[[lights]]\ntype = "directional"\ndirection = [0.5, 0.6, 0.7]\nintensity = [1.0, 1.0, 1.0]\n'
POINT = '[[lights]]\ntype = "point"\nposition = [1, 2, 3]\nintensity = [1.0]\nattenuation = [0, 0, 1]\n'
SPOT = """[[lights]]
type = "spot"
position = [1, 2, 3]
direction = [0, 0, -1]
intensity = [1.0]
cutoff_angle = 30
exponent = 2
"""
SCENE = CAMERA + SPHERE + RECTANGLE + "fitted = false\n" + AMBIENT + LIGHT + POINT + SPOT
PERSPECTIVE = """[camera]
type = "perspective"
position = [0, 0, 4]
target = [0, 0, 0]
up = [0, 1, 0]
fov = 40
resolution = [8, 8]
[[shapes]]
type = "triangles"
file = "mesh.obj"
[aov]
file = "../aovs.exr"
"""
JSON = '{"model": "blinn-phong", "k_a": [0.1, 0.2], "k_d": [0.5, 0.4], "k_s": [0.3, null], "n": 37.5}'
LAMBERT = '{"model": "lambert", "k_d": 0.5}'
MTL = (
    "# brdf model: phong\nnewmtl a\nNs 30\nKa 0 0 0\nKd 0.5 0.4 0.3\nKs 1 1 1\nillum 2\nnewmtl b\nKd 1\nmap_Kd a.png\n"
)
CORNELL = "# paint\n2\n400 500\n0.2 0 0.3 0 0.5 -0.25\n0.4 0.1 1.2 0 1 2\n"
ALTA = "#DIM 3 1\n#VS 0\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n0.3 0.4 0.0 2.5\n0.3 0.0 -0.2 1.5\n"
LIGHTS = "2\n0 0 1\n0.5 0.5 1\n"


def tensor() -> bytes:
    """A sound RGL header with tiny fields."""
    shapes = {"phi_i": (1,), "theta_i": (2,), "sigma": (2, 2), "ndf": (2, 2), "vndf": (1, 2, 2, 2)}
    shapes |= {"luminance": (1, 2, 2, 2), "rgb": (1, 2, 3, 2, 2)}
    header, body, start = b"", b"", 18 + sum(13 + len(name) + 8 * len(shape) for name, shape in shapes.items())
    for name, shape in shapes.items():
        count = 1
        for length in shape:
            count *= length
        header += struct.pack("<H", len(name)) + name.encode() + struct.pack("<HBQ", len(shape), 10, start + len(body))
        header += struct.pack(f"<{len(shape)}Q", *shape)
        body += struct.pack(f"<{count}f", *range(count))
    return measured_rgl.MAGIC + bytes([1, 0]) + struct.pack("<I", len(shapes)) + header + body


def _lights(path: Path) -> Any:
    from fitting.photographs.light_files import read_directions

    return read_directions(path)


def _archive(path: Path) -> Any:
    from fitting.photographs.archives import read_archive

    return read_archive(path)


def _array(path: Path) -> Any:
    from fitting.photographs.archives import read_array

    with path.open("rb") as file:
        return read_array(file, path)


def pictures(folder: Path) -> list[tuple[str, bytes, Callable[[Path], Any]]]:
    """A small picture in every format that is written here.

    Args:
        folder: to work in.
    """
    import numpy as np

    import brdf

    values = np.random.default_rng(1).random((6, 5, 3), np.float32)
    found = []
    for suffix, how in (
        (".png", {}),
        (".exr", {}),
        (".exr", {"dtype": "half"}),
        (".tif", {}),
        (".hdr", {}),
        (".jpg", {}),
    ):
        brdf.write_image(folder / f"sound{suffix}", values, **how)
        found.append((suffix, (folder / f"sound{suffix}").read_bytes(), brdf.read_picture))
        (folder / f"sound{suffix}").unlink()
    return found


def array(folder: Path) -> bytes:
    """Normals as NumPy saves them.

    Args:
        folder: to work in.
    """
    import numpy as np

    np.save(folder / "sound.npy", np.ones((2, 3, 3), np.float32))
    content = (folder / "sound.npy").read_bytes()
    (folder / "sound.npy").unlink()
    return content


def archive(folder: Path) -> bytes:
    """A small archive of photographs."""
    import numpy as np

    np.savez(
        folder / "sound.npz", images=np.ones((1, 2, 2), np.uint8), normal=np.ones((2, 2, 3)), light_dirs=np.ones((1, 3))
    )
    content = (folder / "sound.npz").read_bytes()
    (folder / "sound.npz").unlink()
    return content


def corpus(folder: Path) -> list[tuple[str, bytes, Callable[[Path], Any]]]:
    """Suffix, sound content and reader of each format.

    Args:
        folder: to work in.
    """
    text = [
        (".toml", SCENE, Scene.load),
        (".toml", PERSPECTIVE, Scene.load),
        (".json", JSON, load_materials),
        (".json", LAMBERT, load_materials),
        (".mtl", MTL, load_materials),
        (".brdf", CORNELL, load_measured),
        (".alta", ALTA, load_measured),
        (".txt", LIGHTS, _lights),
    ]
    merl = struct.pack("<3i", *measured_merl.SHAPE) + bytes(64)
    binary = [(".binary", merl, load_measured), (".bsdf", tensor(), load_measured), (".npz", archive(folder), _archive)]
    binary += [(".npy", array(folder), _array), *pictures(folder)]
    return [(suffix, content.encode(), reader) for suffix, content, reader in text] + binary
