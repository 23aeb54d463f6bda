"""Public names: each in one topic, their types public too, and documented for their users."""

import importlib
import inspect
import subprocess
import sys
import typing
from collections import Counter

import pytest

import jaxltl
from jaxltl import _public

PUBLIC = {name: getattr(jaxltl, name) for name in jaxltl.__all__}
# Types inside of public ones that nobody has to name, in modules whose text tells of them.
DOCUMENTED = (
    "jaxltl.core.host.product", "jaxltl.core.host.sparse", "jaxltl.core.logic.properties",
    "jaxltl.core.models.product", "jaxltl.core.models.sharded", "jaxltl.core.values.sweeps",
)


def test_a_name_is_in_one_topic():
    names = [name for topic in _public.TOPICS.values() for name in topic]
    assert [name for name, times in Counter(names).items() if times > 1] == []
    assert names == _public.__all__ == jaxltl.__all__
    assert {*names} < {*dir(jaxltl)}


def test_namespaces_show_what_they_have():
    for path in _public.NAMESPACES:
        module = importlib.import_module(path)
        assert inspect.getdoc(module) and sorted(module.__all__) == sorted({*module.__all__})
        for name in module.__all__:
            assert getattr(module, name) is not None and name in dir(module)
        with pytest.raises(AttributeError, match="no attribute 'nothing_of_this_name'"):
            _ = module.nothing_of_this_name
        assert path.removeprefix("jaxltl.") in dir(jaxltl)


def test_namespaces_come_when_they_are_asked_for():
    program = """
import sys, jaxltl
dir(jaxltl.algos), dir(jaxltl.io), dir(jaxltl.envs)
assert "jax" not in sys.modules and "jaxltl.algos.ppo" not in sys.modules
jaxltl.algos.ppo.Problem, jaxltl.io.read_umb
assert "jaxltl.algos.mlirl" not in sys.modules and "jaxltl.io.storm" not in sys.modules
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def classes_of(hint, found):
    """The classes of ours in an annotation, however deep."""
    if isinstance(hint, list | tuple):
        for part in hint:
            classes_of(part, found)
    elif isinstance(hint, type) and hint.__module__.startswith("jaxltl."):
        found.add(hint)
    else:
        classes_of(typing.get_args(hint), found)
    return found


def annotated(thing):
    """What has the annotations of a public thing: functions, and the fields of a class."""
    if not isinstance(thing, type):
        return [thing]
    methods = [getattr(part, "fget", part) for name, part in vars(thing).items()
               if not name.startswith("_")]
    return [thing, *(part for part in methods if inspect.isfunction(part))]


def test_types_of_public_things_are_public():
    """What public functions take and return, and what is in it, has a name at the top level."""
    queue, seen = list(PUBLIC.values()), set()
    hidden = []
    while queue:
        thing = queue.pop()
        for part in annotated(thing):
            for kind in classes_of([*typing.get_type_hints(part).values()], set()) - seen:
                seen.add(kind)
                queue.append(kind)
                known = PUBLIC.get(kind.__name__) is kind or kind.__module__ in DOCUMENTED
                if not known or not inspect.getdoc(kind):
                    hidden.append(f"{kind.__module__}.{kind.__name__} of {thing.__name__}")
    assert not hidden
