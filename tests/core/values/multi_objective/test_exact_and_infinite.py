"""Thresholds below, on and above the Pareto curve, with rewards that are infinite or exactly zero."""

from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.multi_objective.multi_objective import (
    Objective,
    achievable,
    constrained_optimum,
)
from tests.reference_multi_objective import Question, Unfolded, answer
from tests.support import seeds

SPLITS = [  # doubles mean themselves, divided by their sum
    tuple(Fraction(x) / (Fraction(x) + Fraction(y)) for x, y in pair)
    for pair in [[(0.5, 0.5)] * 2, [(1 / 3, 2 / 3), (2 / 3, 1 / 3)], [(0.3, 0.7), (0.7, 0.3)]]
]
REWARDS = [Fraction(0)] * 4 + [Fraction(1), Fraction(0.1), Fraction(2 / 3)]


def random_case(rng):
    """A model, its rows, and one to three objectives."""
    size = int(rng.integers(3, 5))
    rows = []
    for s in range(size):
        for _ in range(int(rng.integers(1, 3))):
            if rng.random() < 0.6:
                rows.append((s, {int(rng.integers(size)): Fraction(1)}))
            else:
                t = sorted(rng.choice(size, 2, replace=False).tolist())
                rows.append((s, dict(zip(t, SPLITS[rng.integers(3)], strict=True))))
    questions = []
    for _ in range(int(rng.integers(1, 4))):
        target = (int(rng.integers(1, size)),) if rng.random() < 0.6 else None
        reward = None
        if target is None or rng.random() < 0.4:
            reward = tuple(REWARDS[i] for i in rng.integers(len(REWARDS), size=len(rows)))
        questions.append(Question(bool(rng.random() < 0.5), target, reward))
    start = np.cumsum([0, *(len(ahead) for _, ahead in rows)])
    model = make_sparse(
        np.searchsorted([s for s, _ in rows], range(size + 1)),
        start,
        [t for _, ahead in rows for t in ahead],
        [float(p) for _, ahead in rows for p in ahead.values()],
        initial=np.eye(size)[0],
    )
    return model, size, rows, questions


def objective(size, question, threshold):
    target = None if question.target is None else np.isin(np.arange(size), question.target)
    reward = question.reward and Rewards(choice=np.array([float(x) for x in question.reward]))
    direction = "max" if question.maximize else "min"
    return Objective(target=target, reward=reward, direction=direction, threshold=threshold)


def thresholds(rng, unfolded, index):
    """The values of a mixture, some of them moved by a little or much."""
    outcomes = [v for v, _ in unfolded.outcomes([]) or []]
    finite = [v for v in outcomes if None not in v] or [(Fraction(1),) * len(unfolded.questions)]
    parts = [finite[i] for i in rng.integers(len(finite), size=2)]
    share = Fraction(int(rng.integers(5)), 4)
    moves = [Fraction(0)] * 4 + [Fraction(x) for x in ("1e-7", "-1e-7", "1/3", "-1/3")]
    mixed = [
        share * x + (1 - share) * y + moves[rng.integers(8)] for x, y in zip(*parts, strict=True)
    ]
    return [None if i == index else x for i, x in enumerate(mixed)]


@pytest.mark.parametrize("seed", seeds(30, 80, 400))
def test_answers_are_those_of_mixtures_of_policies(seed):
    rng = np.random.default_rng(seed)
    model, size, rows, questions = random_case(rng)
    unfolded = Unfolded(size, rows, questions)
    for index in (None, int(rng.integers(len(questions)))):
        limits = thresholds(rng, unfolded, index)
        expected = answer(unfolded, limits, index)
        if expected is None:
            continue
        margin, best = expected
        query = [objective(size, q, limit) for q, limit in zip(questions, limits, strict=True)]
        found = (achievable if index is None else constrained_optimum)(model, query)
        assert found.status == Status.CONVERGED, (margin, found)
        if abs(margin) > 1e-9:
            assert found.holds is bool(margin > 0), margin
        if index is not None and found.holds:
            assert 0 <= found.lower <= found.value <= found.upper
            assert found.lower - 1e-9 <= best <= found.upper + 1e-9, (found, best)
            if best == 0:
                assert found.lower == found.value == found.upper == 0
            if questions[index].reward is None:
                assert found.upper <= 1
