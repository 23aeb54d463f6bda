"""All environments that the packages register, beside the packages' own steps."""

import pytest

from tests.envs.adapters.harness import load, single_precision  # noqa: F401
from tests.envs.adapters.sweep import PACKAGES, sweep

ROOTS = {"brax": "brax.envs", "craftax": "craftax.craftax_env"}


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("package", PACKAGES)
def test_all_that_is_registered_is_its_own(package):
    load(ROOTS.get(package, package))
    assert not [f"{name}: {wrong}" for name, wrong, _ in sweep(package) if wrong]
