"""Settings, state and metrics of R-max."""

from __future__ import annotations

from functools import partial

import jax
from jaxltl.core import struct

from jaxltl.algos.common.settings import COUNT, Number, static, traced
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.types import Status
from jaxltl.core.validation import Range

UPDATES = ("every", "printed")


@brief
@struct.dataclass
class Hparams:
    """Settings of algorithm 5; numbers are traced, None is static.

    Attributes:
      discount: in (0, 1), of every move.
      reward_bound: R_max, positive; rewards lie in [0, R_max].
      epsilon: positive; the loss of value that the final strategy may have.
      failure: delta_c in (0, 1), probability of a larger loss; default 0.1.
      known_after: visits after which a pair with several successors is known. None: K of theorem
        6, out of reach for all but toys; a number voids the theorem, and :func:`evidence` remains.
        Default None.
      restart: probability of restarting before a move; default 0.0.
      update: ``"every"`` observed reward enters the model; ``"printed"``: only that of a pair's
        last successor before it is known (algorithm 5, line 16), which is wrong for actions with
        several successors; static; default ``"every"``.
      moves_per_step: a step ends with a change of the model, or after this many moves; static;
        default 128.
    """

    discount: Number = traced(Range(0, 1, open_below=True, open_above=True))
    reward_bound: Number = traced(Range(0, open_below=True, open_above=True))
    epsilon: Number = traced(Range(0, open_below=True, open_above=True))
    failure: Number = traced(Range(0, 1, open_below=True, open_above=True), default=0.1)
    known_after: Number | None = traced(Range(1), default=None)
    restart: Number = traced(Range(0, 1), default=0.0)
    update: str = static(UPDATES, default="every")
    moves_per_step: int = static(COUNT, default=128)


@brief
@struct.dataclass
class State:
    """Observations, the optimistic model, and its near-optimal actions.

    Attributes:
      key, step: root key, and steps made, ``int32[]``.
      moves: ``int32[]``, moves made, at most 2^31 - 1; further steps make none.
      position: ``int32[]``, the current state of the game.
      counts: ``int32[S, A, K]``, observations of each transition; in a deterministic game at most 1.
      reward: ``float[S, A, K]``, observed rewards; ``R_max / (1 - discount)`` elsewhere.
      known_at: ``int32[S, A]``, moves after which a pair became known; -1 before.
      num_known: ``int32[]``, known pairs.
      probability, gain: ``float[S, A, K]`` and ``[S, A]``, transition probabilities and expected
        rewards of the optimistic model.
      value, best: ``float[S]`` and ``bool[S, A]``, its value and near-optimal actions.
      error: ``float[]``, bound on the error of `value` up to a constant.
      last_update, num_updates: ``int32[]``, moves at the last computation of the strategy, and the
        number of these.
      always_almost_sure: ``bool[]``, True if every strategy so far had positive probability on every
        allowed action, so that it wins almost surely (lemma 6).
      fault: ``int32[]``, the first pair ``s * A + a`` with a reward outside of [0, R_max], or -1.
    """

    key: jax.Array
    step: jax.Array
    moves: jax.Array
    position: jax.Array
    counts: jax.Array
    reward: jax.Array
    known_at: jax.Array
    num_known: jax.Array
    probability: jax.Array
    gain: jax.Array
    value: jax.Array
    best: jax.Array
    error: jax.Array
    last_update: jax.Array
    num_updates: jax.Array
    always_almost_sure: jax.Array
    fault: jax.Array


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures after a step; scalars, of a run ``[T]``.

    Attributes:
      moves, num_known, last_update, num_updates, always_almost_sure, fault: of :class:`State`.
      value: of the optimistic model, mean over the initial distribution.
      residual: ``state.error``.
      status: of the last solve of the optimistic model; MAX_STEPS if it missed its tolerance, or
        if all moves that can be counted were made.
    """

    moves: jax.Array
    num_known: jax.Array
    last_update: jax.Array
    num_updates: jax.Array
    value: jax.Array
    always_almost_sure: jax.Array
    fault: jax.Array
    residual: jax.Array
    status: jax.Array


def reward_error(state: int, action: int, reward: float, hparams: Hparams) -> ValueError:
    """The ValueError for an observed reward outside of [0, R_max]."""
    return ValueError(
        f"state {state}, action {action}: a reward of {reward:g} was observed, outside of [0, "
        f"reward_bound={float(hparams.reward_bound):g}]. The guarantee rests on that bound: give a "
        "larger reward_bound and learn anew."
    )
