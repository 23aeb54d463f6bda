"""What counts guarantee of a strategy in a game holds, and closes in on the truth."""

import jax
import numpy as np
import pytest

from jaxltl.algos import rmax
from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.values.discounted.minimax import minimax_value, strategy_value


def random_game(rng):
    successor = np.stack(
        [np.stack([rng.choice(5, 3, replace=False) for _ in range(2)]) for _ in range(5)]
    )
    probability = rng.dirichlet(np.ones(3), (5, 2))
    return Game(make_mdp(successor, probability), np.asarray(rng.random(5) < 0.5))


def test_bounds_hold_and_close_in():
    rng = np.random.default_rng(0)
    for _ in range(8):
        game = random_game(rng)
        probability = np.asarray(game.mdp.probability)
        earned = rng.random((5, 2, 3))
        problem = rmax.make_problem(game, np.ones(5, bool), earned)
        play = rng.dirichlet(np.ones(2), 5)
        mean = (probability * earned).sum(-1)
        optimal = minimax_value(game, mean, 0.8).value
        worst = strategy_value(game, play, mean, 0.8).value
        gap = np.inf
        for size in (0, 10, 1000, 100_000):
            counts = np.stack([[rng.multinomial(size, p) for p in rows] for rows in probability])
            found = rmax.data_evidence(problem, counts, play, 0.8, confidence=0.99)
            assert (found.secured <= worst + 1e-6).all()
            assert (found.optimal >= optimal - 1e-6).all()
            assert found.num_samples == 10 * size
            gap = min(gap, np.max(worst - found.secured + found.optimal - optimal))
        assert gap < 0.1


@pytest.mark.slow
def test_a_learner_says_what_its_counts_guarantee():
    """Beside the certificate of the true game; of what was not seen at all, too."""
    game = random_game(np.random.default_rng(3))
    reward = np.random.default_rng(4).random((5, 2))
    problem = rmax.make_problem(game, np.ones(5, bool), reward)
    hparams = rmax.Hparams(discount=0.8, reward_bound=1.0, epsilon=0.1, known_after=20)
    state, _ = rmax.train(jax.random.key(0), problem, hparams, num_steps=30)
    found = rmax.evidence(state, problem, hparams, confidence=0.9)
    assert found.data.num_samples == int(state.counts.sum())
    assert (found.data.secured <= np.asarray(found.worst_case.value) + 1e-6).all()
    assert (found.data.optimal >= np.asarray(found.optimal.value) - 1e-6).all()
    assert rmax.evidence(state, problem, hparams).data is None
