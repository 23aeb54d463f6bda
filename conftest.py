"""Examples of docstrings: those that compile run with the pages, as ``slow``.

Those that ask for packages are left out where one is missing, else run as the package is.
"""

import contextlib
import importlib
import importlib.util
import io
import re
import shutil
import warnings

import pytest

_COMPILED = ("jaxltl.algos.", "jaxltl.core.values.", "jaxltl.envs.")


def _asked_for(item):
    """The modules that an example imports."""
    source = "".join(example.source for example in item.dtest.examples)
    return re.findall(r"^(?:import|from) ([\w.]+)", source, re.MULTILINE)


@pytest.hookimpl(tryfirst=True)  # before markers choose
def pytest_collection_modifyitems(items):
    for item in items:
        if isinstance(item, pytest.DoctestItem):
            if item.name.startswith(_COMPILED):
                item.add_marker(pytest.mark.slow)
            for root in {name.partition(".")[0] for name in _asked_for(item)}:
                if importlib.util.find_spec(root) is None:
                    item.add_marker(pytest.mark.skip(reason=f"{root} is not installed"))


@pytest.fixture(autouse=True, scope="session")
def without_graphviz():
    """Pictures are those of a machine without Graphviz; tests of it name a program of their own."""
    which = shutil.which
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shutil, "which", lambda x, *a, **k: None if x == "dot" else which(x, *a, **k))
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    if isinstance(item, pytest.DoctestItem) and item.name.startswith("jaxltl.envs.adapters."):
        import jax

        # Most of these packages know no other precision; some warn or print when they are imported.
        with jax.enable_x64(False), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with contextlib.redirect_stdout(io.StringIO()):
                for name in _asked_for(item):
                    importlib.import_module(name)
            return (yield)
    return (yield)
