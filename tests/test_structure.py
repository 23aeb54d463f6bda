"""The shape of the package: which way imports flow, what is public, and what importing does."""

import ast
import functools
import importlib
import inspect
import re
import subprocess
import sys
import types
import typing
from functools import cache
from pathlib import Path

from jax.tree_util import Partial

import jaxltl

ROOT = Path(jaxltl.__file__).parent
MODULES = {
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts): path
    for path in sorted(ROOT.rglob("*.py"))
    if path.name != "__init__.py"
}
# The layers, lowest first: a module imports from its own folder and from those before it.
LAYERS = (
    "checker",
    (
        "core.array_types",
        "core.deferred",
        "core.files",
        "core.pretty_print",
        "core.status",
        "core.struct",
        "core.validation",
        "core.suggestions",
        "core.lazy",
    ),
    "core.types",
    "core.language",
    "core.logic",
    "core.statistics",
    "core.sparse",
    "core.automata",
    "core.policies",
    "core.models",
    "core.enclosures",
    "core.environments",
    "core.graphs",
    ("core.values", "core.games"),
    "core.programs",
    "core.continuous",
    "algos",
    "envs",
    "io",
    "plot",
    "app",
    "reproduce",
    "cli",
)
NO_JAX = (  # core.array_types names JAX's arrays for type checkers alone
    "core.files",
    "core.pretty_print",
    "core.status",
    "core.validation",
    "core.suggestions",
    "core.lazy",
    "core.language",
    "core.logic",
    "core.statistics",
    "core.sparse",
    "core.automata",
    "core.policies",
)


@cache
def imports(name: str) -> frozenset[str]:
    """Everything that a module imports anywhere in its text, as dotted names."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import in line {node.lineno}"
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(found)


def imports_any(name: str, roots: tuple[str, ...]) -> list[str]:
    return sorted(
        found
        for found in imports(name)
        if any(found == root or found.startswith(f"{root}.") for root in roots)
    )


def layer(name: str) -> int | None:
    """The level of a module or package; None for the package itself, which shows all of them."""
    for level, folders in enumerate(LAYERS):
        for folder in (folders,) if isinstance(folders, str) else folders:
            if f"{name}.".startswith(f"jaxltl.{folder}."):
                return level
    return None


@cache
def below(name: str) -> frozenset[str]:
    """The modules of the package that a module imports, anywhere in its text."""
    found = set()
    for other in imports(name):
        while other and other not in MODULES:
            other = other.rpartition(".")[0]
        if other and other != name:
            found.add(other)
    return frozenset(found)


def test_every_module_has_a_layer():
    top = ("jaxltl.__main__",)
    homeless = [n for n in MODULES if layer(n) is None and n not in top]
    assert not homeless, "give it a folder of the tree"


def modules_in(*folders: str) -> list[str]:
    return [x for x in MODULES if f"{x}.".startswith(tuple(f"jaxltl.{y}." for y in folders))]


def all_but_empty(faults: dict[str, list]) -> dict[str, list]:
    """The modules with a fault: assertions show all of them at once."""
    assert faults, "no module was looked at"
    return {name: found for name, found in faults.items() if found}


def test_imports_flow_down():
    up = {
        name: sorted(other for other in below(name) if (layer(other) or 0) > layer(name))
        for name in MODULES
        if layer(name) is not None
    }
    assert not all_but_empty(up), "imports of a later layer"


def test_there_is_no_circle_of_files():
    graph = {name: below(name) for name in MODULES}
    while leaves := {name for name, others in graph.items() if not others & graph.keys()}:
        graph = {name: others for name, others in graph.items() if name not in leaves}
    assert not graph, f"a circle among {sorted(graph)}"


def test_the_core_stands_alone():
    foreign = ("optax", "flax.linen", "flax.nnx", "matplotlib", "click", "tqdm")
    assert not all_but_empty({x: imports_any(x, foreign) for x in modules_in("core")})


def test_logic_automata_statistics_and_sparse_never_import_jax():
    foreign = ("jax", "jaxlib", "flax", "chex")
    assert not all_but_empty({x: imports_any(x, foreign) for x in modules_in(*NO_JAX)})


def test_learners_import_themselves_and_common_modules_alone():
    foreign = ("jaxltl.cli", "jaxltl.plot", "jaxltl.reproduce", "matplotlib")
    others = {
        name: [
            found
            for found in imports_any(name, ("jaxltl.algos",))
            # "common" is a folder of its own, which imports no learner
            if found != "jaxltl.algos" and found.split(".")[2] not in (name.split(".")[2], "common")
        ]
        + imports_any(name, foreign)
        for name in modules_in("algos")
    }
    assert not all_but_empty(others)


def test_private_modules_of_learners_stay_in_their_folder():
    foreign = {
        name: [
            other
            for other in below(name)
            if other.startswith("jaxltl.algos.")
            and other.rpartition(".")[2].startswith("_")
            and other.rpartition(".")[0] != name.rpartition(".")[0]
        ]
        for name in MODULES
    }
    assert not all_but_empty(foreign)


def test_worlds_import_the_core_alone():
    outside = {
        name: [
            other
            for other in imports_any(name, ("jaxltl",))
            if not other.startswith(("jaxltl.core", "jaxltl.envs"))
        ]
        for name in modules_in("envs")
    }
    assert not all_but_empty(outside)


def public_callables(module):
    """By name: what a module defines, and what it has built, such as partial functions."""
    for name, found in vars(module).items():
        is_ours = str(getattr(found, "__module__", "")).startswith("jaxltl.")
        if (
            not name.startswith("_")
            and callable(found)
            and typing.get_origin(found) is None
            and (is_ours or not isinstance(found, type | types.FunctionType))
        ):
            yield name, found


def test_what_is_called_has_help_of_its_own():
    lent = {inspect.getdoc(functools.partial), inspect.getdoc(Partial), None, ""}
    bare = {
        name: [
            called
            for called, found in public_callables(importlib.import_module(name))
            if inspect.getdoc(found) in lent or inspect.getdoc(found).startswith(f"{called}(")
        ]
        for name in modules_in("algos")
        if "._" not in name
    }
    assert not all_but_empty(bare)


def test_importing_changes_no_setting_and_stays_light():
    heavy = ("matplotlib", "click", "optax", "scipy", "tqdm")
    show = f"print(*[name for name in {heavy} if name in sys.modules])"
    program = f"""
import sys, jaxltl
assert "jax" not in sys.modules, "it comes with the first public name"
import jaxltl.core.array_types, jaxltl.core.automata.translate
assert "jax" not in sys.modules, "automata are NumPy arrays"
import jax
before = dict(jax.config.values)
jaxltl.MDP
after = {{name: jax.config.values[name] for name in before}}  # flax may register others
assert after == before, "a setting of JAX was changed"
{show}"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT.parent,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stdout.split()


def test_names_of_cases_are_the_same_in_all_processes(request):
    """Each process writes a set in its own order, and workers with different names run nothing."""
    names = [item.nodeid for item in request.session.items]
    assert [name for name in names if re.search(r"\{'[^{}:]*', '| at 0x", name)] == []
