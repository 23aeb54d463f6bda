"""Slow and obvious references for games, which share no code with the library.

Memoryless strategies of both players suffice in stochastic parity games, so a region is found
by trying every pair of them: each leaves a finite chain, whose runs are judged by the sets that
they can stay in. Objectives with memory are first written out as parity on an explicit product.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tests import reference
from tests.reference import Model

# Given the reflexive and transitive closures of chains, ``bool[N, S, S]``, and their recurrent
# states, ``bool[N, S]``: from where the objective fails with positive probability, ``bool[N, S]``.
Judge = Callable[[np.ndarray, np.ndarray], np.ndarray]


KINDS = ("mixed", "deterministic", "system", "environment")


@dataclass(frozen=True)
class Play:
    """A reference model and whose turn it is: ``system bool[S]``."""

    model: Model
    system: np.ndarray


def random_game(
    rng: np.random.Generator,
    num_states: int,
    num_actions: int = 2,
    num_successors: int = 2,
    kind: str | None = None,
    local: int | None = None,
) -> Play:
    """A random game: of both players or of one, with much, little or no chance.

    Some states only lead to themselves.

    Args:
      rng: the generator.
      num_states, num_actions, num_successors: sizes.
      kind: ``"mixed"``, ``"deterministic"``, ``"system"`` or ``"environment"`` (one of them
        moves everywhere); default at random.
      local: moves lead at most so many states up or down, so that the game is deep.
    """
    if kind is None:
        kind = str(rng.choice(KINDS, p=[0.5, 0.25, 0.125, 0.125]))
    certainty = 1.0 if kind == "deterministic" else None
    model = reference.random_model(rng, num_states, num_actions, num_successors, certainty)
    if local is not None:
        near = np.arange(num_states)[:, None, None] + rng.integers(
            -local, local + 1, model.successor.shape
        )
        near = np.where(model.probability > 0, near.clip(0, num_states - 1), 0)
        model = replace(model, successor=near)
    system = rng.random(num_states) < 0.5
    if kind in ("system", "environment"):
        system[:] = kind == "system"
    return Play(model, system)


# --- every pair of memoryless strategies ------------------------------------------------------


def policies(game: Play) -> np.ndarray:
    """Every memoryless choice of both players, ``int[N, S]``, grouped by the system's."""
    choices = [np.flatnonzero(row) for row in game.model.available]
    order = [*np.flatnonzero(game.system), *np.flatnonzero(~game.system)]
    table = np.array(list(itertools.product(*(choices[s] for s in order))))
    return table[:, np.argsort(order)]


def closure(step: np.ndarray) -> np.ndarray:
    """Reflexive and transitive closure of each of ``bool[N, S, S]``."""
    connected = (step | np.eye(step.shape[-1], dtype=bool)).astype(np.float32)
    for _ in range(step.shape[-1].bit_length()):
        connected = (connected @ connected > 0).astype(np.float32)
    return connected > 0


def winning(game: Play, judge: Judge, stop: np.ndarray | None = None) -> np.ndarray:
    """From where some strategy of the system succeeds almost surely against all of the others.

    Also asserts that from everywhere else one strategy of the environment succeeds with
    positive probability against all of the system's.

    Args:
      game: a small game.
      judge: from where the objective fails in a chain.
      stop: ``bool[S]``, where the run ends.
    """
    states = np.arange(game.model.num_states)
    chosen = policies(game)
    step = (game.model.transition > 0)[states, chosen]
    if stop is not None:
        step[:, stop] = np.eye(states.size, dtype=bool)[stop]
    reach = closure(step)
    recurrent = (~reach | np.swapaxes(reach, 1, 2)).all(-1)
    fails = judge(reach, recurrent)
    count = np.prod(game.model.available[~game.system].sum(1), dtype=int)
    fails = fails.reshape(-1, count, states.size)
    wins = (~fails).all(1).any(0)
    assert (wins == ~fails.all(0).any(0)).all(), "exactly one player wins from each state"
    return wins


def ever(reach: np.ndarray, states: np.ndarray) -> np.ndarray:
    """From where a state of a set can be reached: of ``bool[S]``, or one in each chain."""
    return (reach & states[..., None, :]).any(-1)


def safety(game: Play, safe: np.ndarray) -> np.ndarray:
    """An unsafe state is never entered."""
    return winning(game, lambda reach, recurrent: ever(reach, ~safe))


def reach(game: Play, goal: np.ndarray, safe: np.ndarray) -> np.ndarray:
    """The goal is reached through safe states: the run ends nowhere else."""
    stop = goal | ~safe
    return winning(game, lambda reach, recurrent: ever(reach, recurrent & ~goal), stop)


def buchi(game: Play, accepting: np.ndarray, safe: np.ndarray) -> np.ndarray:
    """No class of recurrent states misses the set, and no unsafe state is entered."""

    def judge(reach, recurrent):
        return ever(reach, ~safe | (recurrent & ~ever(reach, accepting)))

    return winning(game, judge)


def cobuchi(game: Play, persistent: np.ndarray, safe: np.ndarray) -> np.ndarray:
    """Every recurrent state is in the set, and no unsafe state is entered."""
    return winning(game, lambda reach, recurrent: ever(reach, ~safe | (recurrent & ~persistent)))


def parity(game: Play, priority: np.ndarray, safe: np.ndarray) -> np.ndarray:
    """The least priority of each recurrent class is even, and no unsafe state is entered."""

    def judge(reach, recurrent):
        least = np.where(reach, priority, priority.max() + 1).min(-1)
        return ever(reach, ~safe | (recurrent & (least % 2 == 1)))

    return winning(game, judge)


def claims(
    game: Play,
    priority: np.ndarray,
    won: np.ndarray,
    lost: np.ndarray,
    region: np.ndarray,
    action: np.ndarray,
    counter: np.ndarray,
) -> tuple[bool, bool]:
    """Whether strategies prove a region, by trying all strategies of the other player.

    The system's: it wins from the region and does not leave it before it has won. The
    environment's: the system does not win outside, not even where the region counts as won.
    """
    states = np.arange(game.model.num_states)

    def wins(owner, chosen, undecided, won):
        """From where the system wins, one player's choices fixed; None: one is not available."""
        available = game.model.available.copy()
        fixed = owner & undecided
        if not available[states, chosen][fixed].all():
            return None
        available[fixed] = False
        available[states[fixed], chosen[fixed]] = True
        play = Play(replace(game.model, available=available), game.system)

        def judge(reach, recurrent):
            least = np.where(reach, np.where(won, 0, priority), 99).min(-1)
            return ever(reach, lost | (recurrent & (least % 2 == 1)))

        found = winning(play, judge, won | lost)
        leaves = (play.model.transition > 0) & available[:, :, None] & ~region
        return found, not leaves.any((1, 2))[undecided & region].any()

    system = wins(game.system, action, region & ~won, won)
    environment = wins(~game.system, counter, ~region & ~lost, won | region)
    return (
        system is not None
        and not (region & lost).any()
        and system[1]
        and bool(system[0][region].all()),
        environment is not None and bool(region[won].all()) and not environment[0][~region].any(),
    )


def positive_reach(game: Play, goal: np.ndarray) -> np.ndarray:
    """From where some strategy of the system reaches the goal with positive probability."""
    return winning(game, lambda reach, recurrent: ~ever(reach, goal), goal)


# --- attractors, by naive sweeps --------------------------------------------------------------


def attractor(
    model: Model,
    goal: np.ndarray,
    allowed: np.ndarray,
    exists: np.ndarray,
    chance: str,
    among: np.ndarray,
) -> np.ndarray:
    """The least set around the goal that is closed under the rule of each state."""
    leads = reference.exists_successor if chance == "some" else reference.forall_successor
    found = goal.copy()
    while True:
        hit = leads(model, found)
        joins = np.where(exists, (allowed & hit).any(1), (hit | ~allowed).all(1)) & among
        if not (joins & ~found).any():
            return found
        found = found | joins


def sure_reach(game: Play, goal: np.ndarray) -> np.ndarray:
    """From where the system reaches the goal on every run, whatever chance and environment do.

    Some memoryless strategy leaves no infinite path outside the goal.
    """
    model = game.model
    support = model.transition > 0
    free = (support & model.available[:, :, None]).any(1)
    states = np.arange(model.num_states)
    found = goal.copy()
    for chosen in itertools.product(*(np.flatnonzero(row) for row in model.available)):
        step = np.where(game.system[:, None], support[states, list(chosen)], free)
        step = step & ~goal[:, None] & ~goal
        connected = reference.closure(step)
        loops = (step & connected.T).any(1)
        found |= ~(connected & loops).any(1)
    return found


def sure_parity(game: Play, priority: np.ndarray, safe: np.ndarray) -> np.ndarray:
    """From where the system has least priority even and stays safe on every single run.

    Chance chooses with the environment, so that a cycle with least priority odd is fatal.
    """
    model = game.model
    support = model.transition > 0
    free = (support & model.available[:, :, None]).any(1)
    states = np.arange(model.num_states)
    found = np.zeros(model.num_states, bool)
    for chosen in itertools.product(*(np.flatnonzero(row) for row in model.available)):
        step = np.where(game.system[:, None], support[states, list(chosen)], free)
        fatal = ~safe
        for p in set(priority[priority % 2 == 1].tolist()):
            inner = step & (priority >= p)[:, None] & (priority >= p)
            cycle = (inner.astype(int) @ reference.closure(inner) > 0).diagonal()
            fatal = fatal | (cycle & (priority == p))
        found |= ~(reference.closure(step) & fatal).any(1)
    return found


# --- memory, written out ----------------------------------------------------------------------


def with_memory(game: Play, update: np.ndarray) -> Play:
    """The game beside a memory ``update[S, M]`` read on leaving; states ``s * M + m``."""
    model, memories = game.model, update.shape[1]
    size = model.num_states * memories
    successor = np.zeros((size, *model.successor.shape[1:]), int)
    for s, m in np.ndindex(update.shape):
        successor[s * memories + m] = model.successor[s] * memories + update[s, m]
    larger = Model(
        successor,
        np.repeat(model.probability, memories, axis=0),
        np.repeat(model.available, memories, axis=0),
        np.zeros(size),
    )
    return Play(larger, np.repeat(game.system, memories))


def gr1_as_parity(
    game: Play, assumptions: np.ndarray, guarantees: np.ndarray
) -> tuple[Play, np.ndarray, np.ndarray]:
    """A game of generalised reactivity with counters in the states, and their priorities.

    Each counter waits for one set of its list after the other. Whenever the counter of the
    guarantees completes a round the priority is 0; whenever only that of the assumptions does
    it is 1; else it is 2.

    Returns:
      The game, its priorities, and the state of it in which each state of the game starts.
    """
    num_i, num_j = len(assumptions), len(guarantees)
    update = np.zeros((game.model.num_states, num_i * num_j), int)
    priority = np.zeros_like(update)
    for s, i, j in np.ndindex(game.model.num_states, num_i, num_j):
        next_i = (i + 1) % num_i if assumptions[i, s] else i
        next_j = (j + 1) % num_j if guarantees[j, s] else j
        update[s, i * num_j + j] = next_i * num_j + next_j
        if guarantees[j, s] and j == num_j - 1:
            priority[s, i * num_j + j] = 0
        elif assumptions[i, s] and i == num_i - 1:
            priority[s, i * num_j + j] = 1
        else:
            priority[s, i * num_j + j] = 2
    first = np.arange(game.model.num_states) * num_i * num_j
    return with_memory(game, update), priority.ravel(), first


def gr1(
    game: Play, assumptions: np.ndarray, guarantees: np.ndarray, safe: np.ndarray
) -> np.ndarray:
    """The region of a game of generalised reactivity."""
    larger, priority, first = gr1_as_parity(game, assumptions, guarantees)
    reached = np.repeat(safe, len(priority) // len(safe))
    return parity(larger, priority, reached)[first]
