"""Notebooks are saved with current, small outputs and alternative texts of pictures."""

import importlib.util

import nbformat
import pytest

from notebooks.execute import (
    HERE,
    difference,
    differences,
    execute,
    faults,
    open_with_picture,
    packages,
    paths,
)

NOTEBOOKS = paths([])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_saved_notebook_follows_the_rules(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert not faults(notebook, path.stem)
    text = notebook.cells[0].source
    picture = open_with_picture(notebook, path.stem)
    assert (HERE / "pictures" / f"{path.stem}.png").read_bytes() == picture
    assert notebook.cells[0].source == text, (
        "the picture under the title differs from that of the tagged cell"
    )


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_first_saved_outputs_are_current(path, first=2):
    """Of the first cells of code; all of them are executed before a release."""
    notebook = read_or_skip(path)
    code = [i for i, cell in enumerate(notebook.cells) if cell.cell_type == "code"]
    notebook.cells = notebook.cells[: code[first]]
    assert not differences(notebook, execute(notebook))


@pytest.mark.exhaustive
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_saved_outputs_are_current(path):
    notebook = read_or_skip(path)
    fresh = execute(notebook)
    assert not faults(fresh, path.stem)
    assert not differences(notebook, fresh)


def read_or_skip(path):
    """The notebook, if the packages that it imports are installed."""
    notebook = nbformat.read(path, as_version=4)
    missing = [name for name in packages(notebook) if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"{path.stem} needs {', '.join(missing)}")
    return notebook


@pytest.mark.parametrize(
    ("old", "new", "tolerance"),
    [
        ("P >= 0.9385", "P >= 0.9386", 0),
        ("[ 0.1  2. ]", "[0.1 2.]", 0),
        ("3 of 5", "4 of 5", 0.4),
        ("1,234 steps", "1,240 steps", 0.01),
        ("2.3e-06", "2.2e-06", 0),
        ("-1.5", "-1.6", 0),
    ],
)
def test_small_differences_are_accepted(old, new, tolerance):
    assert not difference(old, new, tolerance)


@pytest.mark.parametrize(
    ("old", "new", "tolerance"),
    [
        ("P >= 0.9385", "P >= 0.9387", 0),
        ("3 of 5", "4 of 5", 0),
        ("won from g1", "won from g2", 9),
        ("-1.5", "1.5", 0),
        ("2.3e-06", "2.3e-05", 0),
        ("True", "False", 1),
        ("1 2", "1", 1),
        ("1,234 steps", "1,250 steps", 0.01),
    ],
)
def test_larger_differences_are_reported(old, new, tolerance):
    assert difference(old, new, tolerance)
