"""Size of the package: lines, statements, docstrings, annotations, parameters, modules and names.

Run with ``python -m benchmarks.size [FOLDER ...]``; several folders give one column each, so that
two checkouts can be compared. ``tests/test_limits.py`` limits the structure alone.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

Function = ast.FunctionDef | ast.AsyncFunctionDef


def sources(package: Path) -> dict[Path, str]:
    """The text of every module of a package."""
    return {path: path.read_text() for path in sorted(package.rglob("*.py"))}


def functions(tree: ast.AST) -> Iterator[Function]:
    """All functions and methods of a module."""
    return (node for node in ast.walk(tree) if isinstance(node, Function))


def num_parameters(function: Function) -> int:
    """The number of positional parameters without ``self``, ``cls`` and ``*args``."""
    names = [x.arg for x in (*function.args.posonlyargs, *function.args.args)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def body_lines(function: Function) -> int:
    """The number of lines of a function from its first statement after the docstring."""
    body = function.body
    if ast.get_docstring(function, clean=False) is not None:
        body = body[1:]
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def docstring_lines(tree: ast.AST) -> int:
    """The number of lines of all docstrings of a module."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    return sum(
        node.body[0].end_lineno - node.body[0].lineno + 1
        for node in ast.walk(tree)
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None
    )


def statements(tree: ast.AST) -> int:
    """The number of statements of a module without its docstrings."""
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
    return len(nodes) - sum(
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
        for node in nodes
    )


def annotations(tree: ast.AST) -> Iterator[ast.expr]:
    """All annotations of a module: of parameters, returned values, fields and variables."""
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None:
            yield node.annotation
        elif isinstance(node, Function) and node.returns is not None:
            yield node.returns


def num_any(tree: ast.AST) -> int:
    """How often ``Any`` occurs in annotations."""
    return sum(
        isinstance(node, ast.Name) and node.id == "Any"
        for annotation in annotations(tree)
        for node in ast.walk(annotation)
    )


def modules_per_folder(package: Path) -> Counter[str]:
    """The number of modules of every folder, without ``__init__``."""
    return Counter(
        str(path.parent.relative_to(package.parent))
        for path in package.rglob("*.py")
        if path.name != "__init__.py"
    )


def top_level_names(package: Path) -> int:
    """The number of names that the stub of the package exports."""
    stub = package / "__init__.pyi"
    if not stub.exists():
        return 0
    imports = [x for x in ast.parse(stub.read_text()).body if isinstance(x, ast.ImportFrom)]
    return sum(len(x.names) for x in imports)


def measure(package: Path) -> dict[str, int]:
    """The figures of a package by name."""
    texts = sources(package)
    trees = [ast.parse(text) for text in texts.values()]
    parameters = [num_parameters(x) for tree in trees for x in functions(tree)]
    keywords = [len(x.args.kwonlyargs) for tree in trees for x in functions(tree)]
    return {
        "modules": len(texts),
        "lines": sum(text.count("\n") for text in texts.values()),
        "statements": sum(map(statements, trees)),
        "docstring lines": sum(map(docstring_lines, trees)),
        "functions": len(parameters),
        "functions with more than 6 positional parameters": sum(x > 6 for x in parameters),
        "functions with more than 12 keyword-only parameters": sum(x > 12 for x in keywords),
        "Any in annotations": sum(map(num_any, trees)),
        "modules of the largest folder": max(modules_per_folder(package).values()),
        "names at the top level": top_level_names(package),
    }


def main() -> None:
    """Prints one column of figures for each folder."""
    folders = [Path(x) for x in sys.argv[1:]] or [Path(__file__).parent.parent / "jaxltl"]
    columns = [measure(folder) for folder in folders]
    for name in columns[0]:
        print(f"{name:52}", *(f"{column[name]:>9,}" for column in columns))


if __name__ == "__main__":
    main()
