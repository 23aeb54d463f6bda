"""Experiment of section 2.5: maximum-likelihood inverse RL with an LTL task."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos import mlirl as irl
from jaxltl.algos.common import learner
from jaxltl.algos.common.chunks import ChunkOptions, run_in_chunks
from jaxltl.app.wording import Record
from jaxltl.core.models.construct.lifting import lift_policy
from jaxltl.core.models.construct.restrict import restrict
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.product import Product, product
from jaxltl.core.models.trajectories import Trajectories, make_trajectories
from jaxltl.core.types import NotConverged, Status, check
from jaxltl.core.values.undiscounted.mixture import from_starts
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability
from jaxltl.envs.gridworld import ACTIONS, gridworld
from jaxltl.reproduce.experiment import experiment, render_table

MAP = """
w  w  w  w  w  w  r  w  w  w
w  w  w  w  w  w  r  w  w  w
w  w  g1 w  w  w  w  w  r  w
w  w  w  w  w  r  w  w  r  w
w  w  w  w  w  w  w  w  w  w
w  w  w  r  r  r  w  w  w  w
w  w  w  r  w  r  w  w  w  w
w  w  w  w  w  w  w  g2 w  w
w  w  w  w  w  w  w  w  w  w
b  w  w  w  r  w  w  w  w  y
"""
LEGEND = {"w": [], "b": ["b"], "r": ["r"], "y": ["y"], "g1": ["g1"], "g2": ["g2"]}
TASK = "(!r & !y) -> ((!r U y) & (!y U g1) & (!y U g2) & F y)"
TASK_WITHOUT_SAFETY = "(!r & !y) -> ((!y U g1) & (!y U g2) & F y)"
# Actions of the four demonstrations from the blue cell: up, down, left or right.
DEMONSTRATIONS = (
    "r u r uuuuuu rrrrr ddddd r d r d",
    "rrr u rr u rr u l uuuu llll rrrrr dddddd r d r",
    "rr uuuuuuu rrrrr ddddd rr dd",
    "rrr u rrrr u lllll uuuuu rrrrr ddddd rr dd",
)
MUS = (0.0, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0)
STARTS = ((0, 0, 0, 0, 0), (1, 1, 1, 1, 1), (5, 2, 2, 2, 2))
DISCOUNT, L2, MU = 0.5, 1e-3, 0.01

PUBLISHED: dict[str, Record] = {
    "case1": {"mean": 0.304, "min": 6.9e-9, "theta": [8.5176, 4.2678, -0.0442, -0.8208, 3.7336]},
    "case2": {"mean": 0.954, "min": 0.430, "theta": [9.6090, 2.3128, 2.7393, -0.0121, 2.3221]},
    "case3": {"mean": 0.999, "min": 0.962, "theta": [10.2010, 1.8908, 3.9550, 8.1854, 1.8855]},
}


def two_goals() -> tuple[MDP, Trajectories]:
    """The world of section 2.5 and its four demonstrations; initial cells are not red or yellow."""
    world = gridworld(MAP, legend=LEGEND, absorbing=["y"], initial="!r & !y")
    start = MAP.split().index("b")
    sequences = []
    for actions in DEMONSTRATIONS:
        state, pairs = start, []
        for letter in actions.replace(" ", ""):
            action = "udlr".index(letter)
            pairs.append((state, action))
            state = int(world.successor[state, action, 0])
        sequences.append(pairs)
    assert ACTIONS == ("up", "down", "left", "right")
    return world, make_trajectories(world, sequences)


def learn_cases(
    problem: irl.Problem, mus: tuple[float | None, ...]
) -> list[tuple[np.ndarray, jax.Array, float]]:
    """Weights ``[F]``, policy and negative log-likelihood for each mu, from the best of three starts."""
    starts = jnp.tile(jnp.asarray(STARTS, problem.features.dtype), (len(mus), 1))
    mu = None if None in mus else jnp.repeat(jnp.asarray(mus), len(STARTS))
    hparams = irl.Hparams(discount=DISCOUNT, mu=mu, l2=L2, guess_scale=0.0)
    one = irl.Hparams(discount=DISCOUNT, l2=L2, guess_scale=0.0)

    def begin(guess: jax.Array) -> irl.State:
        return irl.init(jax.random.key(0), replace(problem, guess=guess), one)

    learned = run_in_chunks(
        irl.step,
        jax.vmap(begin)(starts),
        problem,
        hparams,
        num_steps=400,
        options=ChunkOptions(until=learner.gradient_vanishes(1e-6), keep="before", lanes=True),
    )
    states, last = learned.state, jax.tree.map(lambda x: x[-1], learned.metrics)
    shape = (len(mus), len(STARTS))
    gradient, loss = (x.reshape(shape) for x in (last.gradient_norm, last.loss))
    best = np.argmin(np.where(gradient <= 1e-6, loss, np.inf), axis=1)
    cases = []
    for i, j in enumerate(best):
        if not gradient[i, j] <= 1e-6:
            raise NotConverged(
                f"mu={mus[i]}: the gradient's norm is {gradient[i].min():.1e} after 400 steps "
                "from every start; it should vanish."
            )
        theta = states.parameters[i * len(STARTS) + int(j)]
        solution = jax.jit(irl.solve)(theta, problem, one)
        if int(solution.status) != Status.CONVERGED:
            check(solution)
        log_policy = jnp.log(jnp.where(problem.counts > 0, solution.policy, 1))
        cases.append(
            (np.asarray(theta), solution.policy, float(-jnp.sum(problem.counts * log_policy)))
        )
    return cases


def _evaluated(model: Product, policy: jax.Array) -> tuple[Record, np.ndarray]:
    """Mean and minimum over initial states of the satisfaction probability, and that of each."""
    solution = check(satisfaction_probability(model, policy))
    starts = np.asarray(model.initial) > 0
    value = np.asarray(solution.value)[starts]
    row = {
        "mean": value.mean(),
        "min": value.min(),
        "worst": int(np.argwhere(starts)[np.argmin(value)][0]),
        "bound": float(np.max((solution.upper - solution.lower)[starts])),
    }
    return row, from_starts(model, solution.value)


def _case(model: Product, learned: tuple[np.ndarray, jax.Array, float]) -> Record:
    theta, policy, likelihood = learned
    policy = policy if policy.ndim == 3 else lift_policy(model, policy)
    return {**_evaluated(model, policy)[0], "theta": theta, "neg_log_likelihood": likelihood}


def _missing_safety(world: MDP, demonstrations: Trajectories) -> Record:
    """A policy learned with a task that does not forbid red, evaluated under the true task."""
    incomplete = product(world, TASK_WITHOUT_SAFETY)
    features = irl.task_features(incomplete, demonstrations, avoid=["r"])
    [(_, policy, _)] = learn_cases(
        irl.make_problem(incomplete, features.values, demonstrations), (None,)
    )
    reached = restrict(incomplete)
    true = product(reached.model, TASK)
    row, each = _evaluated(true, lift_policy(true, policy[reached.base_state, reached.memory]))
    base = np.asarray(reached.base_state)
    cell = int(np.argmax(base == 6 * 10 + 4))
    return {**row, "worst": int(base[row["worst"]]), "row_7_column_5": each[cell]}


@experiment
def measure(progress: Callable[[str], None]) -> Record:
    """Section 2.5: three cases, the sweep of mu, and the task without its safety part."""
    world, demonstrations = two_goals()
    model = product(world, TASK)
    progress("case 1: in the world, without the task")
    features = irl.world_features(
        world, demonstrations, goal=["y"], progress=["g1", "g2"], avoid=["r"]
    )
    [first] = learn_cases(irl.make_problem(world, features.values, demonstrations), (None,))
    progress("case 2: in the product")
    features = irl.task_features(model, demonstrations, avoid=["r"])
    problem = irl.make_problem(model, features.values, demonstrations)
    [second] = learn_cases(problem, (None,))
    progress(f"case 3: with the satisfaction term, for {len(MUS)} weights mu in parallel")
    sweep = [_case(model, case) for case in learn_cases(problem, MUS)]
    progress("without the safety part of the task")
    return {
        "case1": _case(model, first),
        "case2": _case(model, second),
        "case3": sweep[MUS.index(MU)],
        "mu_sweep": [{"mu": mu, **case} for mu, case in zip(MUS, sweep, strict=True)],
        "missing_safety": _missing_safety(world, demonstrations),
    }


def table(result: Record) -> str:
    """The report of section 2.5."""
    titles = ("case 1: in the world", "case 2: in the product", "case 3: with satisfaction")
    names = ("case1", "case2", "case3")
    cases = [(t, result[n], PUBLISHED[n]) for t, n in zip(titles, names, strict=True)]
    return render_table("mlirl.txt", cases=cases, **result)
