"""The classic material table: 24 names, with the numbers that programs have passed to ``glMaterial`` since 1994.

Source: M. J. Kilgard, ``teapots.c`` of the OpenGL Programming Guide's examples (Silicon Graphics, 1994). The table
gives shininess from 0 to 1; the exponent is 128 times that.
"""

from brdf.errors import InputError
from brdf.models import BlinnPhong

LARGEST_SHININESS = 128.0

# name, ambient, diffuse and specular colour (linear RGB), shininess
_TABLE = """
emerald        0.0215   0.1745   0.0215    0.07568  0.61424  0.07568   0.633    0.727811 0.633     0.6
jade           0.135    0.2225   0.1575    0.54     0.89     0.63      0.316228 0.316228 0.316228  0.1
obsidian       0.05375  0.05     0.06625   0.18275  0.17     0.22525   0.332741 0.328634 0.346435  0.3
pearl          0.25     0.20725  0.20725   1        0.829    0.829     0.296648 0.296648 0.296648  0.088
ruby           0.1745   0.01175  0.01175   0.61424  0.04136  0.04136   0.727811 0.626959 0.626959  0.6
turquoise      0.1      0.18725  0.1745    0.396    0.74151  0.69102   0.297254 0.30829  0.306678  0.1
brass          0.329412 0.223529 0.027451  0.780392 0.568627 0.113725  0.992157 0.941176 0.807843  0.21794872
bronze         0.2125   0.1275   0.054     0.714    0.4284   0.18144   0.393548 0.271906 0.166721  0.2
chrome         0.25     0.25     0.25      0.4      0.4      0.4       0.774597 0.774597 0.774597  0.6
copper         0.19125  0.0735   0.0225    0.7038   0.27048  0.0828    0.256777 0.137622 0.086014  0.1
gold           0.24725  0.1995   0.0745    0.75164  0.60648  0.22648   0.628281 0.555802 0.366065  0.4
silver         0.19225  0.19225  0.19225   0.50754  0.50754  0.50754   0.508273 0.508273 0.508273  0.4
black_plastic  0        0        0         0.01     0.01     0.01      0.5      0.5      0.5       0.25
cyan_plastic   0        0.1      0.06      0        0.50980392 0.50980392  0.50196078 0.50196078 0.50196078  0.25
green_plastic  0        0        0         0.1      0.35     0.1       0.45     0.55     0.45      0.25
red_plastic    0        0        0         0.5      0        0         0.7      0.6      0.6       0.25
white_plastic  0        0        0         0.55     0.55     0.55      0.7      0.7      0.7       0.25
yellow_plastic 0        0        0         0.5      0.5      0         0.6      0.6      0.5       0.25
black_rubber   0.02     0.02     0.02      0.01     0.01     0.01      0.4      0.4      0.4       0.078125
cyan_rubber    0        0.05     0.05      0.4      0.5      0.5       0.04     0.7      0.7       0.078125
green_rubber   0        0.05     0         0.4      0.5      0.4       0.04     0.7      0.04      0.078125
red_rubber     0.05     0        0         0.5      0.4      0.4       0.7      0.04     0.04      0.078125
white_rubber   0.05     0.05     0.05      0.5      0.5      0.5       0.7      0.7      0.7       0.078125
yellow_rubber  0.05     0.05     0         0.5      0.5      0.4       0.7      0.7      0.04      0.078125
"""

PRESETS: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float]] = {}
"""Ambient, diffuse and specular coefficient (linear RGB) and shininess, 0 to 1, by name.

Example:
    >>> len(brdf.PRESETS), brdf.PRESETS["chrome"][0]
    (24, (0.25, 0.25, 0.25))
"""

for _row in _TABLE.strip().splitlines():
    _name, *_words = _row.split()
    _numbers = tuple(map(float, _words))
    PRESETS[_name] = (_numbers[:3], _numbers[3:6], _numbers[6:9], _numbers[9])


def preset(name: str) -> BlinnPhong:
    """A material of the classic table.

    Args:
        name: one of `PRESETS`, such as "emerald" or "cyan_plastic"; case, blanks and hyphens do not matter.

    Returns:
        Classic Blinn-Phong with three channels: the form that OpenGL's fixed function draws.

    Raises:
        InputError: where the table has no such name.

    Example:
        >>> brdf.preset("cyan plastic").k_s
        array([0.50196078, 0.50196078, 0.50196078])
    """
    key = str(name).strip().lower().replace(" ", "_").replace("-", "_")
    if key not in PRESETS:
        raise InputError("preset", f"is unknown, got {name!r}", f"Use one of {', '.join(PRESETS)}")
    k_a, k_d, k_s, shininess = PRESETS[key]
    return BlinnPhong(k_a=k_a, k_d=k_d, k_s=k_s, n=LARGEST_SHININESS * shininess)
