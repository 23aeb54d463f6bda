"""Settings, state and metrics of robust anytime learning."""

from __future__ import annotations

from functools import partial

import jax
from jaxltl.core import struct

from jaxltl.algos.common.settings import COUNT, Number, static, traced
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.types import Status
from jaxltl.core.validation import Range

INTERVALS = ("linear", "confidence")


@brief
@struct.dataclass
class Hparams:
    """Settings; numbers are traced.

    Attributes:
      intervals: ``"linear"``: linearly updating intervals, which narrow fast and forget a wrong
        prior; ``"confidence"``: intervals that contain all true probabilities at all times with
        probability `confidence`; static; default ``"linear"``.
      confidence: in (0, 1); of ``"confidence"`` only; default 0.9.
      least: positive; assumed lower bound of each transition probability; default 1e-4.
      strength, most_strength: prior strengths in samples of linear intervals where data contradict
        them and where they agree, 0 < strength <= most_strength; default 5.0 and 10.0.
      exploration: in (0, 1], probability of any allowed action; default 0.1.
      restart: probability of restarting before a move in the almost-sure winning region; in the
        losing region 1; default 0.05.
      discount: in (0, 1), prefers actions that win soonest among those of equal value; default 0.99.
      sweeps: of value iteration in a step; at least the moves to the winning region; default 40.
      tolerance: change of the last sweep at which values count as converged; default 1e-4.
      num_runs, length: episodes in a step, and moves of each; static; default 4 and 64.
    """

    intervals: str = static(INTERVALS, default="linear")
    confidence: Number = traced(Range(0, 1, open_below=True, open_above=True), default=0.9)
    least: Number = traced(Range(0, 1, open_below=True), default=1e-4)
    strength: Number = traced(Range(0, open_below=True, open_above=True), default=5.0)
    most_strength: Number = traced(Range(0, open_below=True, open_above=True), default=10.0)
    exploration: Number = traced(Range(0, 1, open_below=True), default=0.1)
    restart: Number = traced(Range(0, 1), default=0.05)
    discount: Number = traced(Range(0, 1, open_below=True, open_above=True), default=0.99)
    sweeps: Number = traced(Range(1), default=40)
    tolerance: Number = traced(Range(0, open_above=True), default=1e-4)
    num_runs: int = static(COUNT, default=4)
    length: int = static(COUNT, default=64)


@brief
@struct.dataclass
class State:
    """Counts, intervals and values.

    Attributes:
      key, step: root key, and steps made, ``int32[]``.
      samples: ``int32[]``, observed transitions; near 2^31 further steps sample none.
      counts: ``int32[S, A, K]``, observations of each transition.
      lower, upper: ``float[S, A, K]``, intervals; 0 in padding.
      pessimistic, optimistic: ``float[S, Q]``, optimal satisfaction probability with adversarial
        and with cooperative nature, as far as value iteration has converged.
      best: ``bool[S, Q, A]``, preferred actions.
      residual: ``float[]``, largest change of the last sweep.
    """

    key: jax.Array
    step: jax.Array
    samples: jax.Array
    counts: jax.Array
    lower: jax.Array
    upper: jax.Array
    pessimistic: jax.Array
    optimistic: jax.Array
    best: jax.Array
    residual: jax.Array


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures after a step; scalars, of a run ``[T]``.

    Attributes:
      samples: observed transitions.
      lower, upper: pessimistic and optimistic value, mean over the initial distribution.
      residual: of :class:`State`.
      status: COMPLETED if the residual is at most the tolerance; MAX_STEPS if not, or if all
        samples that can be counted were observed.
    """

    samples: jax.Array
    lower: jax.Array
    upper: jax.Array
    residual: jax.Array
    status: jax.Array
