"""Hyperparameters: documented defaults are those of the code, and values out of range are refused."""

import ast
import dataclasses
import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos.common.settings import flag_invalid
from jaxltl.core import struct
from jaxltl.core.types import Status
from jaxltl.core.validation import RANGES
from tests.algos.cases import LEARNERS

KINDS = {name: module.Hparams for name, module in LEARNERS.items()}
# Arrays, whose shapes depend on the problem, and shardings have no range.
WITHOUT_RANGE = {"margin", "noise", "sharding"}
ENTRY = re.compile(r"^  (\w+(?:, \w+)*): (.*(?:\n    .*)*)", re.MULTILINE)
TOLD = re.compile(r"[Dd]efault\s+(.+?)\.$", re.DOTALL)


def told(kind):
    """The defaults that a text names, by field."""
    found = {}
    for names, text in ENTRY.findall(inspect.getdoc(kind)):
        if match := TOLD.search(text):
            values = [ast.literal_eval(x.strip("`")) for x in match[1].split(" and ")]
            names = names.split(", ")
            found |= dict(zip(names, values * len(names), strict=False))
    return found


@pytest.mark.parametrize("name", KINDS)
def test_the_text_has_the_defaults_of_the_code(name):
    defaults = {
        field.name: field.default
        for field in dataclasses.fields(KINDS[name])
        if field.default is not dataclasses.MISSING
    }
    assert defaults and told(KINDS[name]) == defaults


def fields(kind):
    return {field.name: field.metadata.get("valid") for field in dataclasses.fields(kind)}


def hparams_with(kind, **changes):
    """Valid hyperparameters, but for these."""
    return kind(
        **{
            field.name: 0.5
            for field in dataclasses.fields(kind)
            if field.default is dataclasses.MISSING
        }
        | changes
    )


def outside(valid):
    """Values that a field does not admit."""
    if valid.values is bool:
        return ["yes", 2]
    if isinstance(valid.values, tuple):
        return ["bogus", 1, None]
    given = [np.nan, "bogus", 1j, [0.5, 0.5]] if not valid.is_static else [np.nan, "bogus"]
    low, high = valid.values.low, valid.values.high
    given += [low if valid.values.open_below else low - 1] if np.isfinite(low) else []
    given += [high if valid.values.open_above else 2 * high + 1] if np.isfinite(high) else []
    return given + ([np.inf] if valid.values.open_above else [])


CASES = [
    (name, field, valid)
    for name, kind in KINDS.items()
    for field, valid in fields(kind).items()
    if field not in WITHOUT_RANGE
]


@pytest.mark.parametrize(
    ("name", "field", "valid"), CASES, ids=lambda x: x if isinstance(x, str) else ""
)
def test_every_value_out_of_range_is_refused_by_name(name, field, valid):
    """On concrete values, before anything else is read; on traced ones by the status INVALID."""
    assert valid is not None, "declare the range with the field"
    learner, kind = LEARNERS[name], KINDS[name]
    for value in outside(valid):
        hparams = hparams_with(kind, **{field: value})
        for function in (learner.init, learner.step):
            with pytest.raises(ValueError, match=rf"^{field}="):
                function(None, None, hparams)
    if valid.is_static:
        return

    @jax.jit
    def status(value):
        metrics = Metrics(jnp.int32(Status.COMPLETED))
        return flag_invalid(metrics, hparams_with(kind, **{field: value}), jnp.int32(0)).status

    for value in outside(valid):
        if isinstance(value, float | int):
            assert status(float(value)) == Status.INVALID
    assert status(0.75) == Status.COMPLETED or valid.values.low == 1


@pytest.mark.parametrize("name", KINDS)
def test_a_range_that_solvers_have_too_is_declared_once(name):
    """A stricter discount is one line in ``validation``, for solvers and learners."""
    for field, valid in fields(KINDS[name]).items():
        if field in RANGES or field.endswith("discount"):
            assert any(valid.values is x for x in RANGES.values()), f"{field}: name its range"


@struct.dataclass
class Metrics:
    status: jax.Array
