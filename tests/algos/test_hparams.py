"""Settings of learners: the text names the default that the code has, of each that has one."""

import ast
import dataclasses
import importlib
import inspect
import re

import pytest

from jaxltl import algos

KINDS = {
    name: kind
    for name in algos.__all__
    if (kind := getattr(importlib.import_module(f"jaxltl.algos.{name}"), "Hparams", None))
}
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
