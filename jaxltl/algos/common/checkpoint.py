"""Checkpoints: a learner's state in a file, written atomically and read bit for bit.

A fingerprint of the problem and of the hyperparameters is stored with it: shape, dtype and hash of
every array, and every static field. A checkpoint of another problem is refused even if shapes
agree. Arrays on the devices of several processes are written in parts, one by each process, and
read onto any other mesh by any number of processes.

>>> import os, tempfile
>>> import numpy as np
>>> from jaxltl.algos.common import checkpoint
>>> path = os.path.join(tempfile.mkdtemp(), "state.npz")
>>> state, given = {"step": np.int32(3)}, checkpoint.fingerprint(problem=np.arange(2))
>>> checkpoint.save(path, state, given)
>>> checkpoint.load(path, {"step": np.int32(0)}, given)["step"].item()
3
>>> checkpoint.remove(path)
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import json
import os
import types
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.common import _checkpoint_parts as parts
from jaxltl.core.array_types import PyTree
from jaxltl.core.files import atomic_write, read_arrays
from jaxltl.core.models.ops.array_namespace import to_jax

_GIVEN = "given"  # the fingerprint's name in the file
_PARTS = "parts"  # name of the index of arrays in other files


def save(
    path: str | os.PathLike[str], state: PyTree, given: Mapping[str, str] | None = None
) -> None:
    """Writes a learner's `state`, a tree of arrays, as an ``.npz`` at `path`, atomically.

    `given` is the :func:`fingerprint` of the problem and hyperparameters. With several processes all
    call it, with a shared directory. Each writes its part of arrays on the devices of several, and the
    first process writes the file last.
    """
    path, named = Path(path), [(name, _data(leaf)) for name, leaf in _named(state)]
    apart = {name: leaf for name, leaf in named if parts.is_apart(leaf)}
    before = parts.parts_of(path)
    stored = parts.write(path, apart, atomic_write) if apart else {}
    if jax.process_index() and any(parts.is_shared(leaf) for _, leaf in named):
        return
    arrays: dict[str, PyTree] = {_GIVEN: np.array(json.dumps(dict(given or {})))}
    arrays |= {name: np.asarray(leaf) for name, leaf in named if name not in apart}
    if stored:
        arrays[_PARTS] = np.array(json.dumps({name: list(x) for name, x in stored.items()}))
    with atomic_write(path) as file:
        np.savez(file, **arrays)
    kept = {file for x in stored.values() for *_, file, _ in x.pieces}
    parts.remove([part for part in before if part.name not in kept])


def remove(path: str | os.PathLike[str]) -> None:
    """Removes the checkpoint at `path`, its parts and unfinished files; no process may be writing it.

    A missing file is no error.
    """
    path = Path(path)
    parts.remove([path, *parts.parts_of(path), *parts.unfinished(path)])


def load(
    path: str | os.PathLike[str], like: PyTree, given: Mapping[str, str] | None = None
) -> PyTree:
    """The state saved by :func:`save` at `path`, bit for bit, as a tree like `like`.

    `like` is a state of the same learner and problem, for example from ``init``; a first axis of length
    zero matches any length. Arrays are placed on its devices, and each process reads its parts.
    `given` is as for :func:`save`.

    Raises:
      ValueError: the file is damaged, its arrays do not fit `like`, or it was saved for another problem
        or other hyperparameters.
    """
    with parts.Parts(path) as others:
        try:
            # An open file of our own is closed even where a damaged archive is given up.
            with open(path, "rb") as file:
                arrays: dict[str, PyTree] = read_arrays(file)
            before = json.loads(str(arrays.pop(_GIVEN)))
            stored = json.loads(str(arrays.pop(_PARTS, "{}")))
            arrays |= {name: parts.Stored(*x) for name, x in stored.items()}
            leaves = [
                _loaded(str(path), name, leaf, arrays.get(name), others)
                for name, leaf in _named(like)
            ]
        except _Another as error:
            raise ValueError(str(error)) from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{str(path)!r} is not a saved state: {error}") from error
    _require_same(str(path), before, dict(given or {}))
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


class _Another(Exception):
    """An array of another learner or problem."""


def _loaded(path: str, name: str, leaf: PyTree, found: PyTree, others: parts.Parts) -> PyTree:
    """An array on its devices, from the file or from the parts."""
    expected = _data(leaf)
    if found is None or not _fits(found, expected):
        is_ = "missing" if found is None else f"{found.dtype}{list(found.shape)}"
        raise _Another(
            f"{path!r} does not belong to this run: {name} is {is_}, expected "
            f"{expected.dtype}{list(expected.shape)}. Delete the file to start afresh."
        )
    if isinstance(expected, jax.Array) and len(expected.sharding.device_set) > 1:

        def block(index: tuple[slice, ...] | None) -> np.ndarray:
            stored = isinstance(found, parts.Stored)
            return others.read(found, index) if stored else found[index or ()]

        value = jax.make_array_from_callback(tuple(found.shape), expected.sharding, block)
    else:
        value = to_jax(others.read(found) if isinstance(found, parts.Stored) else found)
    if expected is not leaf:
        value = jax.random.wrap_key_data(value, impl=jax.random.key_impl(leaf))
    return value


def _fits(found: np.ndarray | parts.Stored, expected: jax.Array) -> bool:
    shape = expected.shape
    if shape[:1] == (0,):
        shape = (*found.shape[:1], *shape[1:])
    return tuple(found.shape) == shape and found.dtype == expected.dtype


def _require_same(path: str, before: dict[str, str], now: dict[str, str]) -> None:
    other = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if other:
        name = other[0]
        raise ValueError(
            f"{path!r} does not belong to this run: {name} was "
            f"{before.get(name, 'not given')} and is {now.get(name, 'not given')}"
            + (f" ({len(other)} differences)" if len(other) > 1 else "")
            + ". Delete the file to start afresh, or continue with the original arguments."
        )


def _named(tree: PyTree) -> list[tuple[str, PyTree]]:
    """Leaves with distinct file-safe names, numbered to distinguish nested paths."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [
        (f"{i}{jax.tree_util.keystr(path)}".replace("/", "_"), _array_of(leaf))
        for i, (path, leaf) in enumerate(leaves)
    ]


def _array_of(leaf: PyTree) -> PyTree:
    """As ``jnp.asarray``, but NumPy arrays stay on the host, where nothing is compiled."""
    if not isinstance(leaf, np.ndarray):
        return jnp.asarray(leaf)
    return leaf.astype(jax.dtypes.canonicalize_dtype(leaf.dtype), copy=False)


def _data(leaf: jax.Array) -> jax.Array:
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


# --- fingerprints ---------------------------------------------------------------------------


def fingerprint(**given: object) -> dict[str, str]:
    """A description of each part of `given`: types, static fields, and arrays by a hash of their bytes.

    Functions are described by their code, so that other processes find the same.

    >>> one, two = (fingerprint(x=(np.arange(2), {"b": y})) for y in (0.5, 0.25))
    >>> sorted(one), [name for name in one if one[name] != two[name]]
    (['x[0]', "x[1]['b']"], ["x[1]['b']"])
    """
    return dict(pair for name, value in given.items() for pair in _described(name, value))


def _described(name: str, value: PyTree) -> Iterator[tuple[str, str]]:
    value = inspect.unwrap(value)  # what jax.jit wraps
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.dtype):
        yield name, repr(value)
    elif isinstance(value, jax.Array | np.ndarray | np.generic):
        yield name, _array(value)
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield from _described(f"{name}[{key!r}]", value[key])
    elif isinstance(value, list | tuple):
        names = getattr(value, "_fields", None)
        for i, entry in enumerate(value):
            yield from _described(f"{name}.{names[i]}" if names else f"{name}[{i}]", entry)
    elif isinstance(value, functools.partial):  # JAX's are its children
        for part in ("func", "args", "keywords"):
            yield from _described(f"{name}.{part}", getattr(value, part))
    elif isinstance(value, types.FunctionType):
        yield from _function(name, value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield name, _type(value)
        for field in dataclasses.fields(value):
            if field.name not in ("parent", "name"):  # of a flax module: where it hangs
                yield from _described(f"{name}.{field.name}", getattr(value, field.name))
    else:
        leaves, structure = jax.tree.flatten(value)
        yield name, _type(value) if jax.tree_util.treedef_is_leaf(structure) else str(structure)
        if not jax.tree_util.treedef_is_leaf(structure):
            yield from _described(name, leaves)


def _array(value: object) -> str:
    """Shape, dtype and a hash of the bytes; small arrays also as text."""
    value = _data(value) if isinstance(value, jax.Array) else value
    array = np.asarray(value)
    digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]
    shown = f" = {array.tolist()}" if array.size <= 4 else ""
    return f"{array.dtype}{list(array.shape)}{shown} #{digest}"


def _function(name: str, value: types.FunctionType) -> Iterator[tuple[str, str]]:
    yield name, f"{value.__module__}.{value.__qualname__} #{_code(value.__code__)}"
    for free, cell in zip(value.__code__.co_freevars, value.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # a cell that is empty yet
            held = inspect.unwrap(cell.cell_contents)
            if isinstance(held, types.FunctionType):  # its own cells may lead back here
                yield f"{name}.{free}", _code(held.__code__)
            else:
                yield from _described(f"{name}.{free}", held)


def _code(code: types.CodeType) -> str:
    held = [_code(c) if isinstance(c, types.CodeType) else _constant(c) for c in code.co_consts]
    return hashlib.sha256(code.co_code + repr((held, code.co_names)).encode()).hexdigest()[:16]


def _constant(value: object) -> str:
    """The representation of a constant; sets in an order that is the same in every process."""
    return repr(sorted(map(repr, value)) if isinstance(value, frozenset) else value)


def _type(value: object) -> str:
    kind = value if isinstance(value, type) else type(value)
    return f"{kind.__module__}.{kind.__qualname__}"
