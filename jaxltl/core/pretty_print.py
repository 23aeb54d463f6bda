"""Short ``repr`` of dataclasses and named tuples, with arrays by dtype, shape and range.

Arrays on the host are read up to a size; of traced, abstract, deleted and distributed arrays only the
dtype and the shape appear. This module does not import JAX.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import html
import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from itertools import islice
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.status import Status

WIDTH, LINES = 100, 10  # characters of a line, and lines, that a repr has at most
_READ = 2**20  # entries of an array up to which its values are read
_ITEMS = 6  # entries that are shown one by one
_NESTED = 60  # characters of an object inside of another
_DRAWN = 300_000  # characters of a picture in a notebook
_DRAWING = "jaxltl.plot.notebook"  # registers the pictures of types

CODES: dict[str, type[enum.IntEnum]] = {"status": Status}  # of the integers in a field of this name


Class = TypeVar("Class", bound=type)


@overload
def brief(cls: Class, /) -> Class: ...


@overload
def brief(*, fields: Sequence[str] = (), drawn: bool = False) -> Callable[[Class], Class]: ...


def brief(cls: Any = None, /, *, fields: Sequence[str] = (), drawn: bool = False) -> Any:
    """A class decorator for a short ``repr`` of the `fields`, by default all.

    A class that is `drawn` has a picture in notebooks, registered with :func:`picture`.
    """
    if cls is None:
        return functools.partial(brief, fields=fields, drawn=drawn)
    cls._brief = tuple(fields)
    cls.__repr__ = _repr
    if drawn:
        cls._repr_svg_, cls._repr_html_ = _svg, _html
    return cls


def _repr(self: Any) -> str:
    """The fields of an object, in at most `LINES` lines."""
    names = self._brief or getattr(self, "_fields", None)
    if names is None:
        names = [field.name for field in dataclasses.fields(self) if field.repr]
    # JAX temporarily stores axes and shardings, or nothing, in the fields of trees.
    parts = [f"{name}={describe(getattr(self, name, None), CODES.get(name))}" for name in names]
    line = f"{type(self).__name__}({', '.join(parts)})"
    if len(line) <= WIDTH:
        return line
    lines = [f"{type(self).__name__}("]
    for i, part in enumerate(parts):
        text = truncate(part, WIDTH - 5) + ("," if i + 1 < len(parts) else ")")
        if len(lines) > 1 and len(lines[-1]) + 1 + len(text) <= WIDTH:
            lines[-1] += " " + text
        else:
            lines.append("    " + text)
    return "\n".join(lines if len(lines) <= LINES else [*lines[: LINES - 1], "    ...)"])


def truncate(text: str, width: int = _NESTED) -> str:
    """A text in one line of at most `width` characters."""
    text = " ".join(text.split())
    return text if len(text) <= width else f"{text[: width - 3]}..."


def describe(value: Any, codes: type[enum.IntEnum] | None = None) -> str:
    """A short description of any value; `codes` name the integers of an array.

    >>> describe(np.arange(9.0)), describe(np.array([0, 4, 0]), Status), describe({"a": 0.5})
    ('float64[9] from 0 to 8', '2 CONVERGED, 1 MAX_STEPS', '{a: 0.5}')
    """
    if hasattr(value, "_brief"):
        return truncate(repr(value).replace("(\n    ", "("))
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return _array(value, codes)
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, Mapping | tuple | list):
        items = list(islice(value.items() if isinstance(value, Mapping) else value, _ITEMS + 1))
        texts = [
            f"{item[0]}: {describe(item[1])}" if isinstance(value, Mapping) else describe(item)
            for item in items[:_ITEMS]
        ]
        if len(items) > _ITEMS:
            texts.append(f"... ({len(value)} in all)")
        inside = ", ".join(texts) + ("," if isinstance(value, tuple) and len(texts) == 1 else "")
        left, right = "{}" if isinstance(value, Mapping) else "[]" if type(value) is list else "()"
        return truncate(f"{left}{inside}{right}", WIDTH)
    if callable(value) and hasattr(value, "__name__"):
        return truncate(value.__name__)
    if isinstance(value, functools.partial):
        function = getattr(value.func, "fun", value.func)  # JAX's partial functions wrap theirs
        return f"partial({describe(function)})"
    return truncate(repr(value))


def readable(value: Any) -> NDArray[Any] | None:
    """The NumPy array of an array that the host can read at once, else None."""
    if not isinstance(getattr(value, "dtype", None), np.dtype) or value.size > _READ:
        return None
    if not isinstance(value, np.ndarray | np.generic):
        jax = sys.modules.get("jax")
        if jax is None or not isinstance(value, jax.Array) or isinstance(value, jax.core.Tracer):
            return None
        if value.is_deleted() or not value.is_fully_addressable:
            return None
    try:
        return np.asarray(value)
    except Exception:  # such as a transfer that is forbidden
        return None


def _array(value: Any, codes: type[enum.IntEnum] | None) -> str:
    """All values of a small array; the dtype, the shape and the range of others."""
    text, read = f"{value.dtype}[{', '.join(map(str, value.shape))}]", readable(value)
    if read is None or read.size == 0 or read.dtype.kind not in "biuf":
        return text
    if codes is not None:
        known = {int(code): code.name for code in codes}
        entries, times = np.unique(read, return_counts=True)
        words = [known.get(int(entry), str(entry)) for entry in entries]
        if read.ndim == 0:
            return words[0]
        return ", ".join(f"{n:,} {word}" for n, word in zip(times, words, strict=True))
    if read.ndim == 0 or (read.ndim == 1 and read.size <= _ITEMS):
        numbers = ", ".join(f"{x:.6g}" if read.dtype.kind == "f" else str(x) for x in read.flat)
        return f"[{numbers}]" if read.ndim else numbers
    if read.dtype.kind == "b":
        return f"{text} with {np.count_nonzero(read):,} of {read.size:,} true"
    numbers = read[read == read]
    if not numbers.size:
        return f"{text} all nan"
    low, high, missing = numbers.min(), numbers.max(), read.size - numbers.size
    extent = f"all {low:.6g}" if low == high else f"from {low:.6g} to {high:.6g}"
    return f"{text} {extent}" + (f", {missing:,} nan" if missing else "")


def rounded_outward(bound: float, up: bool, digits: int = 5) -> str:
    """A bound as text with some significant digits, rounded up or down.

    >>> rounded_outward(0.9999999, False), rounded_outward(0.9999999, True)
    ('0.99999', '1')
    """
    context = Context(prec=digits, rounding=ROUND_CEILING if up else ROUND_FLOOR)
    return f"{float(context.create_decimal(float(bound))):.{digits}g}"


@functools.singledispatch
def picture(value: object) -> str | None:
    """The SVG of a value, by singledispatch; None for unknown or crowded ones."""
    return None


def _svg(self: object) -> str | None:
    """The SVG for notebooks; None for text."""
    try:
        importlib.import_module(_DRAWING)  # on first use, since matplotlib is slow to import
        drawing = picture(self)
    except Exception:  # a failed picture must not hide the object
        return None
    return None if drawing is None or len(drawing) > _DRAWN else drawing


def _html(self: object) -> str | None:
    """The SVG above the text; None without a picture."""
    drawing = _svg(self)
    if drawing is None:
        return None
    return (
        '<figure style="margin:0.4em 0"><div style="display:inline-block;max-width:100%;'
        f'overflow-x:auto;background:#fff;border-radius:6px;padding:4px">{drawing}</div>'
        f'<figcaption><pre style="margin:0.3em 0;white-space:pre-wrap">'
        f"{html.escape(repr(self))}</pre></figcaption></figure>"
    )
