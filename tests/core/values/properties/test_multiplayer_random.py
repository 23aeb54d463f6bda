"""Properties of random multi-player games against brute force over positional strategies."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.types import Status
from tests.reference_multiplayer import RandomGame, least_if_reached, random_smg

COALITIONS = [set(c) for k in range(4) for c in itertools.combinations(range(3), k)]


def references(game: RandomGame):
    """Texts of paths and rewards, with functions from a coalition to the values of all states."""
    a, b = game.label.T
    zero, nowhere = np.zeros(game.size), np.zeros(game.size, bool)

    def of(quantity):
        return lambda members: game.coalition_value(quantity, members)

    def within(target, stay, steps):
        return lambda m: game.backward(target.astype(float), m, steps, kept=target | ~stay)

    def ahead(quantity, earn=False):  # one step before a value
        return lambda m: game.backward(game.coalition_value(quantity, m), m, 1, earn=earn)

    steps = RandomGame(game.rows, [[1.0] * len(x) for x in game.rows], game.owner, game.label)
    until_a = game.total(a, unreached="infinite")
    return {
        'P{} [ X "a" ]': lambda m: game.backward(a.astype(float), m, 1),
        'P{} [ F "a" ]': of(game.reached(a)),
        'P{} [ G !"b" ]': of(1 - game.reached(b)),
        'P{} [ !"b" U "a" ]': of(game.reached(a, ~b)),
        'P{} [ "a" W "b" ]': of(1 - game.reached(~a & ~b, ~b)),
        'P{} [ "a" R !"b" ]': of(1 - game.reached(b, ~a)),
        'P{} [ F<=3 "a" ]': within(a, ~nowhere, 3),
        'P{} [ !"b" U<=4 "a" ]': within(a, ~b, 4),
        'P{} [ X F "a" ]': ahead(game.reached(a)),
        'P{} [ F[1,3] "a" ]': lambda m: game.backward(within(a, ~nowhere, 2)(m), m, 1),
        'P{} [ G F "a" ]': of(game.recurrent(lambda after: (after & a).any(2))),
        'P{} [ F G "a" ]': of(game.recurrent(lambda after: (~after | a).all(2))),
        'P{} [ (F G "a") | (G F "b") ]': of(
            game.recurrent(lambda after: (~after | a).all(2) | (after & b).any(2))
        ),
        'R{{"r"}}{} [ F "a" ]': of(until_a),
        'R{{"r"}}{} [ X F "a" ]': ahead(until_a, earn=True),
        'R{{"r"}}{} [ Fc "a" ]': of(game.total(a, unreached="sum")),
        'R{{"r"}}{} [ C ]': of(game.total(nowhere, unreached="sum")),
        'R{{"r"}}{} [ S ]': of(game.average()),
        'R{{"r"}}{} [ C<=3 ]': lambda m: game.backward(zero, m, 3, earn=True),
        'R{{"w"}}{} [ I=2 ]': lambda m: game.backward(a.astype(float), m, 2),
        'R{{"r"}}{} [ C{{discount=0.9}} ]': of(game.discounted(nowhere, 0.9)),
        'R{{"r"}}{} [ F{{discount=0.9}} "a" ]': of(game.discounted(a, 0.9)),
        'R{{"r"}}{} [ C{{discount=0.9}}<=3 ]': lambda m: game.backward(
            zero, m, 3, earn=True, factor=0.9
        ),
        'T{} [ F "b" ]': of(steps.total(b, unreached="infinite")),
        'LRA{} [ "a" ]': of(game.average(a.astype(float))),
    }


def check_game(seed: int, most: int = 8) -> int:
    """Compares every form for every coalition, alternately maximised and minimised by it."""
    game, count = random_smg(seed, most), 0
    for text, reference in references(game).items():
        for number, members in enumerate(COALITIONS):
            up = (number + seed) % 2 == 0
            players = ", ".join(f"p{i + 1}" for i in sorted(members))
            prop = f"<<{players}>> " + text.format("max=?" if up else "min=?")
            maximisers = members if up else {0, 1, 2} - members
            exact = reference(maximisers)
            answer = jl.solve_property(game.model, prop, states=range(game.size))
            assert answer.status == Status.CONVERGED, (seed, prop)
            slack = 1e-9 * (1 + np.where(np.isfinite(exact), exact, 0))
            assert (answer.lower - slack <= exact).all(), (seed, prop, answer.lower, exact)
            assert (exact <= answer.upper + slack).all(), (seed, prop, answer.upper, exact)
            count += 1
    return count


@pytest.mark.few(1, 1)
@pytest.mark.parametrize("seed", range(2))
def test_every_form_for_every_coalition(seed):
    assert check_game(seed, most=6) == 200


def check_reached(seed: int, most: int, limit: int) -> None:
    """Rewards that count if the target is reached, against value iteration over collected rewards."""
    game = random_smg(seed, most)
    target = game.label[:, 0]
    for number, members in enumerate(COALITIONS):
        up = (number + seed) % 2 == 0
        players = ", ".join(f"p{i + 1}" for i in sorted(members))
        prop = f'<<{players}>> R{{"r"}}{"max" if up else "min"}=? [ F0 "a" ]'
        answer = jl.solve_property(game.model, prop, states=range(game.size))
        maximisers = members if up else {0, 1, 2} - members
        least = least_if_reached(game, target, maximisers, 4 * limit, limit)
        assert answer.status == Status.CONVERGED, (seed, prop)
        finite = np.isfinite(answer.lower)
        assert (least <= answer.upper + 1e-9).all(), (seed, prop, answer.upper, least)
        assert (least[~finite] > limit / 50).all(), (seed, prop, least)
        assert least[finite] == pytest.approx(answer.value[finite], rel=1e-2, abs=1e-2), (
            seed,
            prop,
        )


@pytest.mark.parametrize("seed", (0, 7))
def test_rewards_that_count_if_the_target_is_reached(seed):
    check_reached(seed, most=4, limit=60)


@pytest.mark.exhaustive
@pytest.mark.parametrize("first", range(0, 40, 10))
def test_many_rewards_that_count_if_the_target_is_reached(first):
    for seed in range(first, first + 10):
        check_reached(seed, most=6, limit=150)


@pytest.mark.exhaustive
@pytest.mark.parametrize("first", range(3, 503, 50))
def test_many_games(first):
    for seed in range(first, first + 50):
        check_game(seed)
