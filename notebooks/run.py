"""Runs the notebooks: each is executed in a fresh kernel and stored with its pictures.

    python notebooks/run.py [NAME ...]        # into out/notebooks; all of them without a name

Needs the extra ``notebooks``. The notebooks themselves are plain text (jupytext's percent format); open them in Jupyter
with the jupytext extension, or run this and open what it leaves.
"""

import base64
import os
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
TIMEOUT = 300


def execute(path: Path, out: Path) -> Any:
    """Executes a notebook and stores it with its pictures.

    Args:
        path: The notebook, a ``.py`` file in jupytext's percent format.
        out: Folder for ``NAME.ipynb`` and ``NAME-1.png``, ...

    Returns:
        The executed notebook, as nbformat holds it.
    """
    import jupytext
    import nbformat
    from nbconvert.preprocessors import ExecutePreprocessor

    notebook = jupytext.read(path)
    old = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *([old] if old else [])])
    try:
        ExecutePreprocessor(timeout=TIMEOUT, kernel_name="python3").preprocess(
            notebook, {"metadata": {"path": str(ROOT)}}
        )
    finally:
        if old is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = old
    out.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, out / f"{path.stem}.ipynb")
    for index, picture in enumerate(pictures(notebook), start=1):
        (out / f"{path.stem}-{index}.png").write_bytes(picture)
    return notebook


def pictures(notebook: Any) -> list[bytes]:
    """The PNG pictures that a notebook shows, in order."""
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return [base64.b64decode(output.data["image/png"]) for output in outputs if "image/png" in output.get("data", {})]


def faults(notebook: Any) -> list[str]:
    """What is wrong with an executed notebook: a warning, or no picture at its end."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    found = [output.text for cell in cells for output in cell.outputs if output.get("name") == "stderr"]
    if not any("image/png" in output.get("data", {}) for output in cells[-1].outputs):
        found.append("does not end in a picture")
    return found


def main() -> None:
    """Runs those that are named, or all."""
    names, wrong = sys.argv[1:], []
    for path in sorted(HERE.glob("[0-9]_*.py")):
        if names and path.stem not in names and path.stem[0] not in names:
            continue
        start = time.perf_counter()
        notebook = execute(path, ROOT / "out" / "notebooks")
        wrong += [f"{path.name}: {fault}" for fault in faults(notebook)]
        print(f"{path.name}: {time.perf_counter() - start:.0f} s, {len(pictures(notebook))} pictures", flush=True)
    if wrong:
        raise SystemExit("\n".join(wrong))


if __name__ == "__main__":
    main()
