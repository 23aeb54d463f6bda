"""Errors for packages that are not installed name the command that installs them."""

import sys

import pytest

import jaxltl


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
