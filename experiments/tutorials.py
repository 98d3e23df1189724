"""Execute the notebooks of the tutorials and store what their cells print and draw.

The runner has no kernel: cells are executed one after the other in one namespace, in a folder of
their own.  A cell may draw with ``matplotlib.pyplot``, or ``display`` a figure as in Jupyter.
"""

import base64
import contextlib
import io
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

from deploy.files import replacing
from deploy.terminal import show

# Folder of the notebooks.
FOLDER = Path(__file__).resolve().parent.parent / "docs" / "tutorials"


def execute(notebook: dict, folder) -> tuple:
    """A notebook with the outputs of its cells, and the names that they leave.

    Parameters
    ----------
    notebook : dict
        The notebook's JSON.
    folder : path-like
        Folder in which the cells are executed.

    Returns
    -------
    notebook : dict
    names : dict
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = {"__name__": "__main__"}
    cells = []
    count = 0
    with contextlib.chdir(folder):
        for cell in notebook["cells"]:
            if cell["cell_type"] == "code":
                count += 1
                names["display"] = (displayed := []).append
                text = io.StringIO()
                code = compile("".join(cell["source"]), f"cell {count}", "exec")
                with contextlib.redirect_stdout(text):
                    exec(code, names)
                lines = text.getvalue().splitlines(keepends=True)
                printed = {"name": "stdout", "output_type": "stream", "text": lines}
                figures = [*displayed, *map(plt.figure, plt.get_fignums())]
                outputs = [printed] * bool(lines) + list(map(_encode_picture, figures))
                plt.close("all")
                cell = {**cell, "execution_count": count, "outputs": outputs}
            cells.append(cell)
    return {**notebook, "cells": cells}, names


def _encode_picture(figure) -> dict:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=90, metadata={"Software": None})
    picture = base64.b64encode(data.getvalue()).decode()
    return {"data": {"image/png": picture}, "metadata": {}, "output_type": "display_data"}


def main(
    notebooks: Annotated[
        list[Path] | None,
        typer.Argument(help="Notebooks (default: those that need no other data)."),
    ] = None,
):
    """Execute the notebooks of the tutorials and store their outputs."""
    for path in notebooks or [p for p in sorted(FOLDER.glob("*.ipynb")) if p.stem[0] in "123"]:
        notebook = json.loads(path.read_text(encoding="utf-8"))
        start = time.monotonic()
        sys.path.insert(0, os.getcwd())
        with tempfile.TemporaryDirectory() as folder:
            shutil.copy(FOLDER / "network.nir", folder)
            notebook, _ = execute(notebook, folder)
        with replacing(path, "w") as file:
            file.write(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")
        show(f"{path.name}: {time.monotonic() - start:.0f} s, {path.stat().st_size / 1000:.0f} kB")
