"""Public names of a package, imported on first use from its ``.pyi`` file."""

from __future__ import annotations

from collections.abc import Callable

import lazy_loader

from jaxltl.core.suggestions import suggestion


def attach_stub(
    package: str, filename: str
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package; an unknown name gets a suggestion."""
    attribute, names, public = lazy_loader.attach_stub(package, filename)
    known = frozenset(public)

    def __getattr__(name: str) -> object:
        if name in known:
            return attribute(name)
        raise AttributeError(
            f"module {package!r} has no attribute {name!r}.{suggestion(name, public)}", name=name
        )

    return __getattr__, names, public
