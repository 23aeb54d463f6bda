"""The README's example and the notebooks run as they stand."""

import os
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parent.parent


def test_the_readme_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 3
    names: dict = {}
    for code in blocks:
        exec(compile(code, "README.md", "exec"), names)
    assert names["allowed"].maximal and not names["state"].violations
    assert names["model"].num_transitions == names["coin"].num_transitions == 6
    assert names["metrics"].loss.shape == (4, 20)
    assert (names["metrics"].loss[:, -1] < names["metrics"].loss[:, 0]).all()


@pytest.mark.notebook
@pytest.mark.parametrize("path", sorted(ROOT.glob("notebooks/*.ipynb")), ids=lambda p: p.stem)
def test_a_notebook_runs(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}})
    client.execute(env={**os.environ, "XLA_FLAGS": ""})  # long enough to be compiled for speed
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", ())]
    assert not [o for o in outputs if o.output_type == "error"]
    assert sum("image/png" in o.get("data", {}) for o in outputs) >= 3
