"""Short ``repr`` of objects: a few lines of facts, never pages of arrays.

The decorator ``brief`` defines the ``repr`` of a class. Small arrays on the host are read; of traced,
abstract and distributed arrays only the dtype and the shape appear. This module does not import JAX,
and looks it up only where it is already loaded.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import importlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Floats

WIDTH, LINES = 100, 10  # characters of a line, and lines, that a repr has at most
READ = 2**20  # entries of an array up to which its values are read
_LIST = 6  # entries that are shown one by one
_HEAD = 60  # characters of an object inside of another
_DRAWN = 300_000  # characters of a picture in a notebook
_DRAWING = "jaxltl.plot.notebook"  # registers the pictures of types

Facts = Callable[[Any], Iterable[str]]
Class = TypeVar("Class", bound=type)


@overload
def brief(cls: Class, /) -> Class: ...


@overload
def brief(
    *, facts: Facts | None = None, drawn: bool = False, codes: Mapping[str, Any] = ...
) -> Callable[[Class], Class]: ...


def brief(
    cls: object = None,
    /,
    *,
    facts: Facts | None = None,
    drawn: bool = False,
    codes: Mapping[str, Any] | None = None,
) -> Any:
    """A class decorator for a short ``repr``."""
    if cls is None:
        return functools.partial(brief, facts=facts, drawn=drawn, codes=codes)
    target: Any = cls
    plain = functools.partial(fields, codes=codes)
    target._brief_facts = staticmethod(functools.partial(_safe, facts or plain, plain))
    target.__repr__ = _repr
    if drawn:
        target._repr_svg_, target._repr_html_ = _svg, _html
    return target


def _repr(self: Any) -> str:
    return laid_out(type(self).__name__, self._brief_facts(self))


def _safe(facts: Facts, plain: Facts, value: object) -> list[str]:
    """The facts of an object; JAX temporarily stores axes and shardings in the fields of trees."""
    for describe in (facts, plain):
        try:
            return [text for text in describe(value) if isinstance(text, str) and text]
        except Exception:
            continue
    return ["..."]


# --- lines ----------------------------------------------------------------------------------------


def laid_out(name: str, facts: Sequence[str]) -> str:
    """A name with facts in parentheses, in at most `LINES` lines."""
    line = f"{name}({', '.join(facts)})"
    if len(line) <= WIDTH and "\n" not in line:
        return line
    lines = [f"{name}("]
    for i, fact in enumerate(facts):
        text = truncate(fact, WIDTH - 5) + ("," if i + 1 < len(facts) else ")")
        if len(lines) > 1 and len(lines[-1]) + 1 + len(text) <= WIDTH:
            lines[-1] += " " + text
        else:
            lines.append("    " + text)
    if len(lines) > LINES:
        lines = [*lines[: LINES - 1], "    ...)"]
    return "\n".join(lines)


def nested_repr(value: object, width: int = _HEAD) -> str:
    """The ``repr`` of an object inside another: its name and as many facts as fit."""
    facts = getattr(type(value), "_brief_facts", None)
    if facts is None:
        return truncate(repr(value), width)
    texts, name = facts(value), type(value).__name__
    words = list(texts)
    while words and len(f"{name}({', '.join(words)}, ...)") > width:
        words.pop()
    if len(words) < len(texts):
        words.append("...")
    return f"{name}({', '.join(words)})"


def truncate(text: str, width: int = _HEAD) -> str:
    """A text in one line of at most `width` characters."""
    text = " ".join(text.split())
    return text if len(text) <= width else f"{text[: width - 3]}..."


def count(number: Any, noun: str, nouns: str = "") -> str:
    """A number with a noun.

    >>> count(1, "state"), count(1_000_000, "state"), count(2, "entry", "entries")
    ('1 state', '1,000,000 states', '2 entries')
    """
    return f"{int(number):,} {noun if number == 1 else nouns or noun + 's'}"


def names_text(words: Iterable[Any], width: int = _HEAD) -> str:
    """A list of names, truncated with the total number.

    >>> names_text(f"a{i}" for i in range(1000))
    'a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, a10, a11, a12, a13, ... (1000 in all)'
    """
    if is_array(words):
        return array_text(words)
    listed = list(words)
    names = [str(word) for word in listed[:width]]
    while len(names) > 1 and len(", ".join(names)) > width:
        names.pop()
    text = truncate(", ".join(names), width)
    return text if len(names) == len(listed) else f"{text}, ... ({len(listed)} in all)"


def propositions_text(propositions: Sequence[str]) -> str:
    """The propositions of labels."""
    return f"over {names_text(propositions) or 'no propositions'}"


def batch_text(shape: Sequence[int]) -> str:
    """The batch shape; empty for no batch."""
    if len(shape) == 1:
        return count(shape[0], "lane")
    return f"{' x '.join(f'{n:,}' for n in shape)} lanes" if shape else ""


# --- arrays ---------------------------------------------------------------------------------------


def is_array(value: object) -> bool:
    """True for objects with a shape and a dtype, abstract ones included."""
    return hasattr(value, "shape") and hasattr(value, "dtype")


def readable(value: Any, limit: int = READ) -> NDArray[Any] | None:
    """The NumPy array of an array that the host can read at once, else None."""
    if isinstance(value, bool | int | float):
        return np.asarray(value)
    if not is_array(value) or not isinstance(value.dtype, np.dtype) or value.size > limit:
        return None
    if not isinstance(value, np.ndarray | np.generic):
        jax = sys.modules.get("jax")
        if jax is None or not isinstance(value, jax.Array) or isinstance(value, jax.core.Tracer):
            return None
        if value.is_deleted() or not value.is_fully_addressable:
            return None
    try:
        array = np.asarray(value)
    except Exception:  # such as a transfer that is forbidden
        return None
    return None if array.dtype.kind in "OSU" else array


def array_text(value: Any) -> str:
    """The dtype and the shape of an array, and its devices if there are several.

    >>> array_text(np.zeros((2, 3), np.float32))
    'float32[2, 3]'
    """
    text = f"{value.dtype}[{', '.join(f'{n}' for n in value.shape)}]"
    jax = sys.modules.get("jax")
    if jax is None or not isinstance(value, jax.Array):
        return text
    if isinstance(value, jax.core.Tracer):
        return f"traced {text}"
    if value.is_deleted():
        return f"deleted {text}"
    devices = len(value.sharding.device_set)
    return f"{text} on {devices} devices" if devices > 1 else text


def number(value: object) -> str:
    """A number, with six digits unless it is an integer."""
    whole = isinstance(value, bool | np.bool_ | int | np.integer)
    return str(value) if whole else f"{value:.6g}"


def value_range(value: object) -> str:
    """The values of an array: all of a few, the range of many.

    >>> value_range(np.array([0.25, np.nan])), value_range(np.arange(9)), value_range(np.zeros(9, bool))
    ('[0.25, nan]', '0 to 8', '0 of 9 true')
    """
    read = readable(value)
    if read is None or read.size == 0 or read.dtype.kind == "c":
        return array_text(value) if is_array(value) else truncate(repr(value))
    if read.dtype.kind not in "biuf":  # narrow floats
        read = read.astype(np.float32)
    if read.ndim == 0:
        return number(read[()])
    if read.ndim == 1 and read.size <= _LIST:
        return f"[{', '.join(number(x) for x in read)}]"
    if read.dtype.kind == "b":
        return f"{np.count_nonzero(read):,} of {read.size:,} true"
    known = read[read == read]
    if not known.size:
        return "all nan"
    low, high, missing = known.min(), known.max(), read.size - known.size
    text = f"all {number(low)}" if low == high else f"{number(low)} to {number(high)}"
    return f"{text}, {missing:,} nan" if missing else text


def is_vacuous(lower: Floats, upper: Floats) -> Booleans:
    """Marks bounds that exclude no probability, or no reward on one side.

    >>> is_vacuous(np.array([0, 0, 2, np.inf]), np.array([1, 0.5, np.inf, np.inf])).tolist()
    [True, False, True, False]
    """
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    infinite = np.isinf(low) | np.isinf(high)
    marked: Booleans = (
        ((low <= 0) & (high == 1)) | (infinite & (low != high)) | np.isnan(low) | np.isnan(high)
    )
    return marked


def bounds_text(lower: object, upper: object) -> str:
    """The largest width of certified bounds, and the number of states without.

    >>> bounds_text(np.zeros(3), np.array([0, 1e-6, np.inf])), bounds_text(-np.inf, np.inf)
    ('bounds at most 1e-06 apart, none for 1 of 3', 'no bounds')
    """
    low, high = readable(lower), readable(upper)
    if low is None or high is None or not low.size:
        return ""
    low, high = low.astype(np.float64), high.astype(np.float64)
    with np.errstate(invalid="ignore"):
        width = np.where(low == high, 0.0, high - low)
    known = np.isfinite(width)
    if not known.any():
        return "no bounds"
    widest = width[known].max()
    text = f"bounds at most {widest:.2g} apart" if widest > 0 else "bounds meet"
    none = known.size - int(np.count_nonzero(known))
    return f"{text}, none for {none:,} of {known.size:,}" if none else text


def rounded_outward(bound: float, up: bool, digits: int = 5) -> str:
    """A bound as text with some significant digits, rounded up or down.

    >>> rounded_outward(0.9999999, False), rounded_outward(0.9999999, True)
    ('0.99999', '1')
    """
    context = Context(prec=digits, rounding=ROUND_CEILING if up else ROUND_FLOOR)
    return f"{float(context.create_decimal(float(bound))):.{digits}g}"


def enum_counts(value: object, codes: Iterable[enum.IntEnum]) -> str:
    """The name of a code; for an array the number of each code."""
    read = readable(value)
    if read is None or read.dtype.kind not in "iu":
        return array_text(value) if is_array(value) else truncate(str(value))
    numbers, times = np.unique(read, return_counts=True)
    known = {int(code): code.name for code in codes}
    words = [known.get(int(n), str(n)) for n in numbers]
    if read.ndim == 0:
        return words[0]
    return ", ".join(f"{n:,} {word}" for n, word in zip(times.tolist(), words, strict=True))


# --- fields ---------------------------------------------------------------------------------------


def fields(value: Any, codes: Mapping[str, Any] | None = None) -> Iterator[str]:
    """All fields of an object with their values, and the batch shape of a learner's state."""
    step = getattr(value, "step", None)
    if step is not None and is_array(step):
        yield batch_text(step.shape)
    keys = getattr(value, "_fields", None)
    if keys is None:
        keys = [x.name for x in dataclasses.fields(value) if x.repr]
    for name in keys:
        entry = getattr(value, name)
        if not (is_array(entry) and str(entry.dtype).startswith("key<")):  # of random numbers
            yield field(name, entry, (codes or {}).get(name))


def field(name: str, value: object, codes: Iterable[enum.IntEnum] | None = None) -> str:
    """A field with its value."""
    if codes is not None and is_array(value):
        return f"{name}={enum_counts(value, codes)}"
    return f"{name}={describe(value)}"


def describe(value: Any) -> str:
    """A short description of any value."""
    if is_array(value):
        text = value_range(value)
        if text.startswith("[") or np.ndim(value) == 0 or text == array_text(value):
            return text
        joined = "with " if value.dtype == bool else "from " if " to " in text else ""
        return f"{array_text(value)} {joined}{text}"
    if hasattr(type(value), "_brief_facts"):
        return nested_repr(value)
    if isinstance(value, enum.Enum):
        return value.name
    if value is None or isinstance(value, str | bytes | bool | int | float | complex):
        return truncate(repr(value))
    if isinstance(value, tuple | list) and all(isinstance(x, str | int | float) for x in value):
        return f"({names_text(value)}{',' if len(value) == 1 else ''})"
    return _tree(value)


def _tree(value: object) -> str:
    """A description of a tree or function: its type or name, and the number of arrays."""
    leaves = [x for x in _leaves(value) if is_array(x)]
    inner = value
    while hasattr(inner, "func"):  # of partial functions
        inner = inner.func
    name = getattr(inner, "__name__", type(value).__name__)
    if not leaves and (callable(value) or not isinstance(value, dict | list | tuple)):
        return truncate(name)
    size = sum(int(np.prod(x.shape)) for x in leaves)
    text = f"{count(len(leaves), 'array')} of {count(size, 'number')}"
    if isinstance(value, dict) and not leaves:
        return f"{{{names_text(value)}}}"
    plain = isinstance(value, dict | list | tuple) and not hasattr(value, "_fields")
    return text if plain else f"{truncate(name)}({text})"


def _leaves(value: object) -> list[Any]:
    """The leaves of a tree."""
    jax = sys.modules.get("jax")
    if jax is not None:
        return list(jax.tree.leaves(value))
    if not isinstance(value, dict | list | tuple):
        return [value]
    inner = value.values() if isinstance(value, dict) else value
    return [leaf for x in inner for leaf in _leaves(x)]


def history(value: Any, codes: Mapping[str, Any] | None = None) -> Iterator[str]:
    """Fields of histories: the last row of each, and the counts of all statuses ``[..., rows]``."""
    shape = tuple(value.status.shape)
    if not shape or readable(value.status) is None:
        yield from fields(value, codes)
        return
    yield f"the last of {' x '.join(f'{n:,}' for n in shape)} rows"
    for one in dataclasses.fields(value):
        entry, code = getattr(value, one.name), (codes or {}).get(one.name)
        read = readable(entry) if code is None else None
        if read is None or read.ndim < len(shape):
            yield field(one.name, entry, code)
        else:
            yield f"{one.name}={value_range(np.take(read, -1, axis=len(shape) - 1))}"


# --- pictures -------------------------------------------------------------------------------------


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
    text = repr(self).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return (
        '<figure style="margin:0.4em 0"><div style="display:inline-block;max-width:100%;'
        f'overflow-x:auto;background:#fff;border-radius:6px;padding:4px">{drawing}</div>'
        f'<figcaption><pre style="margin:0.3em 0;white-space:pre-wrap">{text}</pre></figcaption>'
        "</figure>"
    )
