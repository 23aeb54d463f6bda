"""Posterior weights of hard groundings: each symbol means one of a list of candidate meanings.

With certain symbols the memory along a demonstration is known, so that a hypothesis h has exactly the
likelihood of :mod:`jaxltl.algos.mlirl` in the product with its labels. The posterior weight sums over a
grid of scales, ``w(h) ~ sum_b prod_n p(demonstration n | h, scale b)``, with a uniform prior.

Example: two states look different; the demonstration moves to the second one and stays.
  >>> import jax.numpy as jnp
  >>> import jaxltl as jl
  >>> from jaxltl.algos import grounding
  >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[0, 1.0], [1.0, 0]]])
  >>> shown = jl.make_trajectories(world, [[(0, 0), (1, 0)], [(0, 0)]])
  >>> problem = grounding.make_problem(world, jnp.eye(2), shown, "G !trap")
  >>> found = grounding.posterior(problem, grounding.Hparams())
  >>> grounding.credible_set(found, 0.5), grounding.ambiguous_symbols(found, 0.5)
  (array([0]), {})
  >>> grounding.select_demonstrations(found, [0]).log_likelihood.shape
  (2, 8, 1)
  >>> found.meaning_of(0)
  {'trap': 'observation 0'}
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxltl.algos.common.settings import Number, require_hparams
from jaxltl.algos.grounding.problem import Hparams, Problem, certain_memory, demonstrator_log_policy
from jaxltl.core import struct
from jaxltl.core.array_types import PyTree
from jaxltl.core.automata import Automaton, is_equivalent
from jaxltl.core.models.product import Product

Score = Callable[[np.ndarray], np.ndarray]
SCALES = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
_LIMIT = 20_000  # hypotheses that are enumerated; beyond, a beam search
_BATCH = 64  # hypotheses in one program: bounds its memory
_BEAM = 8
_UNEXPLAINED = np.log(1e4)  # decisive evidence (Jeffreys) for random actions


@struct.dataclass
class Posterior:
    """Hard groundings with weights, in decreasing order.

    Attributes:
      assignment: ``int32[C, P]``, the meaning of each symbol.
      weight: ``float64[C]``, posterior weights; they sum to 1.
      scale: ``float64[C]``, the most likely scale on the grid.
      log_likelihood: ``float64[C, B, N]``, of each demonstration at each scale of the grid.
      scales: ``float64[B]``, the grid.
      meaning: ``bool[M, W, S]``, the states in which each candidate meaning holds.
      symbols, names: of the P symbols and the M meanings; static.
      complete: False if only a beam of the hypotheses was scored; static.
    """

    assignment: np.ndarray
    weight: np.ndarray
    scale: np.ndarray
    log_likelihood: np.ndarray
    scales: np.ndarray
    meaning: np.ndarray
    symbols: tuple[str, ...] = struct.field(pytree_node=False)
    names: tuple[str, ...] = struct.field(pytree_node=False)
    complete: bool = struct.field(pytree_node=False, default=True)

    def meaning_of(self, index: int) -> dict[str, str]:
        """The grounding of a row: the name of the meaning of each symbol."""
        return {p: self.names[m] for p, m in zip(self.symbols, self.assignment[index], strict=True)}

    def labels(self, index: int) -> np.ndarray:
        """``bool[W, S, P]``, the labels of all worlds by a row."""
        return np.moveaxis(self.meaning[self.assignment[index]], 0, -1)


def posterior(
    problem: Problem,
    hparams: Hparams,
    *,
    meanings: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    scales: Sequence[float] = SCALES,
) -> Posterior:
    """Posterior weights of the hard groundings of a problem.

    Args:
      problem: with a task and demonstrations.
      hparams: the discount of the demonstrator.
      meanings: ``bool[M, W, S]``, candidate meanings of a symbol; default: each entry of the
        observation that is 0 or 1 everywhere.
      names: of the meanings; default ``"observation 0"`` and so on.
      scales: grid of scales with a uniform prior.

    Returns:
      :class:`Posterior`. Groundings that differ by a symmetry of the formula are counted once. All
      ``M ** P`` are scored up to 20,000, else a beam search visits those with the largest weights.

    Raises:
      ValueError: a hyperparameter out of range; no candidate meaning, or meanings of another shape; or
        a demonstration that no grounding explains: at the scales that the others make likely,
        uniformly random actions are 10,000 times as likely under each.
    """
    require_hparams(hparams)
    meaning, titles = _meanings(problem, meanings, names)
    symmetries = symbol_symmetries(automaton_of(problem))
    score = partial(_scores, problem, hparams.discount, meaning, np.asarray(scales, float))
    count = len(meaning) ** len(problem.symbols)
    if count <= _LIMIT:
        every = itertools.product(range(len(meaning)), repeat=len(problem.symbols))
        rows = sorted({_canonical(row, symmetries) for row in every})
        table = score(np.asarray(rows, np.int32))
    else:
        rows, table = _beam(score, len(meaning), len(problem.symbols), symmetries)
    result = _weighed(
        Posterior(
            assignment=np.asarray(rows, np.int32),
            weight=np.zeros(len(rows)),
            scale=np.zeros(len(rows)),
            log_likelihood=table,
            scales=np.asarray(scales, float),
            meaning=meaning,
            symbols=problem.symbols,
            names=titles,
            complete=count <= _LIMIT,
        )
    )
    _require_explained(problem, hparams, result, table)
    return result


def _weighed(posterior: Posterior) -> Posterior:
    """The groundings with the weights of their likelihoods, in decreasing order."""
    total = posterior.log_likelihood.sum(-1)  # [C, B]
    logs = np.logaddexp.reduce(total, axis=1)
    order = np.argsort(-logs, kind="stable")
    return replace(
        posterior,
        assignment=posterior.assignment[order],
        weight=np.exp(logs - np.logaddexp.reduce(logs))[order],
        scale=posterior.scales[total.argmax(1)[order]],
        log_likelihood=posterior.log_likelihood[order],
    )


def select_demonstrations(posterior: Posterior, chosen: ArrayLike) -> Posterior:
    """The :class:`Posterior` of those of N demonstrations of `posterior` that count, without new scores.

    They are `chosen` by ``int[]`` or ``bool[N]``; groundings are in the order of their new weights.
    """
    return _weighed(
        replace(posterior, log_likelihood=posterior.log_likelihood[..., np.asarray(chosen)])
    )


def credible_set(posterior: Posterior, level: float = 0.95) -> np.ndarray:
    """The rows ``int[]`` of `posterior` in the smallest set of groundings with a weight of at least `level`.

    Raises:
      ValueError: a level that is not above 0 and below 1.

    >>> import types
    >>> credible_set(types.SimpleNamespace(weight=np.array([0.7, 0.2, 0.1])), 0.8).tolist()
    [0, 1]
    """
    if not 0 < level < 1:
        raise ValueError(f"level={level}; it must be above 0 and below 1.")
    count = int(np.searchsorted(np.cumsum(posterior.weight), level)) + 1
    return np.arange(min(count, len(posterior.weight)))


def ambiguous_symbols(posterior: Posterior, level: float = 0.95) -> dict[str, tuple[str, ...]]:
    """The symbols with several meanings, likeliest first, in the credible set of `posterior` of a `level`."""
    rows = posterior.assignment[credible_set(posterior, level)]
    several = {}
    for p, symbol in enumerate(posterior.symbols):
        chosen = tuple(dict.fromkeys(posterior.names[m] for m in rows[:, p]))
        if len(chosen) > 1:
            several[symbol] = chosen
    return several


def symbol_symmetries(automaton: Automaton) -> list[tuple[int, ...]]:
    """The permutations of symbols that leave the language of an `automaton` unchanged; of > 5 the identity.

    >>> import jaxltl as jl
    >>> symbol_symmetries(jl.to_automaton("F a & F b"))
    [(0, 1), (1, 0)]
    """
    count = len(automaton.propositions)
    if count > 5:  # 720 comparisons and more
        return [tuple(range(count))]
    symmetries = []
    for order in itertools.permutations(range(count)):
        renamed = replace(automaton, propositions=tuple(automaton.propositions[i] for i in order))
        if order == tuple(range(count)) or is_equivalent(automaton, renamed):
            symmetries.append(order)
    return symmetries


def _canonical(row: Sequence[int], symmetries: list[tuple[int, ...]]) -> tuple[int, ...]:
    return min(tuple(row[i] for i in order) for order in symmetries)


def automaton_of(problem: Problem) -> Automaton:
    """The automaton of a problem, on the host."""
    return jax.tree.map(lambda x: np.asarray(x)[0], problem.model.automaton)


def _meanings(
    problem: Problem, meanings: ArrayLike | None, names: Sequence[str] | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    observation = np.asarray(problem.observation)
    if meanings is None:
        binary = ((observation == 0) | (observation == 1)).all((0, 1))
        entries = np.flatnonzero(binary & (observation != 0).any((0, 1)))
        if not entries.size:
            raise ValueError(
                "no entry of the observations is 0 or 1 in every state; give meanings=bool[M, W, S], "
                "such as those of cluster_meanings."
            )
        table = np.moveaxis(observation[..., entries] > 0, -1, 0)
        width = observation.shape[-1]
        if names is not None and len(names) != width:
            raise ValueError(f"there are {len(names)} names for {width} entries of observations.")
        titles = names if names is not None else [f"observation {i}" for i in range(width)]
        return table, tuple(titles[i] for i in entries.tolist())
    table = np.asarray(meanings)
    if table.dtype != bool or table.ndim != 3 or table.shape[1:] != observation.shape[:2]:
        raise ValueError(
            f"meanings is {table.dtype}{list(table.shape)}; expected "
            f"bool['M', {observation.shape[0]}, {observation.shape[1]}]."
        )
    titles = [f"meaning {i}" for i in range(len(table))] if names is None else names
    if len(titles) != len(table):
        raise ValueError(f"there are {len(titles)} names for {len(table)} meanings.")
    return table, tuple(titles)


def letters_of(automaton: Automaton, labels: np.ndarray) -> np.ndarray:
    """Letters ``int32[...]`` of labels ``bool[..., P]``; -1 where the automaton has none."""
    letters = np.asarray(automaton.letters)
    power = 1 << np.arange(letters.shape[1])
    table = np.full(1 << letters.shape[1], -1, np.int32)
    table[letters @ power] = np.arange(len(letters))
    return table[labels @ power]


def _scores(
    problem: Problem, discount: Number, meaning: np.ndarray, scales: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Log-likelihoods ``float64[C, B, N]`` of assignments ``int32[C, P]``."""
    letters = letters_of(automaton_of(problem), np.moveaxis(meaning[rows], 1, -1))  # [C, W, S]
    possible = (letters >= 0).all((1, 2))
    table = np.full((len(rows), len(scales), len(problem.length)), -np.inf)
    table[possible] = batch_log_likelihood(
        _with_letters, problem, discount, scales, letters[possible]
    )
    return table


def _with_letters(problem: Problem, letter: jax.Array) -> Problem:
    return replace(problem, model=replace(problem.model, letter=letter))


def batch_log_likelihood(
    candidate: Callable[[Problem, PyTree], Problem],
    problem: Problem,
    discount: Number,
    scales: ArrayLike,
    changes: PyTree,
) -> np.ndarray:
    """Log-likelihoods ``float64[C, B, N]`` of candidates, each made of a problem and a row of `changes`."""
    count = len(jax.tree.leaves(changes)[0])
    size = min(_BATCH, 1 << max(count - 1, 0).bit_length())
    grid, tables = jnp.asarray(scales, problem.model.dtype), []
    for first in range(0, count, size):
        part = np.arange(first, min(first + size, count))
        filled = np.resize(part, size)  # one program for all batches
        rows = jax.tree.map(lambda x, filled=filled: jnp.asarray(x[filled]), changes)
        table = _batch(candidate, problem, discount, grid, rows)
        tables.append(np.asarray(table, float)[: len(part)])
    return np.concatenate(tables) if tables else np.zeros((0, len(grid), len(problem.length)))


@partial(jax.jit, static_argnames="candidate")
def _batch(
    candidate: Callable[[Problem, PyTree], Problem],
    problem: Problem,
    discount: Number,
    scales: jax.Array,
    changes: PyTree,
) -> jax.Array:
    def one(change: PyTree) -> jax.Array:
        changed = candidate(problem, change)
        likelihood = partial(
            step_log_likelihood, changed, discount, jnp.asarray(changed.model.letter)
        )
        return jnp.sum(jax.vmap(likelihood)(scales), axis=2)

    return jax.vmap(one)(changes)


def step_log_likelihood(
    problem: Problem, discount: Number, letter: jax.Array, scale: jax.Array
) -> jax.Array:
    """``log pi(a_t | s_t, q_t)``, ``float[N, T]``, with known letters ``int32[W, S]``; 0 in padding."""
    models = replace(problem.model, letter=letter)

    def lane(model: Product) -> jax.Array:
        return demonstrator_log_policy(model, problem.event, scale, discount)

    log_policy = jax.vmap(lane)(models)

    def demonstration(world: jax.Array, state: jax.Array, action: jax.Array) -> jax.Array:
        model = jax.tree.map(lambda x: x[world], models)
        return log_policy[world, state, certain_memory(model, state), action]

    log_likelihoods = jax.vmap(demonstration)(problem.world, problem.state, problem.action)
    return jnp.where(
        jnp.arange(log_likelihoods.shape[1]) < problem.length[:, None], log_likelihoods, 0
    )


def _beam(
    score: Score, num_meanings: int, num_symbols: int, symmetries: list[tuple[int, ...]]
) -> tuple[list[tuple[int, ...]], np.ndarray]:
    """Assignments that differ in one symbol from the best ones so far, until these have no better."""
    starts = np.random.default_rng(0).integers(num_meanings, size=(_BEAM, num_symbols)).tolist()
    frontier = {_canonical(row, symmetries) for row in starts}
    known: dict[tuple[int, ...], np.ndarray] = {}
    expanded: set[tuple[int, ...]] = set()
    while True:
        new = sorted(frontier - known.keys())
        if new:
            known |= dict(zip(new, score(np.asarray(new, np.int32)), strict=True))
        best = sorted(known, key=lambda r: -np.logaddexp.reduce(known[r].sum(-1)))[:_BEAM]
        fresh = [row for row in best if row not in expanded]
        if not fresh:
            return list(known), np.stack(list(known.values()))
        expanded |= set(fresh)
        frontier = {
            _canonical((*row[:p], m, *row[p + 1 :]), symmetries)
            for row in fresh
            for p in range(num_symbols)
            for m in range(num_meanings)
        }


def _require_explained(
    problem: Problem, hparams: Hparams, posterior: Posterior, table: np.ndarray
) -> None:
    """Raises ValueError for a demonstration less likely under each grounding than random actions."""
    available = np.asarray(problem.model.mdp.available)
    world, state = np.asarray(problem.world)[:, None], np.asarray(problem.state)
    inside = np.arange(state.shape[1]) < np.asarray(problem.length)[:, None]
    uniform = np.where(inside, -np.log(available[world, state].sum(-1)), 0)
    table = table[np.isfinite(table).all((1, 2))]
    # The other demonstrations weigh the scales; at a small scale the policy is nearly uniform.
    other = (table.sum(-1, keepdims=True) - table).max(0)
    best = np.logaddexp.reduce(other - np.logaddexp.reduce(other, 0) + table.max(0), 0)
    lost = uniform.sum(1) - best
    n = int(lost.argmax())
    if lost[n] > _UNEXPLAINED:
        letter = letters_of(automaton_of(problem), posterior.labels(0))
        steps = jax.jit(step_log_likelihood)(
            problem, hparams.discount, jnp.asarray(letter), jnp.asarray(posterior.scale[0])
        )
        t = int((np.asarray(steps) - uniform)[n].argmin())
        raise ValueError(
            f"demonstration {n} is explained by no grounding: random actions are exp({lost[n]:.0f}) "
            f"times as likely under each; step {t} (state {state[n, t]}, action "
            f"{int(problem.action[n, t])}) is the least likely. Leave it out, or change the task."
        )
