"""Conversion between sparse models and stormpy models.

Through a temporary UMB file (:mod:`jaxltl.io.umb.umb`); stormpy is imported only here, on use.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

from jaxltl.core.models import POMDP, Game, IntervalMDP, SparseMDP, to_sparse
from jaxltl.core.models.protocols import Model
from jaxltl.io.umb.umb import read_umb, write_umb

StormModel: TypeAlias = Any  # a sparse model of the optional package stormpy


def from_stormpy(model: StormModel) -> SparseMDP | IntervalMDP | Game | POMDP:
    """Model of a sparse stormpy model, bit for bit.

    Keeps the order of states and choices, labels (``"init"`` becomes the initial distribution),
    rewards, choice labels as action names, and state valuations; exact probabilities are rounded.

    Args:
      model: a `SparseDtmc`, `SparseMdp`, `SparsePomdp` or `SparseSmg`, or one of the first two with intervals.

    Returns:
      A SparseMDP, a Game or POMDP over one, or an IntervalMDP.

    Raises:
      ValueError: stormpy (version 2 or later) is missing, or the model has another type.

    Example:
      >>> import importlib.util, jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> if importlib.util.find_spec("stormpy"):
      ...     assert (from_stormpy(to_stormpy(coin)).probability == coin.probability).all()
    """
    storm = _stormpy()
    kind, options = type(model).__name__.strip("_"), storm.io.UmbExportOptions()
    options.compression = storm.io.CompressionMode.NO_COMPRESSION
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.umb"
        try:
            storm.io.export_to_umb(model, str(path), options=options)
        except Exception:  # several types, none of them public
            raise ValueError(
                f"from_stormpy: Storm does not write this {kind} as UMB. Give a sparse Markov "
                "chain, decision process or game, without parameters."
            ) from None
        try:
            return read_umb(path)
        except ValueError as error:
            reason = str(error).replace(str(path), kind)
            raise ValueError(f"from_stormpy: {reason}") from None


def to_stormpy(model: Model | POMDP) -> StormModel:
    """Sparse stormpy model of a model, bit for bit; keeps the support of the initial distribution.

    Args:
      model: a model that ``to_sparse`` takes, a Game, an IntervalMDP or a POMDP.

    Returns:
      A `SparseDtmc` if every state has one choice, else a `SparseMdp`, `SparseSmg` or `SparsePomdp`; with
      intervals for an interval model.

    Raises:
      ValueError: stormpy (version 2 or later) is missing.

    Example:
      >>> import importlib.util, jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> if importlib.util.find_spec("stormpy"):
      ...     assert to_stormpy(coin).nr_states == 3
    """
    storm = _stormpy()
    base = model.mdp if isinstance(model, Game) else model
    base = base.fully_observable if isinstance(base, POMDP) else base
    sparse = to_sparse(base.nominal if isinstance(base, IntervalMDP) else base)
    options = storm.io.UmbImportOptions()
    options.build_state_valuations = bool(
        sparse.valuation
    )  # else Storm warns of missing valuations
    options.build_choice_labeling = sparse.action is not None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.umb"
        if isinstance(model, Game):
            model = replace(model, mdp=sparse)
        is_whole = isinstance(model, Game | IntervalMDP | POMDP)
        write_umb(path, model if is_whole else sparse, compression=None)
        return storm.build_model_from_umb(str(path), options=options)


def _stormpy() -> ModuleType:
    try:
        import stormpy
        import stormpy.io
    except ImportError:
        stormpy = None
    if not hasattr(stormpy, "build_model_from_umb") or not hasattr(stormpy.io, "export_to_umb"):
        raise ValueError(
            "this takes the package stormpy, version 2 or later; install it (pip install stormpy), "
            "or exchange files that Storm writes by read_model and write_model."
        )
    return stormpy
