"""Automata learned by inverse RL: local search that maximises the likelihood of demonstrations.

What is visible in each state is known, and so are the letters; the task is not, except its number of
memory states. A candidate is a table ``delta`` and a set of events, transitions that are rewarded; its
likelihood is that of :mod:`jaxltl.algos.grounding.problem`. The search starts from the likeliest
sequences of letters, which end or repeat, and changes one transition at a time, as long as the likelihood
minus a penalty for each transition that moves the memory increases.

Example: after the first symbol the second one.
  >>> import jax
  >>> import jaxltl as jl
  >>> from jaxltl.algos import grounding
  >>> from jaxltl.envs import gridworld
  >>> world = gridworld("a . . . b", slip=0.1)
  >>> model = jl.product(world, "F (a & F b)")
  >>> shown = jl.models.rollout(model, grounding.demonstrator_policy(model, 50.0, 0.9), jax.random.key(0),
  ...                           num_trajectories=20, num_steps=12, stop=model.final)
  >>> shown = jl.models.project_trajectories(model, shown)
  >>> found = grounding.learn_automaton(world, shown, 3, discount=0.9, num_starts=1)
  >>> jl.automata.is_equivalent(found.automaton, "F (a & F b)")
  True
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxltl.algos.grounding.hypotheses import batch_log_likelihood
from jaxltl.algos.grounding.problem import LinearGrounding, Problem, joined_demonstrations
from jaxltl.core.automata.automaton import Automaton, make_automaton
from jaxltl.core.models import MDP, Trajectories, stack_products
from jaxltl.core.models.product import distinct_labels
from jaxltl.core.validation import require_in_range

SCALES = (10.0, 25.0, 50.0, 100.0)
_PENALTY = 2.0  # nats for each moving transition and each event: suppresses chance improvements
_MAX_STEPS = 60
_SEQUENCES = 500  # starts of each kind that are scored, drawn if there are more


class LearnedAutomaton(NamedTuple):
    """An automaton that explains demonstrations.

    Attributes:
      automaton: co-safe if its events end in a state without further moves, else Buchi with the events
        as accepting transitions.
      log_likelihood: of all demonstrations, in nats.
      scale: the reward of an event, on the grid.
      scores: ``float64[starts]``, penalised log-likelihood of the local optimum of each start.
    """

    automaton: Automaton
    log_likelihood: float
    scale: float
    scores: np.ndarray


def learn_automaton(
    worlds: MDP | Sequence[MDP],
    demonstrations: Trajectories | Sequence[Trajectories],
    num_memory: int,
    *,
    discount: float = 0.95,
    num_starts: int = 4,
    seed: int = 0,
) -> LearnedAutomaton:
    """An automaton with a given number of states that makes demonstrations likely.

    Args:
      worlds: labelled worlds; their distinct labels are the letters.
      demonstrations: of a world, or one batch for each.
      num_memory: exact number of states of the automaton, at least 2.
      discount: of the demonstrator, in [0, 1).
      num_starts: starts of the search, the likeliest sequences.
      seed: of the sequences that are scored, if there are more than 500.

    Returns:
      :class:`LearnedAutomaton`. Compare it by :func:`~jaxltl.core.automata.language.is_equivalent`;
      states are numbered by the search.

    Raises:
      ValueError: fewer than 2 memory states, a discount out of range, or demonstrations that do not fit.
    """
    require_in_range("discount", discount)
    if num_memory < 2:
        raise ValueError(f"num_memory={num_memory}; an automaton that is learned has at least 2.")
    worlds = [worlds] if isinstance(worlds, MDP) else list(worlds)
    several = [demonstrations] if isinstance(demonstrations, Trajectories) else demonstrations
    rows = np.unique(np.concatenate([distinct_labels(w) for w in worlds]), axis=0)
    letters = rows.astype(bool)
    delta = np.repeat(np.arange(num_memory)[:, None], len(letters), axis=1)
    blank = make_automaton(
        delta, 0, letters, worlds[0].propositions, accepting=np.zeros(delta.shape, bool)
    )
    model = stack_products(worlds, blank, label_on="entry")
    world, state, action, length = joined_demonstrations(worlds, several)
    problem = Problem(
        model=model,
        observation=jnp.zeros((*model.letter.shape, 1), model.dtype),
        world=world,
        state=state,
        action=action,
        length=length,
        event=jnp.zeros(delta.shape, model.dtype),
        features=jnp.zeros((0,), model.dtype),
        network=LinearGrounding(len(worlds[0].propositions)),
    )
    candidates = _sequences(num_memory, letters, np.random.default_rng(seed))
    tables = np.stack([n[0] for n in candidates]), np.stack([n[1] for n in candidates])
    order = np.argsort(-_scores(problem, discount, *tables).max(1), kind="stable")[:num_starts]
    runs = [_climb(problem, discount, *candidates[i]) for i in order.tolist()]
    score, moves, event, scale = max(runs, key=lambda run: run[0])
    automaton = _as_automaton(moves, event, letters, worlds[0].propositions)
    total = score + _PENALTY * _size(moves, event)
    return LearnedAutomaton(automaton, float(total), scale, np.array([run[0] for run in runs]))


def _sequences(
    num_memory: int, letters: np.ndarray, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Automata of the sequences of letters: all states in order, then the end or the first again."""
    moving = np.flatnonzero(letters.any(1)).tolist()
    candidates = []
    for cyclic in (False, True):
        length = num_memory if cyclic else num_memory - 1
        count = len(moving) ** length
        codes = (
            range(count) if count <= _SEQUENCES else rng.integers(count, size=_SEQUENCES).tolist()
        )
        for code in codes:
            word = [moving[code // len(moving) ** i % len(moving)] for i in range(length)]
            moves = np.repeat(np.arange(num_memory)[:, None], len(letters), axis=1)
            moves[range(length), word] = (np.arange(length) + 1) % num_memory
            event = np.zeros(moves.shape, bool)
            event[range(length) if cyclic else length - 1, word if cyclic else word[-1]] = True
            candidates.append((moves, event))
    return candidates


def _size(moves: np.ndarray, event: np.ndarray) -> int:
    return int((moves != np.arange(len(moves))[:, None]).sum() + event.sum())


def _climb(
    problem: Problem, discount: float, moves: np.ndarray, event: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Steepest ascent over changes of one transition: score, table, events and scale."""
    score, best, scale = -np.inf, (moves, event), SCALES[0]
    for _ in range(_MAX_STEPS):
        neighbours = _neighbours(*best)
        tables = np.stack([n[0] for n in neighbours]), np.stack([n[1] for n in neighbours])
        scores = _scores(problem, discount, *tables)
        value = scores.max(1) - _PENALTY * np.array([_size(*n) for n in neighbours])
        top = int(value.argmax())
        if value[top] <= score + 1e-6:
            break
        score, best, scale = float(value[top]), neighbours[top], SCALES[int(scores[top].argmax())]
    return score, *best, scale


def _neighbours(moves: np.ndarray, event: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The candidate and those with one other transition in which all states are reachable."""
    candidates, (num_memory, width) = [(moves, event)], moves.shape
    for q, letter, to in np.ndindex(num_memory, width, num_memory):
        for rewarded in (False, True):
            if (moves[q, letter] == to and event[q, letter] == rewarded) or (rewarded and to == q):
                continue
            new, events = moves.copy(), event.copy()
            new[q, letter], events[q, letter] = to, rewarded
            if _all_reachable(new):
                candidates.append((new, events))
    return candidates


def _all_reachable(moves: np.ndarray) -> bool:
    """True if the first state reaches all others."""
    steps = np.eye(len(moves), dtype=bool)
    steps[np.arange(len(moves))[:, None], moves] = True
    return bool(np.linalg.matrix_power(steps.astype(float), len(moves))[0].all())


def _scores(problem: Problem, discount: float, moves: np.ndarray, event: np.ndarray) -> np.ndarray:
    """Log-likelihoods ``float64[C, B]`` of candidates at all scales."""
    changes = (moves.astype(np.int32), event.astype(problem.model.dtype))
    return batch_log_likelihood(_with_table, problem, discount, SCALES, changes).sum(-1)


def _with_table(problem: Problem, change: tuple[jax.Array, jax.Array]) -> Problem:
    delta, event = change
    model = problem.model
    wide = cast(NDArray[np.int32], jnp.broadcast_to(delta, (len(model.letter), *delta.shape)))
    model = replace(model, automaton=replace(model.automaton, delta=wide))
    return replace(problem, model=model, event=event)


def _as_automaton(
    moves: np.ndarray, event: np.ndarray, letters: np.ndarray, propositions: tuple[str, ...]
) -> Automaton:
    """The automaton, co-safe if every event enters a state that nothing leaves."""
    delta, count = moves, np.arange(len(moves))
    ends = (delta == count[:, None]).all(1) & ~event.any(1)
    targets = np.unique(delta[event])
    if ends.any() and ends[targets].any():
        final = ends & np.isin(count, targets)
        return make_automaton(delta, 0, letters, propositions, final=final, acceptance="cosafe")
    return make_automaton(delta, 0, letters, propositions, accepting=event)
