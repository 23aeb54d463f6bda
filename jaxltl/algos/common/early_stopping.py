"""Learning that ends when held-out data have not been explained better for a while."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from jaxltl.core import struct

from jaxltl.algos.common.trees import choose
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.pretty_print import brief


@brief
@struct.dataclass
class Best:
    """The parameters with the best held-out likelihood; without held-out data the newest.

    Attributes:
      parameters, step: of the network, a pytree, and steps made until then, ``int32[]``.
      neg_log_likelihood: ``float[]``, held out, in nats a pair; NaN without held-out data.
    """

    parameters: PyTree
    neg_log_likelihood: jax.Array
    step: jax.Array


def stop_early(
    state: PyTree, after: PyTree, held_out: jax.Array, judged: jax.Array, patience: chex.Numeric
) -> tuple[Best, jax.Array]:
    """The :class:`Best` parameters so far, and ``bool[]``, whether patience has run out.

    Of the `state` before a step, with ``parameters``, ``step``, ``best`` and ``stopped``; the
    parameters `after` it; their predecessors' negative log-likelihood `held_out`, ``float[]``; `judged`,
    True with held-out data; and `patience`, in steps.

    >>> from types import SimpleNamespace
    >>> best = Best(jnp.zeros(1), jnp.array(0.5), jnp.int32(2))
    >>> state = SimpleNamespace(
    ...     parameters=jnp.ones(1), step=jnp.int32(9), best=best, stopped=jnp.bool_(False))
    >>> stop_early(state, jnp.full(1, 2.0), jnp.array(0.6), jnp.bool_(True), 5)[1].item()
    True
    """
    better = judged & (held_out < state.best.neg_log_likelihood) & ~state.stopped
    best = choose(better, Best(state.parameters, held_out, state.step), state.best)
    newest = Best(after, jnp.full_like(held_out, jnp.nan), state.step + 1)
    stopped = state.stopped | (judged & (state.step - best.step >= patience))
    return choose(judged, best, newest), stopped
