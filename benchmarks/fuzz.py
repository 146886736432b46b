"""Throw damaged files at the readers: each has to give a value or one `InputError`, never anything else.

    python -m benchmarks.fuzz --executions 1000000 --seed 1

Small sound files of every format are mutated (bytes, tokens, lines, whole values) and read from a file, as a user's
would be. What raises anything but `brdf.InputError`, or an error of several lines, is printed with what did it.
"""

import argparse
import random
import struct
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from brdf.errors import InputError
from brdf.materials.files import load_materials
from brdf.measured import merl as measured_merl
from brdf.measured import rgl as measured_rgl
from brdf.measured.tables import load_measured
from brdf.scenes.file import load_scene

SCENE = """[camera]
type = "orthographic"
position = [0.0, 0.0, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
width = 2.2
resolution = [8, 8]
[[shapes]]
type = "sphere"
center = [0.0, 0.0, 0.0]
radius = 1.0
[[shapes]]
type = "rectangle"
center = [0.0, 0.0, 0.0]
edge_u = [1.0, 0.0, 0.0]
edge_v = [0.0, 1.0, 0.0]
fitted = false
[ambient]
intensity = [0.2, 0.2, 0.2]
[[lights]]
type = "directional"
direction = [0.5, 0.6, 0.7]
intensity = [1.0, 1.0, 1.0]
[[lights]]
type = "point"
position = [1, 2, 3]
intensity = [1.0]
attenuation = [0, 0, 1]
[[lights]]
type = "spot"
position = [1, 2, 3]
direction = [0, 0, -1]
intensity = [1.0]
cutoff_angle = 30
exponent = 2
"""
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

TOKENS = [
    *(
        "nan",
        "inf",
        "-inf",
        "-1",
        "0",
        "1e999",
        "1e308",
        "-0.0",
        "1e-320",
        "9" * 400,
        "0x10",
        "1_000",
        "٣",
        "true",
        "null",
    ),
    *(
        '""',
        "[]",
        "{}",
        "[[]]",
        "[1, [2]]",
        '"a"',
        "[true]",
        "2026-01-01",
        "0" * 50,
        "\0",
        "é",
        "\u2028",
        "'",
        '"',
        "=",
        "#",
    ),
    *(
        "[camera]",
        "[[lights]]",
        "[lights]",
        "newmtl",
        "Kd",
        "illum -1",
        "Ns",
        "#DIM 6 1",
        "#PARAM_IN CARTESIAN",
        "#VS 2",
    ),
    *("#PARAM_IN COS_TH_TD", "type", "fitted", "mesh", "k_d", '"phong"', "normalized-phong", "..", "/etc/passwd", "\\"),
]


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
        (".toml", SCENE, load_scene),
        (".toml", PERSPECTIVE, load_scene),
        (".json", JSON, load_materials),
        (".json", LAMBERT, load_materials),
        (".mtl", MTL, load_materials),
        (".brdf", CORNELL, load_measured),
        (".alta", ALTA, load_measured),
        (".txt", LIGHTS, _lights),
    ]
    merl = struct.pack("<3i", *measured_merl.SHAPE) + bytes(64)
    binary = [(".binary", merl, load_measured), (".bsdf", tensor(), load_measured), (".npz", archive(folder), _archive)]
    return [(suffix, content.encode(), reader) for suffix, content, reader in text] + binary


def mutated(content: bytes, dice: random.Random) -> bytes:
    """The content with one to four injuries.

    Args:
        content: sound.
        dice: source of chance.
    """
    for _ in range(dice.choice([1, 1, 1, 2, 2, 4])):
        at, end = (dice.randrange(len(content) + 1) for _ in range(2))
        match dice.randrange(8):
            case 0:
                content = content[:at] + bytes([dice.randrange(256)]) + content[at + 1 :]
            case 1:
                content = content[: min(at, end)] + content[min(max(at, end), min(at, end) + 40) :]
            case 2:
                content = content[:at] + content[min(at, end) : min(at, end) + 60] + content[at:]
            case 3:
                content = content[:at]
            case 4 | 5:
                words = content.replace(b",", b" , ").replace(b"]", b" ]").split(b" ")
                words[dice.randrange(len(words))] = dice.choice(TOKENS).encode()
                content = b" ".join(words)
            case 6:
                lines = content.split(b"\n")
                one, other = dice.randrange(len(lines)), dice.randrange(len(lines))
                lines[one], lines[other] = lines[other], lines[one] if dice.random() < 0.5 else b""
                content = b"\n".join(lines)
            case _:
                content = content[:at] + dice.choice(TOKENS).encode() + content[at:]
    return content


def run(executions: int, seed: int, seconds: float, folder: Path) -> tuple[Counter[str], list[str]]:
    """Fuzz; returns how often each format gave a value or an error, and what went wrong.

    Args:
        executions: how many files to read.
        seed: of the chance.
        seconds: when to stop at the latest.
        folder: where to write them.
    """
    dice = random.Random(seed)
    sound = corpus(folder)
    outcomes: Counter[str] = Counter()
    found: dict[str, str] = {}
    stop = time.monotonic() + seconds
    for count in range(executions):
        suffix, content, reader = sound[count % len(sound)]
        path = folder / f"file{suffix}"
        content = mutated(content, dice)
        path.write_bytes(content)
        try:
            reader(path)
            outcomes[f"{suffix} value"] += 1
        except InputError as error:
            outcomes[f"{suffix} error"] += 1
            if "\n" in str(error) or str(folder) not in str(error):
                found.setdefault(f"{suffix} words", f"{error!r} of {content!r}")
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            found.setdefault(f"{type(error).__name__} {place.filename}:{place.lineno}", f"{error} of {content!r}")
        if count % 256 == 0 and time.monotonic() > stop:
            break
    return outcomes, [f"{kind}: {what}" for kind, what in found.items()]


def main() -> None:
    """Run and report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--executions", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    start = time.monotonic()
    # Memory instead of a disk where the system has it: the files live for a millisecond.
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        outcomes, found = run(arguments.executions, arguments.seed, arguments.seconds, Path(folder))
    for outcome, count in sorted(outcomes.items()):
        print(f"{outcome:<16}{count:>10}")
    print(f"{sum(outcomes.values())} executions in {time.monotonic() - start:.0f} s, {len(found)} kinds of findings")
    for line in found:
        print(line)


if __name__ == "__main__":
    main()
