"""Examples of texts that import a package which is not installed are left out, with its name."""

import importlib.util
import re

import pytest


def pytest_collection_modifyitems(items):
    for item in items:
        if isinstance(item, pytest.DoctestItem):
            source = "".join(example.source for example in item.dtest.examples)
            for root in re.findall(r"^(?:import|from) (\w+)", source, re.MULTILINE):
                if importlib.util.find_spec(root) is None:
                    item.add_marker(pytest.mark.skip(reason=f"{root} is not installed"))
