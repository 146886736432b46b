"""A material as GLSL: the exact formula of its model with its numbers, for any shader.

The text has no version line and uses nothing that GLSL ES 1.00 lacks, so it can be pasted into any shader from WebGL 1
to Vulkan. It computes the lobe like ``vectors``: from cross and dot product, with a logarithm that is accurate near 1,
since ``pow(N·H, n)`` is off by 6 % at n = 1e6 in single precision.
"""

from collections.abc import Sequence

import numpy as np

from brdf.models import Material, NormalizedPhong, Phong, SpecularMaterial

_LIGHT = """\
vec3 brdf_light(vec3 normal, vec3 to_light, vec3 to_view, vec3 intensity) {
    float cosine = dot(normal, to_light);
    if (cosine <= 0.0) return vec3(0.0);
"""

_LOBE = """\
float brdf_log1p(float x) {  // log(1 + x) without losing x to the rounding of 1 + x
    return x < 1e-3 ? x * (1.0 - x * (0.5 - x * 0.3333333)) : log(1.0 + x);
}

float brdf_lobe(vec3 normal, vec3 to_light, vec3 to_view) {
    if (dot(normal, to_light) <= 0.0 || dot(normal, to_view) <= 0.0) return 0.0;
    vec3 a = @FIRST@;
    vec3 b = @SECOND@;
    float along = dot(a, b);
    vec3 across = cross(a, b);
    if (along <= 0.0) return 0.0;
    return BRDF_SCALE * exp(-0.5 * BRDF_N * brdf_log1p(dot(across, across) / (along * along)));
}

"""


def glsl_source(material: Material, notes: Sequence[str] = ()) -> str:
    """Functions ``brdf_ambient`` and ``brdf_light`` that compute the shading equation for one material.

    Args:
        material: any of the five models, of known numbers, with 1 or 3 channels.
        notes: sentences to put at the head as comments.

    Returns:
        GLSL functions, to be added to a shader.
    """
    lines = [f"// {material.name}, written by brdf. Directions are unit vectors that point away from the surface;"]
    lines += ["// intensity is the radiance that a white Lambertian surface facing the light shows (irradiance / pi)."]
    lines += ["// radiance = brdf_ambient(I_a) + sum over the lights of brdf_light(N, L, V, I)"]
    lines += [f"// {note}" for note in notes]
    specular = isinstance(material, SpecularMaterial)
    for name in ("k_a", "k_d", "k_s") if specular else ("k_a", "k_d"):
        lines.append(f"const vec3 BRDF_{name.upper()} = {_vec3(np.asarray(getattr(material, name)))};")
    if specular:
        lines.append(f"const float BRDF_N = {_number(float(material.n))};")
        lines.append(f"const float BRDF_SCALE = {_number(float(material.scale(np.float64(material.n))))};")
    lines += ["", "vec3 brdf_ambient(vec3 intensity) {", "    return BRDF_K_A * intensity;", "}", ""]
    text = "\n".join(lines) + "\n"
    if not specular:
        return text + _LIGHT + "    return intensity * BRDF_K_D * cosine;\n}\n"
    mirror = isinstance(material, Phong | NormalizedPhong)
    first = "2.0 * dot(normal, to_light) * normal - to_light" if mirror else "normal"
    second = "to_view" if mirror else "to_light + to_view"
    text += _LOBE.replace("@FIRST@", first).replace("@SECOND@", second) + _LIGHT
    weight = " * cosine" if material.cosine_weighted else ""
    text += f"    float lobe = brdf_lobe(normal, to_light, to_view){weight};\n"
    return text + "    return intensity * (BRDF_K_D * cosine + BRDF_K_S * lobe);\n}\n"


def _vec3(values: np.ndarray) -> str:
    return f"vec3({', '.join(_number(float(value)) for value in np.broadcast_to(values, (3,)))})"


def _number(value: float) -> str:
    text = f"{value:.9g}"
    return text if "." in text or "e" in text else text + ".0"
