"""Section 5.5: permissive strategies, and Q-learning inside them."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos import maximin_q
from jaxltl.app.wording import Record
from jaxltl.core.games import GR1, Parity, apply_strategy, buchi, gr1, permissive_strategy, safety
from jaxltl.core.games.winning import solve, task_game
from jaxltl.core.models import Game, Restriction
from jaxltl.core.types import NotConverged, check
from jaxltl.core.values import minimax_value, optimal_value
from jaxltl.envs.robots import diagonal_reward, reward_against_task, robots
from jaxltl.reproduce.experiment import experiment, render_table, run_seconds

SIZES = (3, 4, 5, 6, 8, 10)
BOUNDS = (4, 6, 8, 10, 14, 20)
DISCOUNT = 0.9
TOLERANCE = 1e-3  # the largest error at which learning stops
CORNERS = "system_upper_left | system_lower_right"

# By size: seconds of synthesis and of learning, moves, states, system states.
TABLE5 = {
    3: (0.10, 4.28, 9e4, 120, 72),
    4: (0.21, 16.35, 3.2e5, 432, 240),
    5: (2.20, 43.12, 8.5e5, 1120, 600),
    6: (19.40, 88.69, 1.81e6, 2400, 1260),
    8: (30.29, 305.77, 6.05e6, 7840, 4032),
    10: (300.00, 771.73, 1.562e7, 19440, 9900),
}
TABLE6 = {4: 8.0922, 6: 8.8658, 8: 9.2442, 10: 9.4647, 14: 9.7034, 20: 9.8616}
MEMORYLESS = 5.7368


@experiment
def measure(progress: Callable[[str], None]) -> Record:
    """Section 5.5: tables 5 and 6, example 2, and the game of figure 12."""
    table5, curve = [], None
    for size in SIZES:
        progress(f"table 5: two robots on a {size} x {size} grid")
        row, size_curve = _example_1(size)
        table5.append(row)
        curve = size_curve or curve
    progress(f"table 6: counters up to {BOUNDS[-1]}")
    memoryless, *table6 = [_counters(bound) for bound in (None, *BOUNDS)]
    progress("example 2: assumptions and guarantees")
    second = _example_2()
    progress("figure 12: a reward against the task")
    return {
        "table5": table5,
        "table6": table6,
        "memoryless_permissive_max": memoryless["max_value"],
        "example2": second["summary"],
        "figure12": _figure_12(),
        "figure13": curve,
        "figure14": second["values"],
    }


def _restricted(game: Game, objective: Parity | GR1, bound: int | None = None) -> Restriction:
    return apply_strategy(permissive_strategy(game, objective, bound=bound))


def _value(game: Game) -> np.ndarray:
    """The minimax value, with the system's moves discounted."""
    solution = minimax_value(
        game, diagonal_reward(game), DISCOUNT, per="system_move", tolerance=1e-9
    )
    return np.asarray(check(solution).value)


def _example_1(size: int) -> tuple[Record, Record]:
    """A row of table 5, and the learning curve of size 4."""

    def synthesize() -> Restriction:
        game = robots(size)
        return _restricted(game, safety(game, "!collision"))

    strategy, synthesis_seconds = run_seconds(synthesize)
    game = strategy.model
    exact = _value(game)
    problem = maximin_q.make_problem(game, diagonal_reward(game))
    problem = maximin_q.with_exact_value(problem, exact, maximin_q.recurrent_states(problem))
    hparams = maximin_q.Hparams(discount=DISCOUNT, num_chains=1024, moves_per_step=16)
    (state, metrics), learning_seconds = run_seconds(lambda: _learn(problem, hparams))
    system = np.asarray(game.system)
    values, counts = np.unique(np.round(exact[system], 6), return_counts=True)
    row = {
        "n": size,
        "states": game.num_states,
        "system_states": int(system.sum()),
        "synthesis_seconds": synthesis_seconds,
        "learning_seconds": learning_seconds,
        "learning_moves": float(metrics.moves),
        "max_error": float(metrics.error),
        "violations": int(metrics.violations),
        "values": {f"{v:g}": int(c) for v, c in zip(values, counts, strict=True)},
    }
    return row, _learning_curve(size, strategy, problem, state) if size == 4 else {}


def _learn(
    problem: maximin_q.Problem, hparams: maximin_q.Hparams
) -> tuple[maximin_q.State, maximin_q.Metrics]:
    """Steps until the error on the recurrent states is below the tolerance."""
    state = maximin_q.init(jax.random.key(0), problem, hparams)
    for _ in range(4000):
        state, metrics = maximin_q.run(state, problem, hparams, num_steps=4, max_rows=1)
        metrics = jax.tree.map(lambda x: x[-1], metrics)
        if float(metrics.error) < TOLERANCE:
            return state, metrics
    raise NotConverged(
        f"after {float(metrics.moves):.3g} moves the error is still "
        f"{float(metrics.error):.2g}; it should fall below {TOLERANCE}."
    )


def _learning_curve(
    size: int, strategy: Restriction, problem: maximin_q.Problem, learned: maximin_q.State
) -> Record:
    """Data of figure 13: the learned values, and their changes in steps of 10,000 moves."""
    hparams = maximin_q.Hparams(discount=DISCOUNT, num_chains=100, moves_per_step=100)
    _, metrics = maximin_q.train(jax.random.key(1), problem, hparams, num_steps=40, max_rows=40)
    return {
        "n": size,
        "state": np.asarray(strategy.base_state),
        "value": np.asarray(learned.value),
        "moves": np.asarray(metrics.moves),
        "residual": np.asarray(metrics.residual),
    }


def _counters(bound: int | None) -> Record:
    game = robots(3)
    restricted = _restricted(game, buchi(game, CORNERS, safe="!collision"), bound).model
    return {
        "bound": bound,
        "states": restricted.num_states,
        "max_value": float(_value(restricted).max()),
    }


def _example_2() -> Record:
    game = robots(4)
    task = gr1(
        game,
        ["environment_lower_left", "environment_upper_right"],
        ["system_lower_right", "system_upper_left"],
        safe="!collision",
    )
    strategy = permissive_strategy(game, task)
    restricted = apply_strategy(strategy)
    value = _value(restricted.model)
    initial = np.asarray(restricted.model.initial) > 0
    here = value[initial]
    return {
        "summary": {
            "n": 4,
            "max": here.max(),
            "min": here.min(),
            "mean": here.mean(),
            "maximal": strategy.maximal,
        },
        "values": {"n": 4, "state": np.asarray(restricted.base_state)[initial], "value": here},
    }


def _figure_12() -> Record:
    """The value without a task, and with the task satisfied within m visits."""
    game, reward = reward_against_task()
    best = check(optimal_value(game.mdp, reward, DISCOUNT))
    action = reward + DISCOUNT * best.value[game.mdp.successor[..., 0]]
    full = game.available & (action >= best.value[:, None] - 1e-9)
    joint, task = task_game(game, "F b2")
    moves = jnp.broadcast_to(full[:, None, :], joint.available.shape)
    start = jnp.argmax(best.value)
    won = solve(joint, task, moves).region[start, joint.mdp.initial_memory[start]]
    delays = []
    for bound in (2, 4, 8, 16, 32):
        strategy = permissive_strategy(game, "F b2", method="parity", bound=bound)
        restricted = apply_strategy(strategy)
        paid = reward[strategy.base_state[restricted.base_state]]
        value = check(optimal_value(restricted.model.mdp, paid, DISCOUNT)).value
        delays.append({"bound": bound, "value": float(value.max())})
    return {"supremum": float(best.value.max()), "attained": bool(won), "delays": delays}


def table(result: Record) -> str:
    """The report of section 5.5."""
    rows = {
        "table5": [(row, TABLE5[row["n"]]) for row in result["table5"]],
        "table6": [(row, TABLE6[row["bound"]]) for row in result["table6"]],
    }
    return render_table("synthesis.txt", memoryless=MEMORYLESS, **{**result, **rows})


def pictures(result: Record) -> Record:
    """Figures 13 and 14: values of the system's states, and the convergence of learning."""
    from jaxltl import plot

    first, second = result["figure13"], result["figure14"]
    change = np.log10(np.maximum(first["residual"], 1e-16))
    return {
        "figure_13_values": plot.game_values(_on_all_states(first), 4, label="learned value"),
        "figure_13_residual": plot.curves(
            {"log10 of the largest change of a value": change}, steps=first["moves"]
        ),
        "figure_14_values": plot.game_values(_on_all_states(second), 4, label="value"),
    }


def _on_all_states(part: Record) -> np.ndarray:
    values = np.full(2 * part["n"] ** 4, np.nan)
    values[np.asarray(part["state"])] = part["value"]
    return values
