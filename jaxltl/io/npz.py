"""Models in the library's own ``.npz`` files, padded or sparse."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from jaxltl.core.validation import errors_in
from jaxltl.core.files import atomic_write, read_arrays
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.interval import IntervalMDP, interval_rows
from jaxltl.core.models.mdp import MDP, DenseMDP, from_dense, make_mdp
from jaxltl.core.models.pomdp import POMDP, make_pomdp
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Annotations, Rewards, SparseMDP, make_sparse
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.io.files import ALWAYS_ALLOWED, MAX_RATIO, raw_bytes
from jaxltl.io.text_output import exact_part

Arrays = Mapping[str, Array]
SparseT = TypeVar("SparseT", SparseMDP, IntervalMDP)

# Admissible NumPy kinds of each array, and their description.
_NUMBERS = ("biuf", "numbers")
_TRUTH = ("biuf", "truth values")
_WHOLE = ("iu", "whole numbers")
_TEXTS = ("USOiuf", "texts")
_SHARED = {
    "probability": _NUMBERS,
    "successor": _WHOLE,
    "initial": _NUMBERS,
    "label": _TRUTH,
    "propositions": _TEXTS,
    "actions": _TEXTS,
    "system": _TRUTH,
    "observation": _WHOLE,
}
_EXTRA = ("system", "observation")  # of games and of POMDPs
_ENDS = {"lower": _NUMBERS, "upper": _NUMBERS}  # of interval models
_BALL = {"center": _NUMBERS, "radius": _NUMBERS}  # of those with a ball besides
_OF_INTERVALS = {**_ENDS, **_BALL}
_PADDED = {"transition": _NUMBERS, "available": _TRUTH, **_SHARED, **_OF_INTERVALS}
_SPARSE = {"row_start": _WHOLE, "entry_start": _WHOLE, "action": _WHOLE, **_SHARED, **_OF_INTERVALS}
_VALUES = ("biufUS", "truth values, numbers and texts")
_REWARD, _VARIABLE, _OBSERVABLE = "reward:", "variable:", "observable:"
_PARTS = ("state", "choice", "transition")


def parse_arrays(raw: bytes, name: str, more: Sequence[str] = ()) -> dict[str, Array]:
    """Arrays of a model's ``.npz``, checked by name and kind; `more` are further allowed names."""
    _check_size(raw, name)
    try:
        arrays = read_arrays(io.BytesIO(raw))
    except ValueError as error:
        raise ValueError(f"{name!r} is not an .npz of plain arrays: {error}") from None
    sparse = _is_sparse(arrays)
    kinds = {
        k: v for k, v in (_SPARSE if sparse else _PADDED).items() if k not in _EXTRA or k in more
    }
    for key, array in arrays.items():
        kind = kinds.get(key)
        if sparse and key.startswith(_REWARD):
            kind = _NUMBERS
        elif (sparse and key.startswith(_VARIABLE)) or (
            "observation" in more and key.startswith(_OBSERVABLE)
        ):
            kind = _VALUES
        elif kind is None and key in more:
            continue
        if kind is None:
            listed = ", ".join([*kinds, *(m for m in more if m not in kinds)])
            raise ValueError(f"{name!r} holds an array {key!r}; it may hold {listed}.")
        if array.dtype.kind not in kind[0]:
            raise ValueError(f"{name!r}: {key} holds {array.dtype}; expected {kind[1]}.")
    return arrays


def _check_size(raw: bytes, name: str) -> None:
    """Raises ValueError for archives with a decompressed size above the limit."""
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    except Exception:  # damaged: read_arrays reports it
        return
    if size > ALWAYS_ALLOWED + MAX_RATIO * len(raw):
        raise ValueError(
            f"{name!r}, {len(raw)} bytes, would grow to {size} bytes; write it with "
            "numpy.savez, uncompressed, if this size is intended."
        )


def model_of(arrays: Arrays, name: str) -> tuple[MDP, tuple[str, ...] | None]:
    """Padded model in JAX's default precision, and its action names."""
    with errors_in(f"{name!r}: "):
        if set(arrays) & set(_ENDS):
            raise ValueError("its probabilities are intervals; a padded model has single numbers.")
        if _is_sparse(arrays):
            return to_padded(exact_part(sparse_model(arrays))), None
        mdp, _ = _padded_model(arrays)
        return mdp, _action_names(arrays, mdp.num_actions)


def _is_sparse(arrays: Arrays) -> bool:
    return "row_start" in arrays or "entry_start" in arrays


def _padded_model(arrays: Arrays) -> tuple[MDP, SparseMDP]:
    """Padded model, and the same in double precision as a sparse model."""
    available, initial, label = map(arrays.get, ("available", "initial", "label"))
    options = {"available": available, "initial": initial, "label": label}
    names = _propositions(arrays)
    exact: MDP | DenseMDP
    if "transition" in arrays:
        transition = arrays["transition"]
        mdp = from_dense(transition, propositions=names, **options)
        exact = DenseMDP(transition, mdp.available, mdp.initial, mdp.label, mdp.propositions)
    elif {"successor", "probability"} <= set(arrays):
        successor, probability = arrays["successor"], arrays["probability"]
        mdp = make_mdp(successor, probability, propositions=names, **options)
        exact = replace(mdp, successor=successor, probability=probability)
    else:
        raise ValueError("it needs the array transition, or successor and probability.")
    return mdp, to_sparse(exact if initial is None else replace(exact, initial=initial))


def _action_names(arrays: Arrays, count: int) -> tuple[str, ...] | None:
    if "actions" not in arrays:
        return None
    actions = tuple(str(a) for a in arrays["actions"].ravel())
    if len(set(actions)) != count:
        raise ValueError(
            f"actions has {len(set(actions))} distinct names; the model has {count} actions."
        )
    return actions


def _padded_interval(arrays: Arrays) -> tuple[IntervalMDP, int]:
    """Interval model from padded arrays ``[S, A, K]``, and A; ignores ``probability``."""
    missing = {"successor", *_ENDS} - set(arrays)
    if missing:
        raise ValueError(
            f"it needs the array {min(missing)}; an interval model has successor, lower and upper."
        )
    successor, lower, upper = (arrays[k] for k in ("successor", *_ENDS))
    if (
        successor.ndim != 3
        or not successor.shape == lower.shape == upper.shape
        or not (successor.size)
    ):
        raise ValueError(
            f"successor has shape {successor.shape}, lower {lower.shape} and upper "
            f"{upper.shape}; all must be [states, actions, successors]."
        )
    used = ~((lower == 0) & (upper == 0))
    available = np.asarray(arrays.get("available", used.any(-1)), bool)
    if available.shape != used.shape[:2]:
        raise ValueError(f"available has shape {available.shape}; expected {used.shape[:2]}.")
    used &= available[..., None]
    state, action = np.nonzero(available)
    ball: dict[str, Array] = {}
    for key, mask in (("center", used), ("radius", available)):
        if key in arrays:
            if arrays[key].shape != mask.shape:
                raise ValueError(
                    f"{key} has shape {arrays[key].shape}; expected {mask.shape}, as of "
                    f"{'lower' if key == 'center' else 'available'}."
                )
            ball[key] = arrays[key][mask]
    model = interval_rows(
        offsets_from_counts(available.sum(-1)),
        offsets_from_counts(used.sum(-1)[state, action]),
        successor[used],
        lower[used].astype(np.float64),
        upper[used].astype(np.float64),
        initial=arrays.get("initial"),
        label=arrays.get("label"),
        action=action,
        propositions=_propositions(arrays),
        center=ball.get("center"),
        radius=ball.get("radius"),
    )
    return model, used.shape[1]


def _propositions(arrays: Arrays) -> list[str]:
    return [str(x) for x in arrays.get("propositions", np.zeros(0, str)).ravel()]


def sparse_model(arrays: Arrays) -> SparseMDP | IntervalMDP:
    """Sparse model from CSR arrays; an interval model with lower and upper (center and radius)."""
    is_interval = bool(set(arrays) & set(_OF_INTERVALS))
    chances = tuple(_ENDS) if is_interval else ("probability",)
    missing = {"row_start", "entry_start", "successor", *chances} - set(arrays)
    if missing:
        raise ValueError(f"it needs the array {min(missing)}.")
    rewards: dict[str, dict[str, Array]] = {}
    for key, array in arrays.items():
        if key.startswith(_REWARD):
            reward, _, part = key.removeprefix(_REWARD).rpartition(":")
            if part not in _PARTS:
                raise ValueError(
                    f"the array {key!r} is unknown; expected a reward's name and state, choice or "
                    "transition after it."
                )
            rewards.setdefault(reward, {})[part] = array
    annotations = Annotations(
        label=arrays.get("label"),
        action=arrays.get("action"),
        propositions=_propositions(arrays),
        action_names=[str(x) for x in arrays.get("actions", np.zeros(0, str)).ravel()],
        rewards={k: Rewards(**v) for k, v in rewards.items()},
        valuation={
            key.removeprefix(_VARIABLE): array
            for key, array in arrays.items()
            if key.startswith(_VARIABLE)
        },
    )
    initial = arrays.get("initial")
    rows = (arrays["row_start"], arrays["entry_start"], arrays["successor"])
    if not is_interval:
        model = make_sparse(*rows, arrays["probability"], initial=initial, **annotations)
        return _with_initial(model, arrays)
    interval = interval_rows(
        *rows,
        *(arrays[k] for k in _ENDS),
        initial=initial,
        center=arrays.get("center"),
        radius=arrays.get("radius"),
        **annotations,
    )
    return _with_initial(interval, arrays)


def _with_initial(model: SparseT, arrays: Arrays) -> SparseT:
    """Restores the exact initial distribution; validation may have rescaled it."""
    if "initial" not in arrays:
        return model
    initial = np.asarray(arrays["initial"], np.float64)
    if isinstance(model, IntervalMDP):
        return replace(model, nominal=replace(model.nominal, initial=initial))
    return replace(model, initial=initial)


def read_npz(path: str | os.PathLike[str]) -> SparseMDP | IntervalMDP | Game | POMDP:
    """Model of an ``.npz`` file, in double precision.

    A padded file has ``transition``, ``[S, A, S]``, or ``successor`` and ``probability``,
    ``[S, A, K]``; a sparse one (:func:`write_npz`) the fields of a SparseMDP. The array ``system``
    makes it a game, ``observation`` a POMDP; ``lower`` and ``upper`` replace ``probability`` in interval models, with
    ``center`` and ``radius`` for an L1 ball.

    Args:
      path: the file.

    Returns:
      A SparseMDP, a Game or a POMDP over one, or an IntervalMDP.

    Raises:
      ValueError: with file and array, for unknown, missing or invalid arrays.
    """
    name = str(path)
    try:
        arrays = parse_arrays(raw_bytes(path), name, _EXTRA)
        with errors_in(f"{name!r}: "):
            observables = {
                key.removeprefix(_OBSERVABLE): array
                for key, array in arrays.items()
                if key.startswith(_OBSERVABLE)
            }
            if observables and "observation" not in arrays:
                raise ValueError(
                    f"it has {_OBSERVABLE}{min(observables)} and no array observation, the number of "
                    "each state's observation."
                )
            others = {"system", *_OF_INTERVALS} & set(arrays)
            if "observation" in arrays and others:
                raise ValueError(
                    f"it has observation and {min(others)}; games and interval models have no "
                    "observations."
                )
            if set(arrays) & set(_OF_INTERVALS) and "system" in arrays:
                raise ValueError(
                    "the probabilities of this game are intervals; chains and "
                    "decision processes support them."
                )
            model: SparseMDP | IntervalMDP
            if _is_sparse(arrays):
                model = sparse_model(arrays)
            elif set(arrays) & set(_OF_INTERVALS):
                interval, num_actions = _padded_interval(arrays)
                names = _action_names(arrays, num_actions) or ()
                named = replace(interval.nominal, action_names=names)
                model = _with_initial(replace(interval, nominal=named), arrays)
            else:
                mdp, sparse = _padded_model(arrays)
                names = _action_names(arrays, mdp.num_actions) or ()
                model = replace(sparse, action_names=names)
            if "observation" in arrays:
                return make_pomdp(model, arrays["observation"], observables=observables)
            return make_game(model, arrays["system"]) if "system" in arrays else model
    except MemoryError:
        raise ValueError(f"{name!r}: the model does not fit into the memory.") from None


def write_npz(path: str | os.PathLike[str], model: Model | POMDP) -> None:
    """Writes a model as a sparse ``.npz``, atomically.

    :func:`read_npz` restores it bit for bit; an empty reward becomes zeros on states.

    Args:
      path: the file.
      model: a model that ``to_sparse`` takes, a game, a POMDP or an interval model.

    Raises:
      ValueError: for variables of an unsupported type, or the file cannot be written.

    Example:
      >>> import tempfile, jaxltl as jl
      >>> path = tempfile.mkdtemp() + "/coin.npz"
      >>> write_npz(path, jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1]))
      >>> read_npz(path).probability.tolist()
      [0.5, 0.5, 1.0, 1.0]
    """
    arrays: dict[str, Array] = {}
    if isinstance(model, Game):
        arrays["system"] = np.asarray(model.system, np.bool_).ravel()
        model = model.mdp
    if isinstance(model, POMDP):
        arrays["observation"] = np.asarray(model.observation)
        for name, values in model.observables.items():
            arrays[f"{_OBSERVABLE}{name}"] = _storable(values, name, path)
        model = model.fully_observable
    keys = ["row_start", "entry_start", "successor", "probability", "initial", "label"]
    if isinstance(model, IntervalMDP):
        keys.remove("probability")
        ends = _ENDS if model.radius is None else _OF_INTERVALS
        arrays |= {k: np.asarray(getattr(model, k), np.float64) for k in ends}
    sparse = to_sparse(model.nominal if isinstance(model, IntervalMDP) else model)
    fields = {key: getattr(sparse, key) for key in (*keys, "action")}
    fields |= {"propositions": sparse.propositions or None, "actions": sparse.action_names or None}
    arrays |= {key: np.asarray(x) for key, x in fields.items() if x is not None}
    for name, reward in sparse.rewards.items():
        parts = {x: getattr(reward, x) for x in _PARTS if getattr(reward, x) is not None}
        for part, values in (parts or {"state": np.zeros(sparse.num_states)}).items():
            arrays[f"{_REWARD}{name}:{part}"] = np.asarray(values, np.float64)
    for name, values in sparse.valuation.items():
        arrays[f"{_VARIABLE}{name}"] = _storable(values, name, path)
    with atomic_write(path) as file:
        np.savez(file, **arrays)


def _storable(values: Array, name: str, path: str | os.PathLike[str]) -> Array:
    """The values of a variable; raises ValueError for those of an unsupported type."""
    values = np.asarray(values)
    if values.dtype.kind == "O" and all(isinstance(x, str) for x in values):
        values = values.astype(str)
    if values.dtype.kind not in _VALUES[0]:
        raise ValueError(
            f"{str(path)!r}: the variable {name!r} holds {values.dtype}; a file holds {_VALUES[1]}."
        )
    return values
