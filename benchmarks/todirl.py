"""(i) Task-oriented deep inverse RL: gradient, seeds and test worlds; (j) a large world."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks.timing import compare, once
from jaxltl.algos import todirl
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.models.construct.batch import stack_products
from jaxltl.core.models.ops.operators import expectation, transition_matrix
from jaxltl.core.models.product import Product, product
from jaxltl.core.values.discounted.soft import policy_logits, soft_value
from jaxltl.core.values.undiscounted.performance import task_performances
from jaxltl.envs import temporal_gridworld as grid
from jaxltl.envs.cell_kinds import many_objects

_DISCOUNT = 0.95
_SEEDS = 10
_SWEEPS = (*range(40, 200, 5), 250, 300, 400, 600, 800)


def _task(formula: str, objects: grid.Counts) -> Automaton:
    """Over the letters of our worlds: no cell is of two kinds."""
    return to_automaton(formula, letters=[frozenset(), *(frozenset([p]) for p in (*objects, "ob"))])


def problem() -> todirl.Problem:
    """100 demonstrations in the training world of section 3.5, 500 product states."""
    world = grid.training_world(0)
    model = product(world.mdp, _task(grid.COMPLETE, grid.OBJECTS), label_on="exit")
    policy = grid.expert_policy(model, _DISCOUNT)
    shown = grid.demonstrations(jax.random.key(0), model, policy, 100)
    return todirl.make_problem(model, grid.observations(world), shown)


def _lane(tree: Any, i: int = 0) -> Any:
    return jax.tree.map(lambda x: x[i], tree)


# --- (1) one gradient ---------------------------------------------------------------------------


@jax.jit
def exact_gradient(parameters, given: todirl.Problem, hparams, initial=None):
    """The gradient as the learner takes it."""
    return jax.grad(lambda p: todirl.objective(p, given, hparams, initial)[0])(parameters)


@partial(jax.jit, static_argnames="num_steps")
def unrolled_gradient(parameters, given: todirl.Problem, hparams, initial=None, *, num_steps: int):
    """Reverse mode through a fixed number of soft backups."""
    model, seen, counts = _lane((given.model, given.observation, given.counts))

    def loss(parameters):
        rewards = todirl.reward(given.network, parameters, model, seen)

        def backup(value, _):
            logits = policy_logits(model, rewards, hparams.discount, value)
            return jax.nn.logsumexp(logits, axis=-1), None

        start = jnp.zeros(model.state_shape) if initial is None else initial[0]
        value, _ = jax.lax.scan(backup, start, None, length=num_steps)
        log_policy = jax.nn.log_softmax(policy_logits(model, rewards, hparams.discount, value))
        squares = sum(jnp.sum(x * x) for x in jax.tree.leaves(parameters))
        return hparams.l2 / 2 * squares - jnp.sum(counts * log_policy)

    return jax.grad(loss)(parameters)


@partial(jax.jit, static_argnames="num_steps")
def dense_gradient(
    parameters, given: todirl.Problem, hparams, initial=None, *, num_steps: int | None = None
):
    """By the sensitivity of the values to every parameter (3.6): ``dV = E[dR + gamma P dV]``.

    The matrix is written out; solved, or by a number of sweeps as in the dissertation.
    """
    model, seen, counts = _lane((given.model, given.observation, given.counts))
    flat, restore = ravel_pytree(parameters)

    def one(observation, memory, action):
        """A single reward's derivative in all parameters."""
        inputs = [x[None, None, None] for x in (observation, memory, action)]
        return jax.grad(lambda p: jnp.sum(given.network.apply(restore(p), *inputs)))(flat)

    for axis in (2, 1, 0):
        one = jax.vmap(one, [0 if i == axis else None for i in range(3)])
    slope = one(seen, jnp.eye(model.num_memory), jnp.eye(model.num_actions))  # [S, Q, A, N]
    rewards = todirl.reward(given.network, parameters, model, seen)
    policy = soft_value(
        model,
        rewards,
        hparams.discount,
        initial=None if initial is None else initial[0],
        method="value_iteration",
    ).policy

    mean = jnp.einsum("sqa,sqan->sqn", policy, slope).reshape(model.num_states, -1)
    after = hparams.discount * transition_matrix(model, policy).reshape(2 * [model.num_states])
    if num_steps is None:
        values = jnp.linalg.solve(jnp.eye(model.num_states) - after, mean)
    else:
        values = jax.lax.fori_loop(0, num_steps, lambda _, v: mean + after @ v, mean)
    values = values.reshape(*model.state_shape, -1)
    # d log pi = d(Q - V), and sum_a c (dQ - dV) needs the mean of dV over successors of pairs.
    weight = counts - policy * counts.sum(-1, keepdims=True)
    following = hparams.discount * jax.vmap(partial(expectation, model), -1, -1)(values)
    found = jnp.einsum("sqa,sqan->n", weight, slope + following)
    return restore(hparams.l2 * flat - found)


def _distance(one: Any, other: Any) -> float:
    """Largest difference relative to the largest entry of the other, in double precision."""
    pairs = [
        (np.asarray(x, float).ravel(), np.asarray(y, float).ravel())
        for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    ]
    x, y = (np.concatenate(z) for z in zip(*pairs, strict=True))
    return float(np.abs(x - y).max() / np.abs(y).max())


def _double(tree: Any) -> Any:
    def one(x):
        x = jnp.asarray(x)
        return x.astype(jnp.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(one, tree)


def gradient_rows(given: todirl.Problem, hparams, parameters, last) -> list[dict[str, Any]]:
    """Against the unrolled iteration, and against the sensitivity to each parameter.

    Args:
      given, hparams: problem and hyperparameters.
      parameters: where the gradient is taken.
      last: the soft values from which the learner starts here.
    """
    with jax.enable_x64(True):
        true = exact_gradient(_double(parameters), _double(given), _double(hparams))
    rows = []
    for start, initial in (("from zero", None), ("as in training", last)):
        ours = partial(exact_gradient, parameters, given, hparams, initial)
        error = _distance(ours(), true)
        for num_steps in _SWEEPS:
            peer = partial(
                unrolled_gradient, parameters, given, hparams, initial, num_steps=num_steps
            )
            other = _distance(peer(), true)
            if other <= error:
                break
        rows.append(
            {
                "name": f"todirl gradient, {given.model.num_states} states, {start}",
                "peer": f"unrolled, {num_steps} sweeps",
                "error": error,
                "peer_error": other,
                "target": 1 / 3,
                **compare(ours, peer, repeats=41),
            }
        )
    for kind, steps in (("solved", None), (f"{num_steps} sweeps", num_steps)):
        peer = partial(dense_gradient, parameters, given, hparams, last, num_steps=steps)
        rows.append(
            {
                "name": f"todirl gradient, {given.model.num_states} states, as in training",
                "peer": f"(3.6), dense, {kind}",
                "error": error,
                "peer_error": _distance(peer(), true),
                "target": 1 / 50,
                **compare(ours, peer, repeats=3),
            }
        )
    return rows


# --- (2) seeds, (3) test worlds -----------------------------------------------------------------


def seeds_row(given: todirl.Problem, hparams, num_steps: int = 50) -> dict[str, Any]:
    """Learning with ten seeds side by side against one."""
    train = jax.jit(partial(todirl.train, num_steps=num_steps, max_rows=1))
    together = jax.jit(
        jax.vmap(partial(todirl.train, num_steps=num_steps, max_rows=1), (0, None, None))
    )
    keys = jax.random.split(jax.random.key(1), _SEEDS)
    timed = compare(
        partial(together, keys, given, hparams), partial(train, keys[0], given, hparams), repeats=7
    )
    return {
        "name": f"todirl, {_SEEDS} seeds, {num_steps} steps",
        "peer": "one seed",
        "target": 4.0,
        **timed,
    }


def worlds_row(given: todirl.Problem, hparams, parameters, num: int = 1000) -> dict[str, Any]:
    """Planning with what was learned in worlds never seen, and certified evaluation."""
    worlds = grid.random_worlds(range(1000, 1000 + num))
    automaton = _task(grid.COMPLETE, grid.OBJECTS)
    models = stack_products([w.mdp for w in worlds], automaton, label_on="exit")
    seen = jnp.stack([grid.observations(w) for w in worlds])

    @jax.jit
    def plan(parameters, models, seen):
        one = partial(todirl.plan, given.network, parameters, hparams=hparams)
        return jax.vmap(lambda m, o: one(m, o).policy)(models, seen)

    def evaluate():
        return task_performances(models, plan(parameters, models, seen))

    first, _ = once(evaluate)
    seconds, found = min((once(evaluate) for _ in range(3)), key=lambda x: x[0])
    return {
        "name": f"todirl, {num} test worlds planned and judged",
        "peer": "seconds asked for",
        "compile_seconds": max(first - seconds, 0.0),
        "seconds": seconds,
        "peer_seconds": 10.0,
        "ratio": seconds / 10,
        "target": 1.0,
        "plan_seconds": once(lambda: plan(parameters, models, seen))[0],
        "mean": float(found.mean.mean()),
        "worst": float(found.mean.min()),
        "worst_lower": float(found.lower.min()),
        "half_width": float(jnp.max(found.upper - found.lower)) / 2,
        "not_certified": int(np.sum(np.asarray(found.status) != 0)),
    }


def run() -> list[dict[str, Any]]:
    """float32, after compilation."""
    given, hparams = problem(), todirl.Hparams(discount=_DISCOUNT)
    before, _ = todirl.train(jax.random.key(0), given, hparams, num_steps=60)
    now, _ = todirl.run(before, given, hparams, num_steps=1)
    learned, _ = todirl.run(now, given, hparams, num_steps=300)
    return [
        *gradient_rows(given, hparams, now.parameters, now.value),
        seeds_row(given, hparams),
        worlds_row(given, hparams, learned.best.parameters),
    ]


# --- (4) a larger world -------------------------------------------------------------------------


def ordered(num: int, then: tuple[int, ...] = ()) -> str:
    """Visit objects 1 to `num`, none before its turn, then others, never an obstacle."""
    formula = ""
    for i in reversed(then):
        formula = f"(!ob U {f'(o{i} & {formula})' if formula else f'o{i}'})"
    for i in reversed(range(1, num + 1)):
        barred = " & ".join([*(f"!o{j}" for j in range(i + 1, num + 1)), "!ob"])
        formula = f"(({barred}) U {f'(o{i} & {formula})' if formula else f'o{i}'})"
    return formula


def large(num_steps: int = 300, num_new: int = 4, discount: float = 0.995) -> dict[str, Any]:
    """64 x 64 cells: five objects in order, and back to the fourth, third and second."""
    objects = many_objects(5)
    automaton = _task(ordered(5, (4, 3, 2)), objects)
    worlds = grid.random_worlds(
        range(1 + num_new), automaton, shape=(64, 64), objects=objects, num_obstacles=60
    )
    models = stack_products([w.mdp for w in worlds], automaton, label_on="exit")
    seen = jnp.stack([grid.observations(w) for w in worlds])
    own: Product = _lane(models)
    expert = grid.expert_policy(own, discount)
    shown = grid.demonstrations(jax.random.key(0), own, expert, 100, 600)
    given = todirl.make_problem(own, seen[0], shown)
    hparams = todirl.Hparams(discount=discount)
    state = todirl.init(jax.random.key(0), given, hparams)
    chunk = 10
    first, (state, metrics) = once(partial(todirl.run, state, given, hparams, num_steps=chunk))
    seconds, made = 0.0, chunk
    while made < num_steps and not bool(state.stopped):
        more, (state, metrics) = once(partial(todirl.run, state, given, hparams, num_steps=chunk))
        seconds, made = seconds + more, made + chunk
    each = seconds / (made - chunk)

    def judge():
        policies = [
            todirl.plan(
                given.network, state.best.parameters, _lane(models, w), seen[w], hparams
            ).policy
            for w in range(len(worlds))
        ]
        return task_performances(models, jnp.stack(policies), batch=1)

    judged_first, _ = once(judge)
    judged, found = once(judge)
    return {
        "states": own.num_states,
        "memory": own.num_memory,
        "steps": made,
        "best_step": int(state.best.step),
        "step_seconds": each,
        "compile_seconds": max(first - chunk * each, 0) + max(judged_first - judged, 0),
        "learn_seconds": seconds,
        "judge_seconds": judged,
        "demonstrated_steps": float(jnp.mean(shown.length)),
        "train": float(found.mean[0]),
        "train_lower": float(found.lower[0]),
        "new": found.mean[1:].tolist(),
        "new_lower": found.lower[1:].tolist(),
        "new_upper": found.upper[1:].tolist(),
        "worst_start": float(found.worst[1:].min()),
        "status": np.asarray(found.status).tolist(),
        "solver_error": float(metrics.error[-1]),
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def run_large() -> list[dict[str, Any]]:
    """In a process of its own, whose peak memory is measured."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.todirl"], check=True, stdout=subprocess.PIPE, text=True
    )
    found = json.loads(done.stdout.splitlines()[-1])
    return [
        {
            "name": f"todirl, {found['states']} product states: 1 - L_phi",
            "peer": "a tenth, in the worst new world",
            "ratio": (1 - min(found["new_lower"])) / 0.1,
            "target": 1.0,
            "seconds": found["learn_seconds"],
            **found,
        }
    ]


if __name__ == "__main__":
    print(json.dumps(large()))
