"""A package that is not installed is told with the command that installs it."""

import sys

import pytest

import jaxltl


@pytest.mark.parametrize(
    "name", ["brax", "craftax", "gymnax", "jumanji", "navix", "pgx", "xminigrid"]
)
def test_a_missing_package_is_named(name, monkeypatch):
    for module in [name, *sys.modules]:
        if module == name or module.startswith(f"{name}."):
            monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf'from_{name} needs .*pip install "jaxltl\[{name}\]"'):
        getattr(jaxltl, f"from_{name}")(object())
