"""RGL tensor files: checked before Mitsuba sees them, then evaluated by it."""

import numpy as np
import pytest
from measured_files import tensor_file
from project_paths import REAL, real_data

import brdf
from brdf.errors import InputError
from brdf.measured import rgl as measured_rgl
from brdf.measured.table import from_angles


def test_rgl_fields_are_checked_before_mitsuba_sees_them(tmp_path):
    path = tmp_path / "a.bsdf"
    good = tensor_file()
    assert set(measured_rgl.read_fields(good, path)) >= {"theta_i", "rgb"}
    spoiled = {
        "ends within its header": good[:40],
        "beyond the end": good[:-4],
        "version": good[:12] + bytes([9, 0]) + good[14:],
        "no field rgb": tensor_file(rgb=None),
        "theta_i: does not grow": tensor_file(theta_i=np.zeros(4, "<f4")),
        "not finite": tensor_file(ndf=np.full((2, 8), np.nan, "<f4")),
        "rgb: must be 5-dimensional float32 that fits": tensor_file(rgb=np.ones((1, 4, 2, 4, 4), "<f4")),
        r"vndf: must be .* got \[1, 9, 8, 8\]": tensor_file(vndf=np.ones((1, 9, 8, 8), "<f4")),
        "jacobian: must be one byte": tensor_file(jacobian=np.zeros(2, "u1")),
        "description: must be text": tensor_file(description=None),
        "sigma: must be 2-dimensional": tensor_file(sigma=np.ones(8, "<f4")),
        "luminance: must be 4-dim": tensor_file(luminance=np.ones((1, 4, 1, 4), "<f4")),
        r"rgb: must be .* got \[1, 4, 3, 4, 5\]": tensor_file(rgb=np.ones((1, 4, 3, 4, 5), "<f4")),
        "wavelengths: does not grow": tensor_file(
            rgb=None, spectra=np.ones((1, 4, 6, 4, 4), "<f4"), wavelengths=np.ones(6, "<f4")
        ),
        "phi_i: must be 1-dimensional": tensor_file(phi_i=np.ones(0, "<f4")),
    }
    for said, content in spoiled.items():
        path.write_bytes(content)
        with pytest.raises(InputError, match=said) as error:
            brdf.load_measured(path)
        assert str(error.value).startswith(str(path)), said


def test_rgl_without_mitsuba_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    (tmp_path / "a.bsdf").write_bytes(tensor_file())
    with pytest.raises(InputError, match=r"Mitsuba, which is not installed.*pip install"):
        brdf.load_measured(tmp_path / "a.bsdf")


@pytest.mark.parametrize("spectral", [False, True])
def test_rgl_files_are_evaluated_by_mitsuba(tmp_path, spectral):
    pytest.importorskip("mitsuba", reason="the optional extra 'measured' is not installed")
    changes = {}
    if spectral:
        spectra = np.ones((1, 4, 6, 4, 4), "<f4") * np.arange(1, 7, dtype="<f4")[:, None, None]
        changes = {"rgb": None, "spectra": spectra, "wavelengths": np.linspace(400, 650, 6, dtype="<f4")}
    (tmp_path / "a.bsdf").write_bytes(tensor_file(**changes))
    table = brdf.load_measured(tmp_path / "a.bsdf")
    assert len(table.channels) == (6 if spectral else 3)
    light, view = from_angles(np.array([0.3, 0.8]), 0.0), from_angles(np.array([0.5, 0.2]), 2.0)
    values = table.evaluate(light, view)
    assert np.all(values > 0)
    # Channel k is k times the first one by construction of the file; float32 inside Mitsuba.
    expected = values[:, :1] * (np.arange(1, 7) if spectral else np.ones(3))
    assert np.allclose(values, expected, rtol=1e-4)


@real_data
def test_rgl_white_paper_is_nearly_reciprocal_white():
    pytest.importorskip("mitsuba", reason="the optional extra 'measured' is not installed")
    table = brdf.load_measured(REAL / "rgl" / "paper_white_rgb.bsdf")
    light, view = from_angles(np.radians([30.0]), 0.0), from_angles(np.radians([50.0]), 2.0)
    there, back = table.evaluate(light, view), table.evaluate(view, light)
    # White A4 paper reflects some 85 % of the light nearly evenly.
    assert np.all((there > 0.22) & (there < 0.35))
    assert np.allclose(there, back, rtol=0.03)
    report = brdf.check(table)
    assert report.energy.verdict == "pass"
    assert 0.7 < report.energy.value < 1.0
