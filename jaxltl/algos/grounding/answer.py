"""Uses of inferred symbol meanings: a table, the most informative state to ask about, robust policies.

Example: the demonstrations leave open which of two cells is the goal; one policy visits both.
  >>> import jax.numpy as jnp
  >>> import numpy as np
  >>> import jaxltl as jl
  >>> from jaxltl.algos import grounding
  >>> world = jl.from_dense(np.eye(3)[[[1, 2], [1, 0], [2, 0]]], initial=[1, 0, 0])
  >>> shown = jl.make_trajectories(world, [[(0, 0), (1, 1), (0, 1)]])
  >>> seen = jnp.array([[0.0, 0], [1, 0], [0, 1]])
  >>> problem = grounding.make_problem(world, seen, shown, "F goal")
  >>> found = grounding.posterior(problem, grounding.Hparams(), names=["left", "right"])
  >>> sorted(grounding.ambiguous_symbols(found)["goal"])
  ['left', 'right']
  >>> members = grounding.credible_set(found)
  >>> labels = [found.labels(i)[0] for i in members]
  >>> robust = grounding.robust_policy(world, labels, found.symbols, "F goal")
  >>> robust.lower.round(6).tolist(), round(robust.worst, 6)
  ([1.0, 1.0], 1.0)
  >>> query = grounding.best_query(found)
  >>> query.world, query.state in (1, 2), round(query.information, 3) <= 0.694
  (0, True, True)
  >>> [row.symbol for row in grounding.grounding_table(problem, grounding.Hparams(), found)]
  ['goal']
  >>> labelled = grounding.with_labels(world, labels[0], found.symbols)
  >>> bool(jl.optimal_satisfaction(jl.product(labelled, "F goal")).lower[0, 0] > 0.999)
  True
  >>> float(grounding.probability_under(robust, labels[0], found.symbols, "F goal")) > 0.999
  True
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.grounding.hypotheses import (
    Posterior,
    automaton_of,
    letters_of,
    step_log_likelihood,
)
from jaxltl.algos.grounding.problem import Hparams, Problem
from jaxltl.core.automata.translate import FormulaLike, as_automaton
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.product import product
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.multi_objective import pareto_front as frontier
from jaxltl.core.values import Objective, satisfaction_probability
from jaxltl.core.values.multi_objective.front_search import FrontSearch
from jaxltl.core.values.multi_objective.query import multi_objective_query
from jaxltl.core.values.multi_objective.answers import Front
from jaxltl.core.values.undiscounted.sparse_satisfaction import sparse_mdp_of_product

MAX_MEMBERS = 8  # objectives at once, see Objective
_STEPS = 3  # decisive steps in the table


class Row(NamedTuple):
    """A symbol of the grounding table.

    Attributes:
      symbol, meaning: the symbol, and its most likely meaning.
      weight: its posterior weight, summed over all groundings with that meaning.
      alternatives: other meanings with their weights, likeliest first.
      steps: the demonstrated steps ``(demonstration, step)`` that speak most for the meaning against
        its best alternative, with the gain in log-likelihood.
    """

    symbol: str
    meaning: str
    weight: float
    alternatives: tuple[tuple[str, float], ...]
    steps: tuple[tuple[int, int, float], ...]


class LabelQuery(NamedTuple):
    """A state with the label that gives most information about the grounding.

    Attributes:
      world, state: the state to ask for.
      information: entropy of its label under the posterior, in nats; 0 if the grounding is certain.
      labels: possible labels with their posterior weights, likeliest first.
    """

    world: int
    state: int
    information: float
    labels: tuple[tuple[frozenset[str], float], ...]


@brief
class RobustPolicy(NamedTuple):
    """One policy with certified satisfaction probabilities under several groundings.

    Attributes:
      lower: ``float64[C]``, certified lower bounds from the initial distribution, one a grounding.
      upper: no policy has a larger minimum over the groundings.
      share: initial probabilities of the policies of `front`, which are drawn once.
      front: policies with the memory of all groundings' automata; see
        :class:`~jaxltl.core.values.multi_objective.answers.Front`.
      initial: ``float[S]``, the initial distribution.
    """

    lower: np.ndarray
    upper: float
    share: np.ndarray
    front: Front
    initial: np.ndarray

    @property
    def worst(self) -> float:
        """The least of the lower bounds."""
        return float(self.lower.min())


def with_labels(world: MDP, labels: np.ndarray, symbols: Sequence[str]) -> MDP:
    """The world labelled by a grounding with propositions `symbols`, for :func:`~jaxltl.product` and solvers.

    The `labels` of the `world` are ``bool[S, P]``, such as its part of ``Posterior.labels``; rows beyond
    S, of padded worlds, are left out.
    """
    label = jnp.asarray(np.asarray(labels, bool)[: world.num_states])
    return replace(world, label=label, propositions=tuple(symbols))


def grounding_table(problem: Problem, hparams: Hparams, posterior: Posterior) -> list[Row]:
    """A :class:`Row` of the `posterior` for each symbol: meaning, alternatives, deciding steps.

    Of a `problem` with `hparams`, as for :func:`~jaxltl.algos.grounding.posterior`.
    """
    steps = jax.jit(step_log_likelihood)
    automaton, rows = automaton_of(problem), []

    def by_step(index: int) -> np.ndarray:
        letter = jnp.asarray(letters_of(automaton, posterior.labels(index)))
        return np.asarray(
            steps(problem, hparams.discount, letter, jnp.asarray(posterior.scale[index]))
        )

    best = by_step(0)
    for p, symbol in enumerate(posterior.symbols):
        column = posterior.assignment[:, p]
        weight = np.bincount(column, posterior.weight, minlength=len(posterior.names))
        order = [int(m) for m in np.argsort(-weight, kind="stable") if weight[m] > 0]
        chosen = int(column[0])
        decisive: list[tuple[int, int, float]] = []
        if (other := np.flatnonzero(column != chosen)).size:
            gain = best - by_step(int(other[0]))
            for i in np.argsort(-gain, axis=None, kind="stable")[:_STEPS].tolist():
                n, t = divmod(i, gain.shape[1])
                if gain[n, t] > 0:
                    decisive.append((n, t, float(gain[n, t])))
        more = tuple((posterior.names[m], float(weight[m])) for m in order if m != chosen)
        row = Row(symbol, posterior.names[chosen], float(weight[chosen]), more, tuple(decisive))
        rows.append(row)
    return rows


def best_query(posterior: Posterior) -> LabelQuery:
    """The (first) state with the label that gives most information about the grounding, a :class:`LabelQuery`.

    A grounding determines all labels, so that the mutual information of a state's label and the
    grounding is the entropy of the label under the `posterior`.
    """
    num_states = posterior.meaning.shape[2]
    power = 1 << np.arange(len(posterior.symbols))
    heavy = np.flatnonzero(posterior.weight > 1e-9)
    codes = np.stack([posterior.labels(i) @ power for i in heavy.tolist()]).reshape(len(heavy), -1)
    patterns, inverse = np.unique(codes.T, axis=0, return_inverse=True)
    entropy = []
    for pattern in patterns:
        mass = np.bincount(pattern, posterior.weight[heavy])
        mass = mass[mass > 0] / mass.sum()
        entropy.append(-float(mass @ np.log(mass)))
    state = int(np.argmax(np.array(entropy)[inverse.ravel()]))
    mass = np.bincount(codes[:, state], posterior.weight[heavy])
    mass = mass / mass.sum()
    labels = tuple(
        (frozenset(s for p, s in enumerate(posterior.symbols) if code >> p & 1), float(mass[code]))
        for code in np.argsort(-mass, kind="stable").tolist()
        if mass[code] > 0
    )
    information = max(entropy[inverse.ravel()[state]], 0.0)
    return LabelQuery(state // num_states, state % num_states, information, labels)


def robust_policy(
    world: MDP,
    labels: Sequence[np.ndarray],
    symbols: Sequence[str],
    formula: FormulaLike,
    *,
    tolerance: float = 1e-4,
    max_points: int = 100,
) -> RobustPolicy:
    """A :class:`RobustPolicy` with the largest minimum of its probabilities under several groundings.

    In the product with the automata of all groundings, weighted sums of the probabilities are
    maximised (Forejt, Kwiatkowska and Parker 2012) until a mixture of their policies attains the
    maximin up to `tolerance`. The policy never sees a label: it holds whichever grounding is true.

    Args:
      world: with an initial distribution.
      labels: ``bool[S, P]`` of each of at most 8 groundings.
      symbols: P names.
      formula: a formula over them, or its automaton.
      tolerance: width of the bounds of the maximin.
      max_points: maximal number of weighted sums; bounds hold at any number.

    Raises:
      ValueError: no grounding, or more than 8.
    """
    if not 1 <= len(labels) <= MAX_MEMBERS:
        raise ValueError(
            f"there are {len(labels)} groundings; a robust policy takes 1 to {MAX_MEMBERS}. "
            "Lower the level of the credible set, or answer the query."
        )
    automaton, objectives = as_automaton(formula), []
    names: list[str] = []
    columns: list[np.ndarray] = []
    for i, label in enumerate(labels):
        own = tuple(f"{s}@{i}" for s in symbols)
        new = dict(zip(symbols, own, strict=True))
        renamed = tuple(new[p] for p in automaton.propositions)
        objectives.append(Objective(formula=replace(automaton, propositions=renamed)))
        names += own
        columns.append(np.asarray(label, bool)[: world.num_states])
    joint = with_labels(world, np.concatenate(columns, axis=1), names)
    search = FrontSearch(multi_objective_query(joint, objectives), tolerance / 8)
    wanted = np.ones(len(labels))
    while True:
        lower = search.lower
        apart = frontier.separation(lower, wanted, search.scale)
        normals, bounds = search.half_spaces
        upper = min(float((bounds / normals.sum(1)).min()), 1.0)
        attained = frontier.mixture(lower, apart.share)
        narrow = upper - attained.min() <= tolerance
        if narrow or len(lower) >= max_points or not search.ask_anew(apart.normal):
            initial = np.asarray(world.initial, float)
            return RobustPolicy(attained, upper, apart.share, search.front(), initial)


def probability_under(
    robust: RobustPolicy, labels: np.ndarray, symbols: Sequence[str], formula: FormulaLike
) -> float:
    """A certified lower bound of the satisfaction probability of a policy `robust` under any grounding.

    Of a `formula`, a formula over P `symbols` or its automaton, with `labels` ``bool[S, P]``, not necessarily
    those of one of the policy's groundings, from the initial distribution. Independent of the search: each
    policy is evaluated in the product of its chain with the task. Loose if expected times are beyond 1e12
    steps.
    """
    sparse = sparse_mdp_of_product(robust.front.product)
    label = np.asarray(labels, bool)[np.asarray(robust.front.product.base_state)]
    initial = np.zeros(sparse.num_states)
    initial[robust.front.product.start] = robust.initial[robust.initial > 0]
    sparse = replace(sparse, initial=initial, label=jnp.asarray(label), propositions=tuple(symbols))
    model = product(sparse, as_automaton(formula))
    total = 0.0
    for share, weight in zip(robust.share, robust.front.policies, strict=True):
        if share > 0:
            policy = np.repeat(np.asarray(weight)[:, None], model.num_memory, axis=1)
            solution = satisfaction_probability(model, jnp.asarray(policy))
            total += share * float(np.sum(np.asarray(model.initial) * np.asarray(solution.lower)))
    return total
