"""Execute the notebooks and store them with their outputs for the site: ``python docs/run_notebooks.py [NAME …]``.

The notebooks in ``notebooks/`` are kept without outputs. Together they take longer than a build of the site may, so that
`make docs-notebooks` executes them and keeps the result beside the site's pages; `tests/test_docs.py` fails where a stored
notebook no longer has the sources of its original.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

ROOT = Path(__file__).parents[1]
SOURCES, STORED = ROOT / "notebooks", ROOT / "docs" / "tutorials"


def executed(path: Path) -> nbformat.NotebookNode:
    """Return a notebook with its outputs, executed in its own folder, and its seconds in the metadata."""
    notebook = nbformat.read(path, as_version=4)
    start = time.perf_counter()
    NotebookClient(notebook, timeout=1800, resources={"metadata": {"path": str(SOURCES)}}).execute()
    seconds = round(time.perf_counter() - start, 1)
    notebook.metadata = {"kernelspec": notebook.metadata["kernelspec"], "seasonscapes": {"seconds": seconds}}
    for cell in notebook.cells:
        # Neither the times of a run nor its random cell ids belong to its result.
        cell.metadata = {}
        for output in cell.get("outputs", ()):
            if "image/png" in output.get("data", {}):
                output.data = {"image/png": smaller_png(output.data["image/png"]), "text/plain": "<Figure>"}
    return notebook


def smaller_png(encoded: str) -> str:
    """Return a PNG (base64) with a palette of 256 colours, about a third of the size."""
    image = Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB")
    buffer = io.BytesIO()
    image.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.FLOYDSTEINBERG).save(
        buffer, "PNG", optimize=True
    )
    return base64.b64encode(buffer.getvalue()).decode()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="notebooks without suffix; default all")
    names = parser.parse_args().names or sorted(path.stem for path in SOURCES.glob("*.ipynb"))
    os.environ.setdefault("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    for name in names:
        notebook = executed(SOURCES / f"{name}.ipynb")
        nbformat.write(notebook, STORED / f"{name}.ipynb")
        size_kb = (STORED / f"{name}.ipynb").stat().st_size / 1000
        print(f"{name}: {notebook.metadata['seasonscapes']['seconds']} s, {size_kb:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
