"""The notebooks run from the first cell to the last, at the size of a try."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib as mpl
import pytest

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
SIZE = ["training.episodes=24", "training.environments=8", "training.segment=40"]
FEW = ["scenario.horizon=240", "evaluation.profiles=2", "evaluation.drivers=3"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of what a notebook's user may see
@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))  # as Jupyter does with a notebook's folder
    mpl.use("agg")
    cells = json.loads(path.read_text())["cells"]
    assert not any(cell.get("outputs") for cell in cells), "stored without output"
    space: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            text = "".join(cell["source"]).replace("UPDATES = 100, 60", "UPDATES = 20, 5")
            exec(compile(text, str(path), "exec"), space)
            if "SIZE" in space:
                space |= {"SIZE": SIZE, "FEW": FEW}
