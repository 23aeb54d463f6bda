"""Section 6.7: PAC learning of a patrol with R-max, while winning almost surely."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.algos import rmax
from jaxltl.algos.common import loops, pac
from jaxltl.app.wording import Record
from jaxltl.core.games.winning import almost_sure_buchi
from jaxltl.core.models import expectation, restrict
from jaxltl.core.types import check
from jaxltl.core.values.discounted.minimax import minimax_value, strategy_value
from jaxltl.envs.gridworld import ACTIONS
from jaxltl.envs.post_offices import Patrol, patrol, surveillance
from jaxltl.reproduce.experiment import experiment, render_table, run_seconds

DISCOUNT, EPSILON, REWARD_BOUND, FAILURE = 0.6, 1e-4, 1.0, 0.1
RESTART = 1 / 50  # probability of a restart before a move
REST = 20_000  # moves without an update after which learning ends
SEEDS = 10

PUBLISHED = {
    "states": 144,
    "system_states": 72,
    "system_transitions": 192,
    "seconds": 58.05,
    "last_update_seconds": 29.77,
}

_MAP = ". . p1\n. . .\np2 . ."
_DANGER = {"on": (0, 1, 3, 4), "off": (4, 5, 7, 8)}
_HPARAMS = rmax.Hparams(
    discount=DISCOUNT, reward_bound=REWARD_BOUND, epsilon=EPSILON, failure=FAILURE
)


@experiment
def measure(progress: Callable[[str], None], *, seeds: int = SEEDS) -> Record:
    """Section 6.7: the game, its optimal and initial values, and learned strategies."""
    progress("the game and its optimal values")
    model = patrol()
    problem = rmax.make_problem(model.game, model.accepting, model.reward)
    known, strategies, quantity = _known_model(model)
    progress(f"learning with {seeds} seeds in one call, with and without restarts")
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    restarting = replace(_HPARAMS, restart=RESTART)
    runs, together = run_seconds(lambda: _learn_all(keys, problem, restarting))
    learned, evidence = _evaluated(runs, problem, restarting)
    without, _ = _evaluated(_learn_all(keys, problem, _HPARAMS), problem, _HPARAMS)
    progress("learning with one seed at a time, to measure seconds")
    alone, until_last = _single_run_seconds(keys, problem, restarting, runs)
    system = np.asarray(model.game.system)
    values = {name: _worst(model, strategy) for name, strategy in strategies.items()}
    values |= {"optimal": known.pop("optimal"), "learned": evidence.worst_case.value}
    return {
        **_sizes(model, problem),
        **known,
        **{f"{name}_strategy": _summary(model, values[name]) for name in strategies},
        "learned": learned,
        "learned_without_restarts": without,
        "seconds": alone,
        "last_update_seconds": until_last,
        "seconds_together": together,
        "figure17": _figure_17(model, quantity),
        "figure18": {
            "reachable": np.asarray(evidence.reachable)[system],
            **{name: np.asarray(value)[system] for name, value in values.items()},
        },
        "figure19": _figure_19(model, strategies["winning"], evidence),
    }


# --- the true model -------------------------------------------------------------------------


def _sizes(model: Patrol, problem: rmax.Problem) -> Record:
    game = model.game
    moves = np.asarray(game.available.sum(axis=1))
    reachable = restrict(game).model
    return {
        "states": game.num_states,
        "system_states": int(game.system.sum()),
        "system_transitions": int(moves[game.system].sum()),
        "transitions": int(moves.sum()),
        "reachable_system_states": int(reachable.system.sum()),
        "almost_sure_states": int(problem.region.sum()),
    }


def _known_model(model: Patrol) -> tuple[Record, dict[str, jax.Array], jax.Array]:
    """Optimal values and the loss of algorithm 4, two strategies, and the values of actions."""
    game = model.game
    optimal = check(minimax_value(game, model.reward, DISCOUNT)).value
    quantity = model.reward + DISCOUNT * expectation(game, optimal)
    near_optimal = pac.near_optimal(
        quantity, game.available, pac.action_tolerance(EPSILON, DISCOUNT)
    )
    p = pac.exploration(EPSILON, DISCOUNT, REWARD_BOUND)
    hat = pac.hat_game(game, near_optimal, p)
    action = almost_sure_buchi(hat, jnp.pad(model.accepting, (0, 2 * game.num_states))).action
    of_hat = pac.recover_hat_strategy(hat, jax.nn.one_hot(action, hat.num_actions))
    uniform_hat = pac.hat_strategy(near_optimal, game.available, p)
    values, counts = np.unique(
        np.round(np.asarray(optimal)[np.asarray(game.system)], 6), return_counts=True
    )
    known = {
        "values": {f"{v:.6f}": int(n) for v, n in zip(values, counts, strict=True)},
        "hat_strategy_gap": jnp.max(optimal - _worst(model, of_hat)),
        "uniform_hat_strategy_gap": jnp.max(optimal - _worst(model, uniform_hat)),
        "optimal": optimal,
    }
    winning = jax.nn.one_hot(almost_sure_buchi(game, model.accepting).action, game.num_actions)
    uniform = game.available / game.available.sum(axis=1, keepdims=True)
    return known, {"initial": uniform, "winning": winning}, quantity


def _worst(model: Patrol, strategy: jax.Array) -> jax.Array:
    """The worst-case value of a strategy."""
    return check(strategy_value(model.game, strategy, model.reward, DISCOUNT)).value


def _summary(model: Patrol, value: jax.Array) -> Record:
    here = jnp.maximum(value[model.game.system], 0)  # rounding may leave a tiny negative zero
    return {"min": here.min(), "max": here.max(), "mean": here.mean()}


# --- learning -----------------------------------------------------------------------------------


@jax.jit
def _learn_all(keys: jax.Array, problem: rmax.Problem, hparams: rmax.Hparams) -> loops.Learned:
    return jax.vmap(lambda key: _learn(key, problem, hparams, jnp.int32(loops.MAX_STEPS)))(keys)


@jax.jit
def _learn(
    key: jax.Array, problem: rmax.Problem, hparams: rmax.Hparams, max_moves: jax.Array
) -> loops.Learned:
    """Learning until the strategy is stable, or a number of moves was made."""
    return rmax.train_until(
        key, problem, hparams, until=Partial(_is_stable, max_moves), num_steps=10**6
    )


def _is_stable(
    max_moves: jax.Array, before: rmax.State, after: rmax.State, metrics: rmax.Metrics
) -> jax.Array:
    return (after.moves - after.last_update >= REST) | (after.moves >= max_moves)


def _single_run_seconds(
    keys: jax.Array, problem: rmax.Problem, hparams: rmax.Hparams, learned: loops.Learned
) -> tuple[float, float]:
    """Median seconds of single runs, until they end and until their last update."""
    max_moves = jnp.full_like(learned.state.last_update, loops.MAX_STEPS)

    def median(limits: jax.Array) -> float:
        pairs = zip(keys, limits, strict=True)
        runs = [run_seconds(partial(_learn, k, problem, hparams, limit))[1] for k, limit in pairs]
        return float(np.median(runs))

    return median(max_moves), median(learned.state.last_update)


def _evaluated(
    learned: loops.Learned, problem: rmax.Problem, hparams: rmax.Hparams
) -> tuple[list[Record], rmax.Evidence]:
    """A row for each seed, and the evidence of the first; all strategies of a run have one support."""
    rows, every = [], []
    for seed in range(len(learned.num_steps)):
        one = jax.tree.map(lambda x, i=seed: x[i], learned)
        check(one)
        evidence = rmax.evidence(one.state, problem, hparams)
        every.append(evidence)
        counted = evidence.reachable & problem.game.system
        rows.append(
            {
                "seed": seed,
                "restart": hparams.restart,
                "last_update_step": one.state.last_update,
                "moves": one.state.moves,
                "updates": one.state.num_updates,
                "eps_optimal_states": jnp.sum(evidence.epsilon_optimal & counted),
                "eps_optimal_states_played": jnp.sum(evidence.epsilon_optimal_played & counted),
                "always_almost_sure": bool(one.state.always_almost_sure & evidence.almost_sure),
            }
        )
    return rows, every[0]


# --- the table ----------------------------------------------------------------------------------


def table(result: Record) -> str:
    """The report of section 6.7."""
    return render_table(
        "pac.txt",
        result=result,
        published=PUBLISHED,
        restart=round(1 / RESTART),
        pairs=list(zip(result["learned"], result["learned_without_restarts"], strict=True)),
    )


# --- pictures -----------------------------------------------------------------------------------


def _figure_17(model: Patrol, quantity: jax.Array) -> Record:
    """Optimal actions without the task for each light, on first, and cell, for any automaton state."""
    best = pac.near_optimal(quantity, model.game.available, 1e-9)
    here = np.asarray(model.game.system & (model.memory == 0))
    moves = np.zeros((2, 9, len(ACTIONS)), bool)
    place = np.asarray(1 - model.light)[here], np.asarray(model.cell)[here]
    moves[place] = np.asarray(best)[here][:, : len(ACTIONS)]
    return {"best": moves}


def _figure_19(model: Patrol, winning: jax.Array, learned: rmax.Evidence) -> Record:
    """Strategies for each light, on first, and automaton state; NaN in unreachable states."""
    system = np.asarray(model.game.system)
    place = tuple(np.asarray(x)[system] for x in (1 - model.light, model.memory, model.cell))
    reached = np.asarray(learned.reachable)[system]

    def on_maps(strategy: jax.Array) -> np.ndarray:
        maps = np.full((2, 4, 9, len(ACTIONS)), np.nan)
        rows = np.asarray(strategy)[system][:, : len(ACTIONS)]
        maps[place] = np.where(reached[:, None], rows, np.nan)
        return maps

    epsilon_optimal = np.zeros((2, 4, 9), bool)
    epsilon_optimal[place] = np.asarray(learned.epsilon_optimal)[system] & reached
    return {
        "initial": on_maps(winning),
        "learned": on_maps(learned.strategy),
        "epsilon_optimal": epsilon_optimal,
    }


def pictures(result: Record) -> Record:
    """Figures 17 to 19: the task, the values, and the strategies of the first seed."""
    from jaxltl import plot

    task = surveillance()
    occurs = ~task.letters.all(axis=1)  # without the letter that no cell has, for shorter guards
    letters, delta, priority = task.letters[occurs], task.delta[:, occurs], task.priority[:, occurs]
    task = replace(task, letters=letters, delta=delta, priority=priority)
    best = np.asarray(result["figure17"]["best"], float)
    danger = np.array([np.isin(np.arange(9), cells) for cells in _DANGER.values()])
    values, maps = result["figure18"], result["figure19"]
    titles = [f"light {light}, q{q}" for light in _DANGER for q in (1, 2, 3, 4)]
    laid_out = {k: np.asarray(maps[k], float).reshape(8, 9, -1) for k in ("initial", "learned")}
    return {
        "figure_17_automaton": plot.automaton(task),
        "figure_17_best_moves": plot.strategies(
            _MAP,
            best,
            marked=danger,
            mark="dangerous",
            titles=[f"light {light}" for light in _DANGER],
        ),
        "figure_18_values": plot.compare(
            {
                "optimal": values["optimal"],
                "learned": values["learned"],
                "initial (uniform)": values["initial"],
                "winning, by the graph only": values["winning"],
            },
            groups=["reachable" if x else "unreachable" for x in values["reachable"]],
            label="worst-case value",
        ),
        "figure_19_initial": plot.strategies(_MAP, laid_out["initial"], titles=titles),
        "figure_19_learned": plot.strategies(
            _MAP,
            laid_out["learned"],
            titles=titles,
            marked=np.asarray(maps["epsilon_optimal"]).reshape(8, 9),
            mark="epsilon-optimal",
        ),
    }
