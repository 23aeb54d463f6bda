"""Worst-case expected moves, against every memoryless environment."""

from dataclasses import replace

import numpy as np
import pytest

from jaxltl.core.models.game import make_game
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.values.undiscounted.total_reward import worst_case_steps
from tests import reference_games
from tests.support import as_mdp, assert_encloses


def expected_moves(chain, goal):
    """Expected moves until the next goal state of a chain ``[S, S]``, by a dense linear system."""
    inner = chain * ~goal
    size = len(chain)
    reach = np.linalg.matrix_power(np.eye(size) + (inner > 0), size) > 0
    hit = (reach @ chain[:, goal].sum(1)) > 0
    finite = ~(reach @ ~hit)
    found = np.full(size, np.inf)
    part = np.eye(finite.sum()) - inner[finite][:, finite]
    found[finite] = np.linalg.solve(part, np.ones(finite.sum()))
    return found


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("any_choice", [False, True])
def test_every_environment_is_enclosed(seed, any_choice):
    rng = np.random.default_rng(seed)
    play = reference_games.random_game(rng, 5, kind="mixed" if seed % 3 else "deterministic")
    model, size = play.model, 5
    goal = rng.random(size) < 0.5
    # Each row is the distribution of an action.
    rows = np.zeros((size, model.available.shape[1], size))
    s, a, k = np.nonzero(model.probability)
    np.add.at(rows, (s, a, model.successor[s, a, k]), model.probability[s, a, k])
    weight = rng.random(model.available.shape) * model.available
    weight /= weight.sum(1, keepdims=True)
    mixed = np.einsum("sa,sat->st", weight, rows)
    worst = np.zeros(size)
    for policy in reference_games.policies(play):
        chain = rows[np.arange(size), policy]
        if not any_choice:
            chain = np.where(play.system[:, None], mixed, chain)
        worst = np.maximum(worst, expected_moves(chain, goal))
    game = make_game(as_mdp(model), play.system)
    if any_choice:
        game = replace(game, system=np.zeros(size, bool))
    found = worst_case_steps(game, goal, weight)
    np.testing.assert_allclose(found.value, worst, rtol=1e-6)
    assert (found.lower <= worst * (1 + 1e-12)).all() and (worst * (1 - 1e-12) <= found.upper).all()


def test_shapes_are_checked():
    play = reference_games.random_game(np.random.default_rng(0), 4)
    game = make_game(as_mdp(play.model), play.system)
    with pytest.raises(ValueError, match="goal"):
        worst_case_steps(game, np.zeros(3, bool), np.ones((4, 2)))
    with pytest.raises(ValueError, match="strategy"):
        worst_case_steps(game, np.zeros(4, bool), np.ones(4))


def test_bounds_enclose_a_known_number():
    """A walk of n fair steps back to the start or on takes 2 (2^n - 1) moves (Feller 1968)."""
    n = 12
    states = np.arange(n)
    successor = np.stack([np.zeros(n, int), states + 1], -1)[:, None]
    successor = np.concatenate([successor, [[[n, n]]]])
    probability = np.concatenate([np.full((n, 1, 2), 0.5), [[[1.0, 0.0]]]])
    game = make_game(make_mdp(successor, probability), np.ones(n + 1, bool))
    found = worst_case_steps(game, np.arange(n + 1) == n, np.ones((n + 1, 1)))
    assert_encloses(found, np.array([2.0 ** (n + 1) - 2.0 ** (k + 1) for k in range(n)] + [1.0]))
