"""Limits of the package's structure, read from its source: what a reader has to keep in mind.

Lines, statements and docstrings are reported by ``python -m benchmarks.size``, and not limited.
"""

import ast
from functools import cache
from pathlib import Path

import jaxltl
from benchmarks import size

PACKAGE = Path(jaxltl.__file__).parent
LIMITS = {
    "functions with more than 6 positional parameters": 0,
    "functions with more than 12 keyword-only parameters": 0,
    "Any in annotations": 205,
    "modules of the largest folder": 20,
    "names at the top level": 80,
}
MODULE_LINES, BODY_LINES = 600, 120
ONE_FILE = {"checker.py": 1060}  # runs alone, without the package


@cache
def trees() -> dict[Path, tuple[str, ast.Module]]:
    """Text and syntax tree of every module."""
    return {path: (text, ast.parse(text)) for path, text in size.sources(PACKAGE).items()}


def test_the_package_keeps_to_its_limits():
    measured = size.measure(PACKAGE)
    beyond = {x: measured[x] for x in LIMITS if measured[x] > LIMITS[x]}
    assert not beyond, f"limits: {LIMITS}"


def test_modules_and_functions_are_short():
    long = []
    for path, (text, tree) in trees().items():
        if text.count("\n") > ONE_FILE.get(path.name, MODULE_LINES):
            long.append(f"{path}: {text.count(chr(10))} lines")
        for function in size.functions(tree):
            if size.body_lines(function) > BODY_LINES:
                long.append(f"{path}: {function.name} has {size.body_lines(function)} lines")
    assert not long


NOT_NAMES = {"found", "told", "what", "given", "near", "far", "shown", "spread"}


def test_names_are_nouns_of_the_field():
    """Variables, parameters and fields are named for what they hold, not for where it is from."""
    wrong = []
    for path, (_, tree) in trees().items():
        for node in ast.walk(tree):
            stored = isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
            name = node.id if stored else node.arg if isinstance(node, ast.arg) else None
            if name in NOT_NAMES:
                wrong.append(f"{path}:{node.lineno}: {name}")
    assert not wrong


# The learners' protocol has the first four in each learner; the last is the protocol of policies, and
# a solver's state.
SHARED_CLASSES = {"Problem", "Hparams", "State", "Metrics", "Policy"}


def test_a_class_name_has_one_meaning():
    places = {}
    for path, (_, tree) in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name.lstrip("_"), []).append(f"{path}:{node.lineno}")
    twice = {name: at for name, at in places.items() if len(at) > 1}
    assert not {name: at for name, at in twice.items() if name not in SHARED_CLASSES}
