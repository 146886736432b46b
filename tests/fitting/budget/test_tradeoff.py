"""The table of speed against accuracy: what it measures, marks and recommends."""

import csv
import dataclasses
import io
import json

import jax
import numpy as np
import pytest
from ball_scenes import ball, noisy

import brdf
import fitting
from fitting import speed_accuracy
from fitting.budget.configurations import Configuration
from fitting.cli.main import main
from fitting.speed_accuracy import Taken, Tradeoff, Trial, take


def row(model, seconds, error, work, axis="pixels", **how):
    """What was measured; the first run was slow, for caches were cold."""
    return Trial(axis, Configuration(model, **how), work, [Taken(9.0, 1.0), Taken(seconds, 0.0)], [error, 0.0]).row()


def table(*rows, accuracy=1e-3):
    return Tradeoff(rows, "float64", accuracy, len(rows), 1.0)


def test_the_compiler_is_no_part_of_a_run():
    double = jax.jit(lambda x: 2 * x)
    (_, first), (_, second) = take(lambda: double(1.0)), take(lambda: double(1.0))
    assert first.compiling > 0
    assert second.compiling == 0
    assert first.seconds < first.compiling


def test_the_front_holds_what_nothing_beats_in_both():
    rows = row("a", 1.0, 1e-1, 1), row("b", 2.0, 1e-3, 2), row("c", 3.0, 1e-2, 3), row("d", 4.0, 1e-5, 4)
    assert [one.name.split(",")[0] for one in table(*rows).front] == ["a", "b", "d"]


@pytest.mark.parametrize(
    ("rows", "recommended"),
    [
        # Of fits that are about as quick the least work, which is the same in every run.
        ([("little", 1.4, 5e-4, 1), ("much", 1.0, 6e-4, 9)], "little"),
        ([("little", 1.0, 5e-4, 1), ("much", 1.4, 1e-6, 9)], "little"),
        ([("little", 9.0, 5e-5, 1), ("much", 1.0, 1e-4, 9)], "much"),
        # Never one that another beats in both time and error.
        ([("little", 1.4, 5e-4, 1), ("much", 1.0, 1e-6, 9)], "much"),
    ],
)
def test_the_recommendation_is_quick_and_beaten_by_none(rows, recommended):
    assert table(*(row(*values) for values in rows)).recommended.name.startswith(recommended)


def test_where_nothing_keeps_the_accuracy_nothing_is_recommended():
    found = table(row("a", 1.0, 1e-2, 1), row("b", 2.0, 1e-1, 2), row("c", 1.0, np.inf, 0))
    assert found.recommended is None
    assert found.closest is not None
    assert found.closest.name == "a, float32, all pixels"
    assert found.advice.startswith("nothing is recommended")
    assert "the most accurate is a, float32, all pixels (1000 ms, error 0.01)" in found.advice
    assert [found.marks(one) for one in found.rows] == ["most accurate, front", "", ""]


def test_a_table_cut_short_recommends_only_what_keeps_the_accuracy():
    rows = row("coarse", 1.0, 1e-2, 1), row("good", 3.0, 1e-4, 9)
    cut = dataclasses.replace(table(*rows), planned=5)
    assert cut.recommended is rows[1]
    assert "2 of 5 configurations were measured" in cut.advice
    assert "measured" not in table(*rows).advice


def test_only_the_axes_that_a_scene_has_are_tried(tmp_path, monkeypatch):
    # One solver tells as much as two, and two rounds as much as six.
    monkeypatch.setattr(speed_accuracy, "SOLVERS", ("lm",))
    monkeypatch.setattr(speed_accuracy, "ROUNDS", 1)
    scene = ball(64)
    found = fitting.tradeoff(noisy(scene, 0.01), scene, seconds=600.0)
    axes = {one.axis for one in found.rows}
    assert {"default", "precision", "model", "solver"} <= axes
    assert not axes & {"samples", "shadows", "render"}
    assert found.recommended in found.rows
    assert found.default is not None
    assert found.default.error < 1e-5
    found.save(tmp_path / "out")
    lines = list(csv.DictReader(io.StringIO((tmp_path / "out" / "tradeoff.csv").read_text())))
    assert [line["name"] for line in lines] == [one.name for one in found.rows]
    assert len(json.loads((tmp_path / "out" / "tradeoff.json").read_text())["rows"]) == len(lines)
    assert (tmp_path / "out" / "tradeoff.png").stat().st_size > 10000
    text = str(found)
    assert "recommended" in text
    assert max(map(len, text.splitlines())) <= 100
    assert all(f"{name}: " in text for name in speed_accuracy.COLUMNS)
    # In what a row differs from the default, which has its whole name.
    slow = [one._replace(compile_seconds=123.45, seconds=1e3 * one.seconds, spread=1.234) for one in found.rows]
    for table in (text, str(dataclasses.replace(found, rows=tuple(slow)))):
        assert "…" not in table
        for name in ("lambert, 1024 pixels", "blinn-phong, float32, all pixels"):
            assert any(line.startswith(f"{name} ") for line in table.splitlines())


def test_ctrl_c_keeps_what_was_measured():
    scene = ball(48)

    def interrupt(done, total):
        assert total > done
        if done == 4:
            raise KeyboardInterrupt

    found = fitting.tradeoff(noisy(scene), scene, progress=interrupt)
    assert not found.complete
    # The default ran twice, two others once: what is not known at all comes before what is not known well.
    assert len(found.rows) == 3


def test_the_command_measures_a_photograph_of_a_ball(tmp_path, capsys):
    scene = ball(64)
    brdf.write_image(tmp_path / "ball.png", noisy(scene, 0.01).astype(np.float32), encoding="srgb")
    options = ["--sphere", "31.5,31.5,29.09", "--light", "0.5,0.6,0.7", "--ambient"]
    options += ["--accuracy", "1e-2", "--json"]
    with pytest.raises(SystemExit) as ended:
        main(["tradeoff", str(tmp_path / "ball.png"), *options])
    assert not ended.value.code
    told = json.loads(capsys.readouterr().out)
    assert told["rows"][0]["error"] < 1e-2
    assert told["advice"].startswith("recommended")


def test_the_command_measures_one_picture(tmp_path, capsys):
    normal = np.zeros((8, 8, 3))
    normal[..., 2] = 1.0
    np.savez(tmp_path / "two.npz", images=np.ones((2, 8, 8)), normal=normal, light_dirs=np.ones((2, 3)))
    with pytest.raises(SystemExit) as ended:
        main(["tradeoff", str(tmp_path / "two.npz")])
    assert ended.value.code == 2
    assert "two.npz: holds 2 pictures, and one is measured" in capsys.readouterr().err


def test_fits_of_the_front_are_numbered_and_named():
    rows = (
        row("blinn-phong", 0.014, 8e-3, 1, pixels=1024),
        row("blinn-phong", 0.07, 1e-7, 9, axis="default"),
        row("blinn-phong", 0.05, 8e-4, 3, pixels=16384),
    )
    axes = table(*rows).plot().axes[0]
    assert [text.get_text() for text in axes.texts] == ["1", "2", "3"]
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert {"1024 pixels", "all pixels\n(default)", "16384 pixels\n(recommended)"} <= set(names)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("errors", [(), (1e-5,), (0.0,), (np.inf,), (np.inf, 1e-3)])
def test_a_picture_of_few_fits_has_a_width(tmp_path, errors):
    # Time was up after the first run of the first.
    rows = [row(f"model {i}", 0.1, error, i) for i, error in enumerate(errors)]
    figure = table(*rows).plot()
    figure.savefig(tmp_path / "few.png")
    for low, high in (figure.axes[0].get_xlim(), figure.axes[0].get_ylim()):
        assert 0 < 2 * low < high


def test_what_rounding_says_is_measured_and_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(speed_accuracy, "SOLVERS", ())
    monkeypatch.setattr(speed_accuracy, "ROUNDS", 1)
    scene = ball(48)
    codes = np.clip(np.rint(255 * np.asarray(noisy(scene, 0.0))), 0, 255).astype(np.uint8)
    found = fitting.tradeoff(codes, scene, seconds=600.0)
    assert "rounding" in {one.axis for one in found.rows}
    found.save(tmp_path / "out")
    assert (tmp_path / "out" / "tradeoff.png").stat().st_size > 10000
