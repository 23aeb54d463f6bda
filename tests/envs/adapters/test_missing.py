"""Errors for packages that are not installed name the command that installs them."""

import re
import sys

import pytest

import jaxltl
from benchmarks.adapters import ROOT, TESTS


@pytest.mark.parametrize(
    "name",
    ["brax", "craftax", "gymnax", "jaxmarl", "jumanji", "navix", "pgx", "playground", "xminigrid"],
)
def test_a_missing_package_is_named(name, monkeypatch):
    root = "mujoco_playground" if name == "playground" else name
    for module in [root, *sys.modules]:
        if module == root or module.startswith(f"{root}."):
            monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf'from_{name} needs .*pip install "jaxltl\[{name}\]"'):
        getattr(jaxltl.envs, f"from_{name}")(object())


def test_the_weekly_comparison_has_a_test_of_each_package():
    for path in TESTS.values():
        assert re.search(r"def test_\w*thousand", (ROOT / path).read_text()), path
