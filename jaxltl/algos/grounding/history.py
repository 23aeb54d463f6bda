"""Back-off count tables: action probabilities given the recent history of a demonstration.

Two chains of contexts, each extended by one older symbol a level: the states ``s_t, s_{t-1}, ...``, and
the actions ``a_{t-1}, a_{t-2}, ...`` after the kind of ``s_t``, the set of its actions without effect.
With counts n, a context c has the Dirichlet-smoothed probabilities (MacKay and Peto 1995)
``p(a | c) = (n(c, a) + strength p(a | c')) / (n(c) + strength)``, where c' is the context without its
oldest symbol; the first level backs off to the uniform distribution. The strength of each level
maximises the likelihood of each demonstration under the counts of all others.

Example: the actions of a demonstration are equal.
  >>> import jaxltl as jl
  >>> from jaxltl.algos import grounding
  >>> world = jl.from_dense([[[1.0], [1.0]]])
  >>> shown = jl.make_trajectories(world, [[(0, n % 2)] * 5 for n in range(20)])
  >>> tables = grounding.fit_history(world, shown, past_states=0, past_actions=1)
  >>> new = tables.evidence(jl.make_trajectories(world, [[(0, 1), (0, 1)]]))
  >>> new.shape, bool(new[0, 1, 1, 2] > -0.05)  # [N, T, A, E]
  ((1, 2, 2, 3), True)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.trajectories import Trajectories, require_states
from jaxltl.core.validation import Range, require_in_range

_STRENGTHS = tuple(2.0**k for k in range(-1, 9))
_LEAST = 1e-6  # probability: bounds the evidence of one table


class _Level(NamedTuple):
    """Sorted codes of the contexts, their counts ``float[K + 1, A]``, the last row 0, and strengths."""

    keys: np.ndarray
    counts: np.ndarray
    strengths: tuple[float, ...]


class HistoryTables(NamedTuple):
    """Count tables of :func:`fit_history`.

    Attributes:
      world: with S states and A actions.
      chains: the levels of the chain of states and of the chain of actions.
      left_out: ``float[N, T, A, E]``, the evidence of the fitted demonstrations, each without its own
        counts.
    """

    world: MDP
    chains: tuple[tuple[_Level, ...], ...]
    left_out: np.ndarray

    def evidence(self, demonstrations: Trajectories) -> np.ndarray:
        """``log p(a | c)`` at each step of new demonstrations, ``float[N, T, A, E]``, a table a level.

        It depends on the states up to the step and the actions before it alone. The demonstrations
        that were fitted have the evidence ``left_out``.
        """
        orders = [len(chain) - 1 for chain in self.chains]
        return _evaluated(self.world, demonstrations, orders, self.chains)[1]


def fit_history(
    world: MDP, demonstrations: Trajectories, *, past_states: int = 5, past_actions: int = 8
) -> HistoryTables:
    """The :class:`HistoryTables` of demonstrations, ``past_states + past_actions + 2`` levels in all.

    Of at least two `demonstrations` in a `world`; `past_states` and `past_actions`, at least 0, are the
    lengths of the two chains.

    Raises:
      ValueError: fewer than two demonstrations, another model's, or a negative length.
    """
    for name, value in (("past_states", past_states), ("past_actions", past_actions)):
        require_in_range(name, value, Range(0, integer=True))
    if (count := len(demonstrations.state)) < 2:
        raise ValueError(
            f"there are {count} demonstrations; give at least 2: each is scored by the others."
        )
    return HistoryTables(world, *_evaluated(world, demonstrations, [past_states, past_actions]))


def _evaluated(
    world: MDP,
    demonstrations: Trajectories,
    orders: list[int],
    chains: tuple[tuple[_Level, ...], ...] = (),
) -> tuple[tuple[tuple[_Level, ...], ...], np.ndarray]:
    """Levels and evidence; without levels they are fitted and each demonstration is left out."""
    require_states(demonstrations, world)
    mask, action = np.asarray(demonstrations.mask), np.asarray(demonstrations.action)
    available = np.asarray(world.available, float)[np.asarray(demonstrations.state)]
    width, base = world.num_actions, max(world.num_states, world.num_actions) + 1
    evidence, fitted = [], []
    for c, symbols in enumerate(_symbols(world, demonstrations, orders)):
        levels: list[_Level] = []
        probability = available / available.sum(-1, keepdims=True)
        code = np.zeros_like(symbols[0])
        for k, symbol in enumerate(symbols):
            code = code * base + symbol
            keys = chains[c][k].keys if chains else np.unique(code[mask])
            row = np.minimum(np.searchsorted(keys, code), len(keys) - 1)
            code = np.where(keys[row] == code, row, len(keys))
            if chains:
                level, own = chains[c][k], np.zeros((1, 1), np.int64)
            else:
                counts = _counts(code[mask], action[mask], len(keys) + 1, width)
                level, own = _Level(keys, counts, _STRENGTHS), _own(code, action, mask, width)
            others, trials = (level.counts[code] - own), []
            for strength in level.strengths:
                total = others.sum(-1, keepdims=True) + strength
                trials.append((others + strength * probability) / total)
            scores = [np.take_along_axis(p, action[..., None], -1)[mask] for p in trials]
            best = int(np.argmax([np.log(p).sum() for p in scores]))
            probability = trials[best]
            levels.append(level._replace(strengths=level.strengths[best : best + 1]))
            evidence.append(np.log(np.maximum(probability, _LEAST)))
        fitted.append(tuple(levels))
    return tuple(fitted), np.stack(evidence, -1)


def _symbols(
    world: MDP, demonstrations: Trajectories, orders: list[int]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The symbols ``int64[N, T]`` of both chains, the newest first; 0 before the first step."""
    state = np.asarray(demonstrations.state, np.int64)
    action = np.asarray(demonstrations.action, np.int64)
    own = np.asarray(world.successor) == np.arange(world.num_states)[:, None, None]
    loops = np.where(own, np.asarray(world.successor_probability), 0).sum(-1) > 1 - 1e-6
    _, kind = np.unique(loops, axis=0, return_inverse=True)

    def past(symbol: np.ndarray, lag: int) -> np.ndarray:
        return np.pad(symbol + 1, ((0, 0), (lag, 0)))[:, : symbol.shape[1]]

    states = [past(state, k) for k in range(orders[0] + 1)]
    return states, [kind.reshape(-1)[state], *(past(action, k + 1) for k in range(orders[1]))]


def _counts(row: np.ndarray, action: np.ndarray, num_rows: int, width: int) -> np.ndarray:
    found = np.bincount(row * width + action, minlength=num_rows * width)
    return found.reshape(num_rows, width).astype(float)


def _own(code: np.ndarray, action: np.ndarray, mask: np.ndarray, width: int) -> np.ndarray:
    """Counts ``float[N, T, A]`` of the step's context in its own demonstration."""
    pairs = np.arange(len(code))[:, None] * (code.max() + 1) + code
    keys, row = np.unique(pairs, return_inverse=True)
    row = row.reshape(code.shape)
    return _counts(row[mask], action[mask], len(keys), width)[row]
