"""Tables of hyperparameters are those that the learners declare, without an import of JAX."""

import dataclasses
import subprocess
import sys

import pytest

from jaxltl.app.files.hyperparameters import declarations
from tests.algos.cases import LEARNERS

# Values that a module computes when it is imported, which tables declare by themselves.
COMPUTED = {"optimizer"}


@pytest.mark.parametrize("name", LEARNERS)
def test_declarations_are_those_of_the_learner(name):
    module = LEARNERS[name]
    declared = {x.name: x for x in declarations(module.__name__.removeprefix("jaxltl.algos."))}
    for field in dataclasses.fields(module.Hparams):
        if "valid" not in field.metadata:
            assert field.name not in declared
            continue
        one, valid = declared.pop(field.name), field.metadata["valid"]
        default = None if field.default is dataclasses.MISSING else field.default
        assert (one.default, one.may_be_schedule) == (default, valid.may_be_schedule)
        assert one.values == valid.values or field.name in COMPUTED
        assert one.is_tuple == isinstance(field.default, tuple)
    assert not declared


def test_a_mistake_in_a_file_comes_before_jax(tmp_path):
    """For each kind of task file whose hyperparameters are those of a learner."""
    world = '[world]\nenvironment = "flat_world"\n'
    text = f'{world}[task]\nformula = "F red"\n[learner]\nmethod = "ppo"\nsteps = 1\n[ppo]\nnum_env = 3\n'
    (tmp_path / "task.toml").write_text(text)
    program = f"""
import sys
from jaxltl.app.run_job import job_of
from pathlib import Path
try:
    job_of(Path({str(tmp_path / "task.toml")!r}))
except ValueError as error:
    assert "did you mean 'num_envs'" in str(error), error
    print("jax" in sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["False"]
