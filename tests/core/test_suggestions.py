"""Names that do not exist end with the one that may be meant, or with those that exist."""

import importlib
import subprocess
import sys

import pytest

import jaxltl as jl

PACKAGES = ("jaxltl", "jaxltl.core.values", "jaxltl.core.models", "jaxltl.io", "jaxltl.algos")
LEARNERS = ("ppo", "mlirl", "rmax", "expected_sarsa", "feasible", "cce", "trust_region", "todirl")


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_are_suggested(package):
    module = importlib.import_module(package)
    for name in module.__all__:
        wrong = name[:-2] + name[-1] + name[-2]
        if len(name) > 4 and wrong not in module.__all__:
            with pytest.raises(AttributeError, match="Did you mean"):
                getattr(module, wrong)
    with pytest.raises(AttributeError, match="has no attribute 'qqqqqq'"):
        getattr(module, "qqqqqq")  # noqa: B009


@pytest.mark.parametrize("learner", LEARNERS)
def test_hyperparameters_are_suggested(learner):
    hparams = getattr(jl.algos, learner).Hparams
    names = [name for name in hparams.__dataclass_fields__ if len(name) > 4]
    for name in names:
        with pytest.raises(TypeError, match="Did you mean"):
            hparams(**{name[:-1]: 1})
    with pytest.raises(TypeError, match=f"It takes .*{names[0]}"):
        hparams(qqqqqq=1)
    if "learning_rate" in names:
        with pytest.raises(TypeError, match="Did you mean learning_rate"):
            hparams(lr=1e-3)


def test_options_of_solvers_are_suggested():
    world = jl.from_dense([[[0.5, 0.5]], [[0.0, 1.0]]])
    with pytest.raises(TypeError, match="Did you mean max_steps"):
        jl.optimal_value(world, [[1.0], [0.0]], 0.9, max_step=3)


def test_the_package_is_imported_without_numpy():
    code = "import sys, jaxltl; sys.exit('numpy' in sys.modules or 'difflib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
