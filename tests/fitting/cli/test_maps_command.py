"""``brdf maps``: what goes wrong is one line, and nothing is written; what goes well is a folder."""

import numpy as np
import pytest
from terminals import Terminal, impatient, until

import fitting
from brdf.images.writing import write_image
from fitting.cli.main import main
from fitting.maps import map_bands


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


def test_a_folder_without_lights_is_told_and_nothing_is_written(tmp_path, capsys):
    assert run("maps", tmp_path, "--out", tmp_path / "out") == 2
    told = capsys.readouterr()
    assert told.err.startswith(f"error: {tmp_path}: has no file of lights")
    assert told.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
    assert run("maps", tmp_path, "--report", tmp_path / "page.txt") == 2
    assert "page.txt: is no name of a page. Name it .html" in capsys.readouterr().err
    assert run("maps", tmp_path, "--out", tmp_path / "out" / "..") == 2
    assert "--out: is the folder of the photographs" in capsys.readouterr().err


@pytest.fixture
def photographs(tmp_path):
    """A folder of six, on which three texels are to be seen."""
    turn = np.linspace(0, 2 * np.pi, 7)[:6]
    lights = np.stack([0.4 * np.cos(turn), 0.4 * np.sin(turn), np.ones(6)], axis=1)
    lights /= np.linalg.norm(lights, axis=1)[:, None]
    intensities = np.linspace([1.0, 1.5, 2.0], [2.0, 1.0, 1.5], 6)
    for i, (light, intensity) in enumerate(zip(lights, intensities, strict=True)):
        picture = np.ones((3, 4, 3)) * [0.3, 0.2, 0.1] * light[2] * intensity
        write_image(tmp_path / f"{i}.png", picture, dtype="uint16", encoding="linear")
    (tmp_path / "filenames.txt").write_text("".join(f"{i}.png\n" for i in range(6)))
    np.savetxt(tmp_path / "light_directions.txt", lights)
    np.savetxt(tmp_path / "light_intensities.txt", intensities)
    write_image(tmp_path / "mask.png", np.eye(3, 4), dtype="uint8")
    np.save(tmp_path / "normals.npy", np.broadcast_to([0.0, 0.0, 1.0], (3, 4, 3)))
    return tmp_path


def test_diligent_text_files_are_read_and_maps_written(photographs, capsys):
    page = photographs / "page.html"
    out = photographs / "out"
    assert run("maps", photographs, "--model", "lambert", "--out", out, "--report", page) == 0
    told = capsys.readouterr().out
    assert "3 of them fitted (lambert)" in told
    assert f"wrote {page}" in told
    assert "Content-Security-Policy" in page.read_text()
    maps = fitting.load_maps(out)
    np.testing.assert_allclose(maps.k_d[np.eye(3, 4) > 0], np.broadcast_to([0.3, 0.2, 0.1], (3, 3)), rtol=1e-3)
    assert np.isnan(maps.k_d[np.eye(3, 4) == 0]).all()


def test_normals_that_are_read_are_not_replaced_and_a_page_lies_in_a_new_folder(photographs, capsys):
    out = photographs / "out"
    assert run("maps", photographs, "--model", "lambert", "--out", out, "--report", out / "page.html") == 0
    before = (out / "normals.png").read_bytes()
    assert (out / "page.html").is_file()
    assert run("maps", photographs, "--normals", out / "normals.png", "--out", out) == 2
    assert f"--out: would replace {out / 'normals.png'}, which is read here" in capsys.readouterr().err
    assert (out / "normals.png").read_bytes() == before


def test_who_waits_is_told_how_much_is_done(photographs, monkeypatch: pytest.MonkeyPatch):
    terminal, bands = Terminal(), []

    def write_band(path, layers):
        until(lambda: "fitting maps ..." in terminal.getvalue() if not bands else "33 % done" in terminal.getvalue())
        bands.append(path)

    monkeypatch.setattr(map_bands, "BAND", 1)
    monkeypatch.setattr(map_bands, "write_band", write_band)
    impatient(monkeypatch, terminal)
    assert run("maps", photographs, "--model", "lambert", "--out", photographs / "out") == 0
    assert len(bands) == 3
