"""Public names: a short top level, namespaces with the rest, types public too, all documented."""

import ast
import dataclasses
import doctest
import enum
import functools
import importlib
import inspect
import re
import subprocess
import sys
import textwrap
import typing
from collections import Counter

import pytest

import jaxltl
from jaxltl import core

# Packages of the core, and of the top level, that import the names in their stubs on first use.
TOPICS = core.__all__
NAMESPACES = ("jaxltl.algos", "jaxltl.envs", "jaxltl.io", "jaxltl.plot")
MAX_NAMES = 80
PUBLIC = {
    name: getattr(module, name)
    for module in (jaxltl.envs, jaxltl.io, *(getattr(jaxltl, x) for x in TOPICS), jaxltl)
    for name in module.__all__
    if not inspect.ismodule(getattr(module, name))
}
# Types inside of public ones that nobody has to name, in modules whose text tells of them.
DOCUMENTED = (
    "jaxltl.core.language",
    "jaxltl.algos",
    "jaxltl.envs.temporal_gridworld",
    "jaxltl.core.models.protocols",
    "jaxltl.core.types",
    "jaxltl.core.sparse.product",
    "jaxltl.core.sparse.mdp",
    "jaxltl.core.logic.bounded",
    "jaxltl.core.models.product",
    "jaxltl.core.models.mesh.sharded",
    "jaxltl.core.values.prepared.block_iteration",
)


def test_the_top_level_is_short_and_listed_in_namespaces():
    assert len(jaxltl.__all__) <= MAX_NAMES
    listed = {name for topic in TOPICS for name in getattr(jaxltl, topic).__all__}
    listed |= {*jaxltl.envs.__all__, *jaxltl.io.__all__, *vars(core.types)}
    for name in jaxltl.__all__:
        assert name in listed or inspect.ismodule(getattr(jaxltl, name)), name
    assert {*jaxltl.__all__} <= {*dir(jaxltl)}


def test_a_name_is_in_one_topic():
    times = Counter(name for topic in TOPICS for name in getattr(jaxltl, topic).__all__)
    assert [name for name, count in times.items() if count > 1] == []


def test_namespaces_show_what_they_have():
    for path in NAMESPACES:
        module = importlib.import_module(path)
        assert inspect.getdoc(module) and sorted(module.__all__) == sorted({*module.__all__})
        for name in module.__all__:
            assert getattr(module, name) is not None and name in dir(module)
        with pytest.raises(AttributeError, match="nothing_of_this_name"):
            _ = module.nothing_of_this_name
        assert path.removeprefix("jaxltl.") in dir(jaxltl)


def test_namespaces_come_when_they_are_asked_for():
    program = """
import sys, jaxltl
dir(jaxltl.algos), dir(jaxltl.io), dir(jaxltl.envs)
assert "jax" not in sys.modules and "jaxltl.algos.common.schedules" not in sys.modules
jaxltl.algos.common.schedules.Linear, jaxltl.io.read_hoa
assert "optax" not in sys.modules and "jaxltl.io.storm" not in sys.modules
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
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
    methods = [
        getattr(part, "fget", part)
        for name, part in vars(thing).items()
        if not name.startswith("_")
    ]
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
                known = (
                    PUBLIC.get(kind.__name__) is kind
                    or typing.is_typeddict(kind)
                    or kind.__module__.startswith(DOCUMENTED)
                )
                if not known or not inspect.getdoc(kind):
                    hidden.append(f"{kind.__module__}.{kind.__name__} of {thing.__name__}")
    assert not hidden


# --- what is documented -------------------------------------------------------------------------


def defined_in(module):
    """Public functions and classes of a module, or of the modules of a package that it lists."""
    for name, found in vars(module).items():
        if name.startswith("_") or not callable(found) or typing.get_origin(found) is not None:
            continue
        home = f"{getattr(found, '__module__', None)}."
        if home.startswith(f"{module.__name__}.") and "._" not in home:
            yield name, found


@functools.cache
def everything_public():
    """By where it is defined: each public name, and in namespaces what their modules define."""
    found = {path_of(thing, name): thing for name, thing in PUBLIC.items()}
    for path in (*NAMESPACES, "jaxltl.algos.common"):
        space = importlib.import_module(path)
        for name in space.__all__:
            thing = getattr(space, name)
            if inspect.ismodule(thing):
                found |= {f"{thing.__name__}.{x}": y for x, y in defined_in(thing)}
            else:
                found[path_of(thing, name)] = thing
    return found


def path_of(thing, name):
    return f"{thing.__module__}.{name}"


def sections_of(text):
    """The sections of a docstring by their titles, and before them, by "", what it begins with."""
    found, title = {"": []}, ""
    for line in text.splitlines():
        if line.rstrip() in ("Args:", "Attributes:", "Returns:", "Raises:", "Yields:", "Example:"):
            title = line.strip()[:-1]
            found[title] = []
        else:
            found[title].append(line)
    return {title: "\n".join(lines) for title, lines in found.items()}


def names_in(section):
    """The names that a section tells of: ``low, high: ...`` tells of two."""
    listed = re.findall(r"^ +(\*{0,2}\w+(?:, \*{0,2}\w+)*):(?=\s)", section, re.MULTILINE)
    return {name.lstrip("*") for names in listed for name in names.split(", ")}


def fields_of(kind):
    """The public fields of a dataclass, a named tuple or an enumeration, without those of bases."""
    if issubclass(kind, enum.Enum):
        return [member.name for member in kind]
    if dataclasses.is_dataclass(kind):
        bases = [base for base in kind.__mro__[1:] if dataclasses.is_dataclass(base)]
        inherited = {field.name for base in bases for field in dataclasses.fields(base)}
        names = [x.name for x in dataclasses.fields(kind) if x.name not in inherited]
    else:
        names = getattr(kind, "_fields", ())
    return [name for name in names if not name.startswith("_") and name not in ("parent", "name")]


def examples_in(text):
    return doctest.DocTestParser().get_examples(text)


@functools.cache
def source_and_makers(module):
    """All that the examples of a module say, and its functions with the types that they return."""
    beside = [
        (path.rpartition(".")[2], thing)
        for path, thing in everything_public().items()
        if path.startswith(f"{module}.")
    ]
    texts = {module, *(str(getattr(thing, "__module__", module)) for _, thing in beside)}
    source = "".join(
        x.source
        for thing in [*(sys.modules[text] for text in texts), *(thing for _, thing in beside)]
        for x in examples_in(inspect.getdoc(thing) or "")
    )
    return source, {
        name: str(inspect.signature(thing).return_annotation)
        for name, thing in beside
        if inspect.isfunction(inspect.unwrap(thing))
    }


def shown_in_module(path):
    """Of namespaces: whether an example of the module uses a name, or what makes such a thing."""
    module, _, name = path.rpartition(".")
    if not module.startswith(tuple(NAMESPACES)):
        return False
    source, returned = source_and_makers(module)
    makers = {other for other, kind in returned.items() if re.search(rf"\b{name}\b", kind)}
    return any(re.search(rf"\b{used}\b", source) for used in {name, *makers})


def lacking_in_function(function, text, short):
    """What the text of a function does not tell; a short one names its parameters in sentences."""
    lacks = []
    parameters = inspect.signature(function).parameters
    sections = sections_of(text)
    told = names_in(sections.get("Args", ""))
    for name, parameter in parameters.items():
        if name in ("self", "cls") or name.startswith("_"):
            continue
        if str(parameter.annotation).startswith("Unpack["):  # Args has its keys
            continue
        if name not in told and not (short and re.search(rf"\b{name}\b", text)):
            lacks.append(f"Args: {name}")
        if parameter.annotation is inspect.Parameter.empty:
            lacks.append(f"the type of {name}")
    returned = inspect.signature(function).return_annotation
    if returned is inspect.Signature.empty:
        lacks.append("the type that it returns")
    elif returned not in (None, "None", "NoReturn") and not (
        {"Returns", "Yields"} & {*sections}
        or (short and text.startswith(("``", "Whether", "A ", "An ", "The ")))
    ):
        lacks.append("Returns")
    if (
        not short
        and re.search(r"jax\.Array|Solution", str(returned))
        and not re.search("ifferentiable|derivative|gradient", text)
    ):
        lacks.append("what it is differentiable in")
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    if "Raises" not in sections and any(isinstance(node, ast.Raise) for node in ast.walk(tree)):
        lacks.append("Raises")
    return lacks


def lacking_in_class(kind, text):
    """What the text of a class, and those of its methods, do not tell."""
    lacks = []
    sections = sections_of(text)
    told = names_in(sections.get("Attributes", "") + "\n" + sections.get("Args", ""))
    for name in fields_of(kind):
        if name not in told and not re.search(rf"`{name}`", text):
            lacks.append(f"Attributes: {name}")
    for name, part in vars(kind).items():
        if name.startswith("_") or getattr(part, "__module__", "").startswith("flax"):
            continue
        function = getattr(part, "fget", getattr(part, "__func__", part))
        if not inspect.isfunction(function) or function.__name__ == "<lambda>":
            continue
        if name == "replace" and dataclasses.is_dataclass(kind):
            continue  # of flax
        if not inspect.getdoc(function):
            lacks.append(f"a text of {name}")
        if "return" not in function.__annotations__:
            lacks.append(f"the type of {name}")
    return lacks


# Documented once for all learners, in jaxltl.algos.common.learner.
PROTOCOL = ("init", "step", "run", "train", "run_until", "train_until", "policy", "measure")


def lacking(path):
    """What the text of a public thing lacks, in words."""
    thing, name = everything_public()[path], path.rpartition(".")[2]
    of_protocol = path.startswith("jaxltl.algos.") and name in (*PROTOCOL, "State", "Metrics")
    if isinstance(thing, functools.partial) or not (
        inspect.isfunction(inspect.unwrap(thing)) or isinstance(thing, type)
    ):
        text = inspect.getdoc(thing) or ""
        return [] if len(text) > 20 else ["a text"]
    text = inspect.getdoc(thing) or ""
    if not text.strip() or text.startswith(f"{name}("):
        return ["a text"]
    lacks = [] if text.split("\n\n")[0].rstrip().endswith((".", ":", "``", "?")) else ["a sentence"]
    if isinstance(thing, type):
        lacks += lacking_in_class(thing, text)
    elif not of_protocol:
        lacks += lacking_in_function(inspect.unwrap(thing), text, PUBLIC.get(name) is not thing)
    examples = examples_in(text)
    is_protocol = getattr(thing, "_is_protocol", False)
    if not examples and not of_protocol and not is_protocol and not shown_in_module(path):
        lacks.append("an example")
    if any(x.want.count("\n") > 8 or len(max(x.want.split("\n"), key=len)) > 99 for x in examples):
        lacks.append("an example that shows no more than is read")
    return lacks


def test_help_is_enough():
    lacks = {path: lacking(path) for path in everything_public()}
    assert not {path: parts for path, parts in lacks.items() if parts}
