"""How many samples a guarantee takes: ``python -m benchmarks.guarantees [PICTURE]``, minutes.

Ten seeds each. (a) A slippery patrol, learned by intervals: until the certified bound of its counts
reaches .9 and .99 of the optimum, with a confidence of .9. (b) The two post offices on slippery
ground, learned by R-max: the same of what its strategy secures, beside the visits of its theorem.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.algos import interval_learning, rmax
from jaxltl.algos.common import pac
from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.values.discounted.minimax import minimax_value
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.envs.gridworld import gridworld
from jaxltl.envs.post_offices import patrol_reward, post_offices, surveillance

SHARES = (0.9, 0.99)
CONFIDENCE = 0.9
SEEDS = 10
GROWTH = 2
TASK = "G F a & G F b & G !x"
_MAP = """
s . x x . a
. . . . . .
. . x x . .
. . # # . .
. . # x . .
. . . . . .
. . # x . b
"""
_SLIP = 0.2
_FIRST, _LIMIT = 2000, 1e8


class Runs:
    """What some seeds have guaranteed so far, at ever more samples."""

    def __init__(self, optimum: float) -> None:
        self.optimum = optimum
        self.samples: list[list[int]] = [[] for _ in range(SEEDS)]
        self.bounds: list[list[float]] = [[] for _ in range(SEEDS)]

    def note(self, seed: int, samples: int, bound: float) -> None:
        self.samples[seed].append(samples)
        self.bounds[seed].append(bound / self.optimum)

    def reached(self, seed: int, share: float) -> bool:
        return bool(self.bounds[seed]) and max(self.bounds[seed]) >= share

    def needed(self, share: float) -> list[float]:
        """Of each seed, between the last look before and the first after, by logarithms."""
        found = []
        for samples, bounds in zip(self.samples, self.bounds, strict=True):
            i = next((i for i, b in enumerate(bounds) if b >= share), None)
            if i is None:
                found.append(np.inf)
            elif i == 0:
                found.append(float(samples[0]))
            else:
                part = (share - bounds[i - 1]) / (bounds[i] - bounds[i - 1])
                found.append(float(np.exp(np.interp(part, [0, 1], np.log(samples[i - 1 : i + 1])))))
        return found


def slippery_patrol() -> Any:
    """Two ways to a room to patrol: a short one past two pairs of pits, a long one past one."""
    return gridworld(
        _MAP,
        slip=_SLIP,
        initial="s",
        legend={".": [], "s": ["s"], "a": ["a"], "b": ["b"], "x": ["x"]},
    )


def slippery_post_offices() -> tuple[Game, np.ndarray]:
    """The game of section 6.7, in which a move of the robot may fail; and what moves are paid."""
    game = post_offices()
    mdp = game.mdp
    shape = (*mdp.available.shape, 2)
    successor, probability = np.zeros(shape, np.int32), np.zeros(shape)
    successor[..., 0] = np.asarray(mdp.successor)[..., 0]
    # The state after staying has the same cell and light, and the environment to move.
    successor[..., 1] = (np.arange(game.num_states) // 2 * 2)[:, None]
    moves = np.asarray(mdp.available)
    slips = moves & np.asarray(game.system)[:, None]
    probability[..., 0] = np.where(slips, 1 - _SLIP, moves)
    probability[..., 1] = np.where(slips, _SLIP, 0)
    world = make_mdp(
        np.where(probability > 0, successor, 0),
        probability,
        available=moves,
        initial=np.asarray(mdp.initial),
        label=np.asarray(mdp.label),
        propositions=mdp.propositions,
    )
    reward = np.zeros(shape)
    reward[..., 0] = np.asarray(patrol_reward(game))
    return Game(world, game.system), reward


def patrol_runs(**settings: Any) -> Runs:
    """The certified bound of the task over samples, by interval learning."""
    problem = interval_learning.make_problem(slippery_patrol(), TASK)
    best = optimal_satisfaction(problem.model)
    runs = Runs(float(jnp.sum(problem.model.initial * best.value)))
    hparams = interval_learning.Hparams(num_runs=10, length=100, **settings)
    keys = jax.random.split(jax.random.key(0), SEEDS)
    states = jax.vmap(interval_learning.init, (0, None, None))(keys, problem, hparams)

    @jax.jit
    def go_on(states: Any, moves: Any) -> Any:
        run = partial(interval_learning.run_until, num_steps=10**6)
        return jax.vmap(
            lambda state: run(state, problem, hparams, until=Partial(_seen, moves)).state
        )(states)

    def bound(state: Any) -> tuple[int, float]:
        found = interval_learning.guarantee(state, problem, CONFIDENCE)
        return int(state.samples), found.bound

    return _followed(runs, states, go_on, bound)


def post_office_runs() -> tuple[Runs, dict[float, float], int]:
    """What R-max's strategy secures by its counts; the theorem's visits of a pair; pairs."""
    game, reward = slippery_post_offices()
    problem = rmax.make_problem(game, surveillance(), reward)
    setting = partial(
        rmax.Hparams,
        discount=0.6,
        reward_bound=1.0,
        known_after=1000,
        restart=1 / 50,
        moves_per_step=1024,
    )
    initial = np.asarray(problem.initial, float)
    best = minimax_value(problem.game, problem.reward, 0.6, allowed=problem.allowed)
    optimum = float(initial @ np.asarray(best.value))
    epsilon = {share: (1 - share) * optimum for share in SHARES}
    visits = {
        share: float(
            pac.visits(e, 1 - CONFIDENCE, 0.6, 1.0, problem.region.sum(), game.num_actions)
        )
        for share, e in epsilon.items()
    }
    chance = (np.asarray(problem.game.mdp.probability) > 0).sum(-1) > 1
    hparams = setting(epsilon=min(epsilon.values()))
    keys = jax.random.split(jax.random.key(0), SEEDS)
    states = jax.vmap(rmax.init, (0, None, None))(keys, problem, hparams)

    @jax.jit
    def go_on(states: Any, moves: Any) -> Any:
        run = partial(rmax.run_until, num_steps=10**8)
        return jax.vmap(
            lambda state: run(state, problem, hparams, until=Partial(_made, moves)).state
        )(states)

    def bound(state: Any) -> tuple[int, float]:
        found = rmax.evidence(state, problem, hparams, confidence=CONFIDENCE).data
        assert found is not None
        return int(state.moves), float(initial @ np.where(initial > 0, found.secured, 0))

    return _followed(Runs(optimum), states, go_on, bound), visits, int(chance.sum())


def _seen(samples: Any, before: Any, after: Any, metrics: Any) -> Any:
    return after.samples >= samples


def _made(moves: Any, before: Any, after: Any, metrics: Any) -> Any:
    return after.moves >= moves


def _followed(
    runs: Runs,
    states: Any,
    go_on: Callable[..., Any],
    bound: Callable[[Any], tuple[int, float]],
) -> Runs:
    """Looks at ever more samples, until every seed has come to the last share."""
    moves, last = _FIRST, SHARES[-1]
    while not all(runs.reached(i, last) for i in range(SEEDS)) and moves < _LIMIT:
        states = go_on(states, moves)
        for i in range(SEEDS):
            if not runs.reached(i, last):
                runs.note(i, *bound(jax.tree.map(itemgetter(i), states)))
        print(f"{moves:.0f}", [round(x[-1], 3) for x in runs.bounds], file=sys.stderr, flush=True)
        moves *= GROWTH
    return runs


def _summary(name: str, runs: Runs, share: float, **more: Any) -> dict[str, Any]:
    needed = runs.needed(share)
    return {
        "name": name,
        "share": share,
        "optimum": runs.optimum,
        "mean": np.mean(needed),
        "deviation": np.std(needed, ddof=1),
        "least": min(needed),
        "most": max(needed),
        **more,
    }


def picture(
    path: str, patrols: dict[str, Runs], offices: Runs, theorem: dict[float, float]
) -> None:
    """Each seed's guarantee over samples, as a share of the optimum."""
    from matplotlib.figure import Figure

    from jaxltl.plot.style import INK, MUTED, PAPER, SERIES, plain_axes

    figure = Figure(figsize=(8.6, 3.1), layout="constrained", facecolor=PAPER)
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, title in (
        (left, "slippery patrol, by intervals"),
        (right, "two post offices, slippery, by R-max"),
    ):
        plain_axes(axes)
        axes.set_xscale("log")
        axes.set_ylim(0, 1.02)
        for share in SHARES:
            axes.axhline(share, color=MUTED, lw=0.8, ls="--")
        axes.set_title(title, fontsize=9.5, color=INK, loc="left")
        axes.set_xlabel("transitions seen", fontsize=8.5, color=MUTED)
    left.set_ylabel("guaranteed share of the optimum", fontsize=8.5, color=MUTED)
    for i, (name, runs) in enumerate(patrols.items()):
        _lines(left, runs, SERIES[i], name)
    _lines(right, offices, SERIES[0], "by the counts")
    for i, (share, visits) in enumerate(theorem.items()):
        right.axvline(
            visits, color=SERIES[i + 1], lw=1.4, ls=":", label=f"the theorem, for {share:g}"
        )
    for axes, place in ((left, "lower right"), (right, "center")):
        axes.legend(frameon=False, fontsize=8, labelcolor=INK, loc=place)
    figure.savefig(path)


def _lines(axes: Any, runs: Runs, color: str, name: str) -> None:
    for i, (samples, bounds) in enumerate(zip(runs.samples, runs.bounds, strict=True)):
        axes.plot(samples, bounds, color=color, lw=0.8, alpha=0.6, label=None if i else name)


def main() -> None:
    """Runs all, prints a line of JSON for each, and draws the picture if a path is given."""
    patrols = {}
    for name, settings in {
        "linear": {},
        "confidence": {"intervals": "confidence"},
        "any move alike": {"exploration": 1.0},
    }.items():
        begin = time.process_time()
        patrols[name] = patrol_runs(**settings)
        spent = time.process_time() - begin
        rows = [_summary(f"patrol, {name}", patrols[name], s, seconds=spent) for s in SHARES]
        print(*map(json.dumps, rows), sep="\n", flush=True)
    begin = time.process_time()
    runs, visits, pairs = post_office_runs()
    spent = time.process_time() - begin
    rows = [
        _summary(
            "post offices, R-max",
            runs,
            share,
            visits=visits[share],
            pairs=pairs,
            theorem=visits[share] * pairs,
            seconds=spent,
        )
        for share in SHARES
    ]
    print(*map(json.dumps, rows), sep="\n", flush=True)
    if len(sys.argv) > 1:
        picture(sys.argv[1], patrols, runs, {s: v * pairs for s, v in visits.items()})


if __name__ == "__main__":
    main()
