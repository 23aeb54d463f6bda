"""Pages of the reference, made of the names' topics and the docstrings when the site is built.

A name without a docstring, and a docstring that refers to what is not there, are warnings; with
``-W`` they fail the build.
"""

import importlib
import inspect
import pkgutil
import re
import sys
import typing
from pathlib import Path
from types import ModuleType
from typing import Any

import site_files
from docutils import nodes
from sphinx import addnodes
from sphinx.util import logging
from sphinx.util.nodes import make_refnode

import jaxltl
import jaxltl.algos
import jaxltl.envs
import jaxltl.io
import jaxltl.plot

LOG = logging.getLogger(__name__)
PLACE = Path(__file__).parent.parent / "reference"
# Packages below the top level whose modules people import, and what a page of them is for.
PACKAGES = {
    jaxltl.algos: (
        "Learners",
        "Each learner is a module of the same shape: ``make_problem``, "
        "``Hparams``, ``init``, ``run``, ``train`` and ``policy``.",
    ),
    jaxltl.plot: (
        "Pictures",
        "One call each. A function returns a matplotlib figure, or the text of an SVG that moves.",
    ),
    jaxltl.io: (
        "Files, format by format",
        "``read_model`` and ``write_model`` go by the name of a "
        "file; these modules say more of one format.",
    ),
    jaxltl.envs: ("Worlds, one by one", "Those of the dissertation and of the literature."),
}
ROLE = re.compile(r":(?:py:)?(func|class|mod|meth|attr|data|exc|obj):`(~?)([\w.]+)`")
FIELD = re.compile(r"^:(param|ivar) \S+(, \S+)+:")
COLON, SPACE = "\ue000", "\ue001"  # in places where a colon or a space would be read as syntax
OUTSIDE = ("jax.", "numpy.", "np.", "flax.", "chex.", "optax.", "matplotlib.", "scipy.", "lark.")
_home: dict[int, str] = {}  # objects by identity, and the name under which each is documented
_kept: list[Any] = []  # so that no identity is used again


def _modules(package: ModuleType) -> list[ModuleType]:
    found = pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    modules = [
        importlib.import_module(x.name)
        for x in found
        if not any(part.startswith("_") for part in x.name.split(".")) and not x.ispkg
    ]
    exported = [getattr(package, name) for name in package.__all__]
    if any(inspect.ismodule(x) for x in exported):
        return modules
    # A package that exports functions: the modules that define them.
    homes = {x.__module__ for x in exported}
    return [module for module in modules if module.__name__ in homes]


def _own(module: ModuleType) -> list[str]:
    """Definitions of a module, in its order."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and getattr(value, "__module__", "") == module.__name__
        and (inspect.isclass(value) or callable(value))
        and not isinstance(value, typing.TypeVar)
    ]


def _note(value: Any, name: str) -> None:
    _kept.append(value)
    _home.setdefault(id(value), name)


def _first_sentence(value: Any) -> str:
    text = inspect.cleandoc(value.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    return ROLE.sub(lambda m: f"``{m[3].split('.')[-1]}``", text).rstrip(":")


def _directive(value: Any, name: str) -> str:
    if inspect.isclass(value):
        return f".. autoclass:: {name}\n   :members:\n"
    if callable(value):
        return f".. autofunction:: {name}\n"
    return f".. autodata:: {name}\n"


def _page(title: str, about: str, entries: list[tuple[str, Any]]) -> str:
    lines = [title, "=" * len(title), "", about, "", ".. list-table::", "   :widths: 30 70", ""]
    for name, value in entries:
        lines += [f"   * - :py:obj:`~{name}`", f"     - {_first_sentence(value)}"]
    lines.append("")
    lines += [_directive(value, name) for name, value in entries]
    return "\n".join(lines)


def _slug(title: str) -> str:
    return re.sub(r"\W+", "-", title.lower()).strip("-")


def _checked(name: str, value: Any) -> None:
    generated = inspect.isclass(value) and (value.__doc__ or "").startswith(f"{value.__name__}(")
    if not (value.__doc__ or "").strip() or generated:
        LOG.warning("the public name %s has no docstring", name, type="reference")


# Packages of the core that list public names, and the titles of their pages.
TOPICS = {
    "logic": "Temporal logic and properties",
    "automata": "Automata",
    "statistics": "Statistics",
    "models": "Models",
    "environments": "Environments and monitors",
    "enclosures": "Enclosures",
    "graphs": "Graphs",
    "values": "Values and probabilities",
    "games": "Games",
}
SHARED = ("Solution", "Status", "check", "NotConverged")  # of all solvers, in core/types.py


def topics() -> dict[str, tuple[str, list[tuple[str, Any]]]]:
    """By title: the description of a namespace, and its names, the shortest that users can write."""
    listed = {}
    for space, title in TOPICS.items():
        module = getattr(jaxltl, space)
        names = [*module.__all__, *(SHARED if space == "values" else ())]
        entries = [
            (
                f"jaxltl.{x}" if x in jaxltl.__all__ else f"jaxltl.{space}.{x}",
                getattr(module, x, None) or getattr(jaxltl, x),
            )
            for x in names
        ]
        listed[title] = (module.__doc__, entries)
    return listed


def pages() -> dict[str, str]:
    """Files of the reference: the name of each, and its text."""
    texts, lists = site_files.pages(), []
    about_files = "Every key with its valid values, default, meaning and an example."
    lists.append(("Files of the command line", list(texts), about_files))
    for title, (about, entries) in topics().items():
        for name, value in entries:
            _note(value, name)
            _checked(name, value)
        texts[_slug(title)] = _page(title, about, entries)
    lists.append(("By topic", [_slug(title) for title in topics()]))
    for package, (title, about) in PACKAGES.items():
        below = []
        for module in _modules(package):
            entries = [(f"{module.__name__}.{x}", getattr(module, x)) for x in _own(module)]
            for name, value in entries:
                _note(value, name)
                _checked(name, value)
            entries = [(name, x) for name, x in entries if _home[id(x)] == name]
            if not entries:
                continue
            _note(module, module.__name__)
            slug = module.__name__.removeprefix("jaxltl.").replace(".", "-")
            head = f".. automodule:: {module.__name__}\n   :no-members:\n"
            texts[slug] = _page(module.__name__, head, entries)
            below.append(slug)
        lists.append((title, below, about))
    index = [
        "Reference",
        "=========",
        "",
        "Every public name, by topic; then the modules of which "
        "one imports by their names. ``help(jl.product)`` says the same in a terminal.",
        "",
    ]
    for caption, slugs, *about in lists:
        index += [
            caption,
            "-" * len(caption),
            "",
            *about,
            "",
            ".. toctree::",
            "   :maxdepth: 1",
            "",
            *(f"   {slug}" for slug in slugs),
            "",
        ]
    return {**texts, "index": "\n".join(index)}


def write_pages(app: Any) -> None:
    """Writes what has changed, so that the rest need not be read again."""
    PLACE.mkdir(exist_ok=True)
    texts = pages()
    for path in PLACE.glob("*.rst"):
        if path.stem not in texts:
            path.unlink()
    for stem, text in texts.items():
        path = PLACE / f"{stem}.rst"
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def resolve(target: str, *modules: str) -> tuple[Any, bool]:
    """Meaning of a dotted name, by itself or in one of these modules, and True if it has one."""
    for full in (target, *(f"{module}.{target}" for module in modules if module)):
        parts = full.split(".")
        for end in range(len(parts), 0, -1):
            try:
                value: Any = importlib.import_module(".".join(parts[:end]))
            except ImportError:
                continue
            try:
                for i, part in enumerate(parts[end:]):
                    fields = getattr(value, "__dataclass_fields__", {})
                    if part in fields and i == len(parts) - end - 1:
                        return fields[part], True
                    value = getattr(value, part)
            except AttributeError:
                continue
            return value, True
    return None, False


def refer(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """References of a docstring go to where a thing is documented; what exists else is code."""
    module = (
        name
        if what == "module"
        else (
            getattr(inspect.unwrap(obj) if callable(obj) else obj, "__module__", None) or "jaxltl"
        )
    )

    def place(match: re.Match) -> str:
        value, found = resolve(match[3], module, "jaxltl")
        if not found:
            return match[0]  # which Sphinx then does not find either
        if id(value) in _home:
            role = "py:mod" if isinstance(value, ModuleType) else "py:obj"
            return f":{role}:`~{_home[id(value)]}`"
        parts = match[3].split(".")
        return f"``{parts[-1] if match[1] not in ('attr', 'meth') else '.'.join(parts[-2:])}``"

    lines[:] = ROLE.sub(place, "\n".join(lines)).split("\n")
    if what in ("property", "attribute", "data") and lines:
        lines[0] = lines[0].replace(":", COLON)  # before it there is no type


def sign(
    app: Any,
    what: str,
    name: str,
    obj: Any,
    options: Any,
    signature: str | None,
    returns: str | None,
) -> tuple[str | None, str | None]:
    """Defaults whose text is no Python, such as ``<factory>``, would spoil the whole signature."""
    return re.sub(r"=\s?<[^<>]*>", "=...", signature) if signature else signature, returns


def mend(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """One text for several names, ``lower, upper: ...``, is read as a name with a type else."""
    lines[:] = [
        FIELD.sub(lambda m: m[0].replace(", ", f",{SPACE}"), x).replace(COLON, ":") for x in lines
    ]


def restore(app: Any, doctree: Any) -> None:
    """Puts the spaces back, and makes types known by where they are documented."""
    for text in [x for x in doctree.findall(nodes.Text) if SPACE in x]:
        text.parent.replace(text, nodes.Text(text.replace(SPACE, " ")))
    for node in doctree.findall(addnodes.pending_xref):  # `State` is that of its own module
        if node.get("refdomain") == "py" and node.get("reftype") == "class":
            value, found = resolve(node["reftarget"], node.get("py:module") or "")
            if found and id(value) in _home:
                node["reftarget"] = _home[id(value)]


def find(app: Any, env: Any, node: Any, contnode: Any) -> Any:
    """Types of a signature: a link to where one is documented, the plain name if it exists."""
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"]
    if target.startswith(OUTSIDE):  # their sites are not here
        return contnode
    value, found = resolve(target, node.get("py:module", "") or "", "builtins", "typing")
    if not found:
        for name, module in list(sys.modules.items()):
            if name.startswith("jaxltl.") and hasattr(module, target):  # for type checkers alone
                value, found = getattr(module, target), True
    if not found:
        return None
    name = _home.get(id(value))
    entry = env.domains["py"].objects.get(name) if name else None
    if entry is None:
        return contnode
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, contnode, name)


def setup(app: Any) -> dict[str, bool]:
    """Entry point of Sphinx."""
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-docstring", refer, priority=400)
    app.connect("autodoc-process-signature", sign)
    app.connect("autodoc-process-docstring", mend, priority=600)
    app.connect("doctree-read", restore)
    app.connect("missing-reference", find)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
