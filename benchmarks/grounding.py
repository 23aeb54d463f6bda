"""Symbols of unknown meaning: ``python -m benchmarks.grounding tasks automata ... [--first 0 --step 1]``.

Parts, a JSON line for each case and a summary at the end:

- tasks: random tasks on gridworlds with hidden meanings: the grounding from 20 demonstrations and from
  fewer, certified probabilities in new worlds, and robust policies from 2 demonstrations;
- noisy: the same with Gaussian observations of ten dimensions and a network as grounding;
- baselines: behavioural cloning, `mlirl` without memory and counting on the same demonstrations;
- automata: automata learned with a given number of states.

Seconds are CPU seconds of all threads, compilation included.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn

import jaxltl as jl
from jaxltl.algos import grounding, mlirl
from jaxltl.core.automata.language import synchronize
from jaxltl.core.models.construct.batch import lift_memory_policy
from jaxltl.core.values.discounted.soft import soft_value
from jaxltl.envs import gridworld

KINDS, IRRELEVANT = "abcde", 2
SLIP, DISCOUNT, SCALE = (
    0.1,
    0.95,
    40.0,
)  # temperature of the demonstrator: 1 / 40 of an event's reward
WORLDS, DEMONSTRATIONS, LENGTH, NEW = 5, 20, 50, 20
HPARAMS = grounding.Hparams(discount=DISCOUNT)
COUNTS = (1, 2, 5, 10, 20)
LEVEL = 0.95
SCALES = (5.0, 10.0, 20.0, 50.0, 100.0)  # grid of the posterior; the true scale is not on it
LEAST_WEIGHT, MEMBERS = 0.05, 6  # of the groundings that a robust policy serves, and their number
# Formula; for the baseline that counts, its goals in order and its hazards.
SHAPES = {
    "visits": ("F (p & F q)", "pq", ""),
    "visits, avoidance": ("!h U (p & (!h U q))", "pq", "h"),
    "either-or, avoidance": ("!h U (p | q)", "pq", "h"),
    "strict order": ("(!q U p) & F q", "pq", ""),
    "three visits": ("F (p & F (q & F r))", "pqr", ""),
    "response": ("G F r & G (p -> F q)", "rq", ""),
    "patrol": ("G F p & G F q", "pq", ""),
    "patrol, avoidance": ("G F p & G F q & G !h", "pq", "h"),
}


@dataclass
class Case:
    """A random task with its worlds and demonstrations."""

    shape: str
    formula: str
    symbols: tuple[str, ...]
    truth: tuple[int, ...]  # the kind of each symbol
    worlds: list[jl.MDP]
    seen: list[np.ndarray]  # float[S, O] of each world
    shown: list[Any]  # demonstrations in each world
    new: list[jl.MDP]
    new_seen: list[np.ndarray]


def make_world(size: int, rng: np.random.Generator) -> tuple[jl.MDP, np.ndarray]:
    """A map with 2 to 4 objects of each kind, and observations with irrelevant features."""
    cells = np.full(size * size, ".")
    count = rng.integers(2, 5, len(KINDS))
    places = rng.permutation(size * size)[: count.sum()]
    cells[places] = np.repeat(list(KINDS), count)
    text = "\n".join("".join(row) for row in cells.reshape(size, size))
    world = gridworld(text, slip=SLIP, initial=" & ".join(f"!{k}" for k in KINDS))
    irrelevant = rng.random((size * size, IRRELEVANT)) < 0.1
    return world, np.concatenate([np.asarray(world.label), irrelevant], 1).astype(float)


_policy = jax.jit(grounding.demonstrator_policy)


def make_case(index: int) -> Case:
    """The random task of an index."""
    rng = np.random.default_rng(index)
    shape = list(SHAPES)[index % len(SHAPES)]
    formula = SHAPES[shape][0]
    symbols = jl.to_automaton(formula).propositions
    truth = tuple(rng.permutation(len(KINDS))[: len(symbols)].tolist())
    size = int(rng.integers(8, 11))
    drawn = [make_world(size, rng) for _ in range(WORLDS + NEW)]
    worlds, seen = [x[0] for x in drawn], [x[1] for x in drawn]
    shown, each = [], DEMONSTRATIONS // WORLDS
    for w in range(WORLDS):
        model = jl.product(labelled(worlds[w], seen[w], truth, symbols), formula)
        stop = model.final if model.automaton.is_cosafe else None
        runs = jl.models.rollout(
            model,
            _policy(model, SCALE, DISCOUNT),
            jax.random.key(1000 * index + w),
            num_trajectories=each,
            num_steps=LENGTH,
            stop=stop,
        )
        shown.append(jl.models.project_trajectories(model, runs))
    return Case(
        shape,
        formula,
        symbols,
        truth,
        worlds[:WORLDS],
        seen[:WORLDS],
        shown,
        worlds[WORLDS:],
        seen[WORLDS:],
    )


def labelled(
    world: jl.MDP, seen: np.ndarray, kinds: Sequence[int], symbols: Sequence[str]
) -> jl.MDP:
    """A world with the labels of a grounding: the column of each symbol."""
    return grounding.with_labels(world, seen[:, list(kinds)] > 0, symbols)


def problem_of(case: Case, seen: Sequence[np.ndarray] | None = None, **options: Any) -> Any:
    """The learning problem of a case."""
    return grounding.make_problem(
        case.worlds, seen or case.seen, case.shown, case.formula, **options
    )


def is_same(case: Case, row: Sequence[int]) -> bool:
    """True if a grounding is the hidden one, up to a symmetry of the formula."""
    automaton = jl.to_automaton(case.formula)
    orders = grounding.symbol_symmetries(automaton)
    return any(tuple(row[i] for i in order) == case.truth for order in orders)


def probabilities(
    case: Case, world: jl.MDP, labels: np.ndarray, true: np.ndarray
) -> tuple[float, float]:
    """Certified probability of the true formula by the best policy under `labels`, and the maximum."""
    automaton = jl.to_automaton(case.formula)
    names = {p: (f"{p}0", f"{p}1") for p in case.symbols}
    own, judge = (
        replace(automaton, propositions=tuple(names[p][i] for p in automaton.propositions))
        for i in (0, 1)
    )
    columns = [*(names[p][0] for p in case.symbols), *(names[p][1] for p in case.symbols)]
    joint = grounding.with_labels(world, np.concatenate([labels, true], 1), columns)
    policy = np.asarray(jl.optimal_satisfaction(jl.product(joint, own)).policy)
    policy = np.asarray(lift_memory_policy(jnp.eye(world.num_actions)[policy], judge))
    model = jl.product(joint, synchronize(own, judge))
    found = jl.satisfaction_probability(model, policy)
    best = jl.optimal_satisfaction(jl.product(joint, judge))
    model_best = jl.product(joint, judge)
    lower = float(np.sum(np.asarray(model.initial) * np.asarray(found.lower)))
    upper = float(np.sum(np.asarray(model_best.initial) * np.asarray(best.upper)))
    return lower, upper


def demonstrations_of(count: int) -> list[int]:
    """Numbers of the first demonstrations, alternating over the worlds."""
    each = DEMONSTRATIONS // WORLDS
    return [each * (i % WORLDS) + i // WORLDS for i in range(count)]


def run_task(index: int) -> dict[str, Any]:
    """Groundings, certified probabilities and robust policies of a random task."""
    case = make_case(index)
    begin = time.process_time()
    problem = problem_of(case)
    found = grounding.posterior(problem, HPARAMS, scales=SCALES)
    seconds = time.process_time() - begin
    row: dict[str, Any] = {
        "index": index,
        "shape": case.shape,
        "right": is_same(case, found.assignment[0].tolist()),
    }
    for count in COUNTS:
        part = grounding.select_demonstrations(found, demonstrations_of(count))
        members = grounding.credible_set(part, LEVEL)
        row[f"right_{count}"] = is_same(case, part.assignment[0].tolist())
        row[f"covered_{count}"] = any(is_same(case, part.assignment[i].tolist()) for i in members)
        row[f"members_{count}"] = len(members)
    begin = time.process_time()
    kept = found.assignment[0].tolist()
    pairs = [
        probabilities(case, world, seen[:, kept] > 0, seen[:, list(case.truth)] > 0)
        for world, seen in zip(case.new, case.new_seen, strict=True)
    ]
    row["attained"] = float(np.mean([x for x, _ in pairs]))
    row["best"] = float(np.mean([x for _, x in pairs]))
    row["seconds"] = seconds + time.process_time() - begin
    row |= robust_of(case, grounding.select_demonstrations(found, demonstrations_of(2)))
    return row


def robust_of(case: Case, found: Any) -> dict[str, Any]:
    """Robust policy from 2 demonstrations in a new world, and the policy of the likeliest grounding."""
    begin = time.process_time()
    members = np.flatnonzero(found.weight >= LEAST_WEIGHT)[:MEMBERS]
    members = members if members.size else np.arange(1)
    world, seen = case.new[0], case.new_seen[0]
    true = seen[:, list(case.truth)] > 0
    rows = [found.assignment[i].tolist() for i in members]
    labels = [seen[:, row] > 0 for row in rows]
    robust = grounding.robust_policy(world, labels, found.symbols, case.formula, max_points=30)
    under = grounding.probability_under(robust, true, found.symbols, case.formula)
    likeliest, best = probabilities(case, world, labels[0], true)
    return {
        "robust_members": len(members),
        "robust_weight": float(found.weight[members].sum()),
        "robust_worst": robust.worst,
        "robust_inside": any(is_same(case, row) for row in rows),
        "robust_true": under,
        "likeliest_true": likeliest,
        "robust_best": best,
        "robust_seconds": time.process_time() - begin,
    }


# --- noisy observations ---------------------------------------------------------------------------


class Network(nn.Module):
    """Logits of symbols by one hidden layer."""

    num_symbols: int

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        return nn.Dense(self.num_symbols)(nn.relu(nn.Dense(32)(observation)))


def run_noisy(index: int) -> dict[str, Any]:
    """Observations of each kind are a Gaussian cluster in ten dimensions; fresh noise in new maps."""
    case = make_case(index)
    rng = np.random.default_rng(index + 10_000)
    centers = 3 * rng.normal(size=(len(KINDS) + 1, 10))

    def observe(seen: np.ndarray) -> np.ndarray:
        kinds = seen[:, : len(KINDS)]
        kind = np.where(kinds.any(1), kinds.argmax(1), len(KINDS))
        return centers[kind] + rng.normal(size=(len(seen), 10))

    begin = time.process_time()
    network = Network(len(case.symbols))
    problem = problem_of(case, [observe(seen) for seen in case.seen], network=network)
    meaning = grounding.cluster_meanings(problem, len(KINDS) + 1)
    found = grounding.posterior(problem, HPARAMS, meanings=meaning, scales=SCALES)
    state = grounding.init(jax.random.key(0), problem, HPARAMS)
    state = grounding.fit_labels(state, problem, found.labels(0))
    orders = grounding.symbol_symmetries(jl.to_automaton(case.formula))
    true = np.stack([seen[:, list(case.truth)] > 0 for seen in case.seen])
    right = [list(x) for x in orders if (found.labels(0)[..., list(x)] == true).all()]
    order = right[0] if right else list(orders[0])
    same, pairs = [], []
    for world, seen in zip(case.new, case.new_seen, strict=True):
        labels = grounding.network_labels(state, problem, jnp.asarray(observe(seen)))
        same.append((labels[:, order] == seen[:, list(case.truth)]).all(1).mean())
        pairs.append(probabilities(case, world, labels, seen[:, list(case.truth)] > 0))
    return {
        "index": index,
        "shape": case.shape,
        "right": bool(right),
        "new_states_right": float(np.mean(same)),
        "attained": float(np.mean([x for x, _ in pairs])),
        "best": float(np.mean([x for _, x in pairs])),
        "seconds": time.process_time() - begin,
    }


# --- baselines ------------------------------------------------------------------------------------

HIDDEN, STEPS, EPISODES, MOVES = 64, 400, 20, 60


def local_view(seen: np.ndarray) -> np.ndarray:
    """Per cell: its kind, offsets to the nearest object of each kind, and the kinds around it."""
    size = round(len(seen) ** 0.5)
    kinds = seen[:, : len(KINDS)]
    place = np.stack(np.divmod(np.arange(len(seen)), size), 1)
    columns = [seen]
    for k in range(len(KINDS)):
        offset = place[kinds[:, k] > 0][None] - place[:, None]
        nearest = np.abs(offset).sum(-1).argmin(1)
        columns.append(offset[np.arange(len(seen)), nearest] / size)
    grid = np.pad(kinds.reshape(size, size, -1), ((1, 1), (1, 1), (0, 0)), constant_values=-1)
    for r, c in ((0, 1), (2, 1), (1, 0), (1, 2)):
        columns.append(grid[r : r + size, c : c + size].reshape(len(seen), -1))
    return np.concatenate(columns, 1).astype(np.float32)


class Cloner(nn.Module):
    """Logits of actions along a sequence of views, by a recurrent or a memoryless network."""

    recurrent: bool

    @nn.compact
    def __call__(self, views: jax.Array) -> jax.Array:
        hidden = nn.relu(nn.Dense(HIDDEN)(views))
        if self.recurrent:
            hidden = nn.RNN(nn.GRUCell(HIDDEN))(hidden)
        else:
            hidden = nn.relu(nn.Dense(HIDDEN)(hidden))
        return nn.Dense(4)(hidden)


@partial(jax.jit, static_argnames=("network",))
def clone(network: Cloner, views: jax.Array, action: jax.Array, inside: jax.Array) -> Any:
    """Parameters by Adam with weight decay; the steps of least loss on every fifth demonstration."""
    optimizer = optax.adamw(3e-3, weight_decay=1e-2)
    held = jnp.arange(len(views)) % 5 == 0
    first = network.init(jax.random.key(0), views)

    def loss(parameters: Any, kept: jax.Array) -> jax.Array:
        each = optax.softmax_cross_entropy_with_integer_labels(
            network.apply(parameters, views), action
        )
        weight = (inside & kept[:, None]).astype(jnp.float32)
        return jnp.sum(each * weight) / jnp.sum(weight)

    def step(carry: Any, _: None) -> tuple[Any, None]:
        parameters, memory, best, least = carry
        updates, memory = optimizer.update(jax.grad(loss)(parameters, ~held), memory, parameters)
        parameters = optax.apply_updates(parameters, updates)
        score = loss(parameters, held)
        best = jax.tree.map(lambda x, y: jnp.where(score < least, x, y), parameters, best)
        return (parameters, memory, best, jnp.minimum(score, least)), None

    carry = (first, optimizer.init(first), first, jnp.float32(jnp.inf))
    return jax.lax.scan(step, carry, None, length=STEPS)[0][2]


def simulate(network: Cloner, parameters: Any, view: np.ndarray, model: Any, seed: int) -> float:
    """Share of episodes in which a recurrent policy completes a co-safe task."""
    rng = np.random.default_rng(seed)
    successor, probability = (np.asarray(x) for x in (model.mdp.successor, model.mdp.probability))
    delta, letter = np.asarray(model.automaton.delta), np.asarray(model.letter)
    final = np.asarray(model.automaton.final)
    cell = nn.GRUCell(HIDDEN)
    own = parameters["params"]
    weights = {k: own[k] for k in own if k.startswith("Dense")}
    inner = next(own[k] for k in own if not k.startswith("Dense"))
    inner = inner.get("cell", inner)

    @jax.jit
    def move(memory: jax.Array, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
        hidden = nn.relu(seen @ weights["Dense_0"]["kernel"] + weights["Dense_0"]["bias"])
        memory, out = cell.apply({"params": inner}, memory, hidden)
        return memory, out @ weights["Dense_1"]["kernel"] + weights["Dense_1"]["bias"]

    state = rng.choice(len(letter), EPISODES, p=np.asarray(model.mdp.initial))
    q = delta[int(model.automaton.initial), letter[state]]
    memory = jnp.zeros((EPISODES, HIDDEN), jnp.float32)
    for _ in range(MOVES):
        memory, logits = move(memory, jnp.asarray(view[state]))
        action = (np.asarray(logits) + rng.gumbel(size=logits.shape)).argmax(1)
        chance = probability[state, action].cumsum(1)
        k = (rng.random((EPISODES, 1)) > chance).sum(1).clip(max=chance.shape[1] - 1)
        state = successor[state, action, k]
        q = delta[q, letter[state]]
    return float(final[q].mean())


def within(model: Any, policy: Any) -> float:
    """Probability that a policy ``[S, Q, A]`` completes a co-safe task within the number of moves."""
    successor, probability = (np.asarray(x) for x in (model.mdp.successor, model.mdp.probability))
    entered = np.asarray(model.automaton.delta)[:, np.asarray(model.letter)]  # [Q, S]
    after = np.moveaxis(entered[:, successor], 0, 1)  # [S, Q, A, K]
    value = np.broadcast_to(
        np.asarray(model.automaton.final)[None], (len(successor), after.shape[1])
    )
    done, policy = value * 1.0, np.asarray(policy)
    value = done
    for _ in range(MOVES):
        mean = np.einsum("sak,sqak,sqa->sq", probability, value[successor[:, None], after], policy)
        value = np.maximum(done, mean)
    return float(np.sum(np.asarray(model.initial) * value))


def within_labels(case: Case, world: Any, model: Any, true: np.ndarray) -> float:
    """The same of the soft optimal policy in a product, judged by the true labels."""
    policy = np.asarray(_policy(model, SCALE, DISCOUNT))
    judge = jl.to_automaton(case.formula)
    own = replace(judge, propositions=tuple(f"{p}0" for p in judge.propositions))
    label = np.concatenate([np.asarray(model.mdp.label), true], 1)
    names = [*(f"{p}0" for p in model.mdp.propositions), *case.symbols]
    both = jl.product(grounding.with_labels(world, label, names), synchronize(own, judge))
    return within(both, lift_memory_policy(jnp.asarray(policy), judge))


def counting(case: Case) -> tuple[int, ...]:
    """Meanings by visits: goals are visited most in their order of first visits, hazards least."""
    count, area, first = np.zeros(len(KINDS)), np.zeros(len(KINDS)), np.zeros(len(KINDS))
    number = np.full(len(KINDS), 1e-9)
    for seen, shown in zip(case.seen, case.shown, strict=True):
        kinds = seen[:, : len(KINDS)]
        area += kinds.mean(0)
        for states, length in zip(np.asarray(shown.state), np.asarray(shown.length), strict=True):
            met = kinds[states[:length]]
            count += met.sum(0)
            seen_kinds = met.any(0)
            first += np.where(seen_kinds, met.argmax(0) if length else 0, 0)
            number += seen_kinds
    (_, goals, hazards), ratio = SHAPES[case.shape], count / area
    order = np.argsort(-ratio)
    chosen = sorted(order[: len(goals)], key=lambda k: first[k] / number[k])
    meaning = dict(zip(goals, chosen, strict=True)) | dict(zip(hazards, order[::-1], strict=False))
    return tuple(int(meaning[p]) for p in case.symbols)


def without_memory(case: Case) -> np.ndarray:
    """Weights of the observations of entered states, by `mlirl` in the union of the worlds."""
    offset = np.cumsum([0, *(x.num_states for x in case.worlds)])
    pairs, features = [], []
    for w, (world, seen, shown) in enumerate(zip(case.worlds, case.seen, case.shown, strict=True)):
        features.append(entered(world, seen))
        for s, a, n in zip(
            np.asarray(shown.state), np.asarray(shown.action), np.asarray(shown.length), strict=True
        ):
            pairs.append([(int(x + offset[w]), int(y)) for x, y in zip(s[:n], a[:n], strict=True)])
    union = jl.make_mdp(
        np.concatenate(
            [np.asarray(x.successor) + o for x, o in zip(case.worlds, offset, strict=False)]
        ),
        np.concatenate([np.asarray(x.probability) for x in case.worlds]),
    )
    shown = jl.make_trajectories(union, [x for x in pairs if x])
    problem = mlirl.make_problem(union, np.concatenate(features), shown)
    hparams = mlirl.Hparams(discount=DISCOUNT, policy="soft", l2=1e-2, optimizer="lbfgs")
    state, _ = mlirl.train(jax.random.key(0), problem, hparams, num_steps=60)
    return np.asarray(state.parameters)


def entered(world: Any, seen: np.ndarray) -> np.ndarray:
    """Expected observation ``float[S, A, F]`` of the next state."""
    return np.einsum(
        "sak,sakf->saf", np.asarray(world.probability), seen[np.asarray(world.successor)]
    )


def run_baselines(index: int) -> dict[str, Any]:
    """Probabilities of completion within 60 steps in new maps: eight tasks of each co-safe shape."""
    case = make_case(8 * (index // 5) + index % 5)
    views = [local_view(seen) for seen in case.seen]
    padded = [
        (views[w][s], a, np.arange(len(a)) < n)
        for w, shown in enumerate(case.shown)
        for s, a, n in zip(
            np.asarray(shown.state), np.asarray(shown.action), np.asarray(shown.length), strict=True
        )
    ]
    data = [jnp.asarray(np.stack(x)) for x in zip(*padded, strict=True)]
    networks = {name: Cloner(name == "recurrent") for name in ("memoryless", "recurrent")}
    learned = {name: clone(network, *data) for name, network in networks.items()}
    weights, begin = without_memory(case), time.process_time()
    found: dict[str, list[float]] = {
        x: [] for x in ("memoryless", "recurrent", "mlirl", "counting", "labels known")
    }
    counted = counting(case)
    for world, seen in zip(case.new, case.new_seen, strict=True):
        true = seen[:, list(case.truth)] > 0
        model = jl.product(grounding.with_labels(world, true, case.symbols), case.formula)
        view = local_view(seen)
        logits = networks["memoryless"].apply(learned["memoryless"], jnp.asarray(view)[None])[0]
        reward = entered(world, seen) @ weights
        policies = {
            "memoryless": jax.nn.softmax(logits.astype(float)),
            "mlirl": soft_value(world, jnp.asarray(reward), DISCOUNT).policy,
        }
        for name, policy in policies.items():
            wide = np.repeat(np.asarray(policy)[:, None], model.num_memory, axis=1)
            found[name].append(within(model, wide / wide.sum(-1, keepdims=True)))
        found["recurrent"].append(
            simulate(networks["recurrent"], learned["recurrent"], view, model, index)
        )
        own = jl.product(labelled(world, seen, counted, case.symbols), case.formula)
        for name, each in (("counting", own), ("labels known", model)):
            found[name].append(within_labels(case, world, each, true))
    return {
        "index": index,
        "shape": case.shape,
        "right": is_same(case, counted),
        **{name: float(np.mean(x)) for name, x in found.items()},
        "seconds": time.process_time() - begin,
    }


# --- automata -------------------------------------------------------------------------------------

ROOMS = "a a . . b b\na a . . b b\n. . . . . .\n. . . . . .\nd d . . c c\nd d . . c c"
# Formula, number of memory states, and map: rooms in cyclic order; one place before another, with
# others that do not matter; and a stack, in which tools are returned in the reverse order.
AUTOMATA = {
    "patrol": ("G F (a & F (b & F (c & F d)))", 4, ROOMS),
    "delivery": ("F (a & F b)", 3, "a . . . b\n. . c . .\n. . . . .\nd . . . ."),
    "stack": ("F (a & F (b & F (c & F (b & F a))))", 6, "a . . . b\n. . . . .\n. . c . ."),
}


def run_automaton(index: int) -> dict[str, Any]:
    """An automaton learned from 40 demonstrations; case ``10 i + seed`` of shape i."""
    shape, seed = list(AUTOMATA)[index // 10], index % 10
    formula, num_memory, text = AUTOMATA[shape]
    world = gridworld(text, slip=SLIP)
    letters = [frozenset(), *map(frozenset, world.propositions)]
    model = jl.product(world, jl.to_automaton(formula, letters=letters))
    runs = jl.models.rollout(
        model,
        _policy(model, SCALE, DISCOUNT),
        jax.random.key(seed),
        num_trajectories=40,
        num_steps=60,  # also after the task is completed, so that its end is visible
    )
    shown = jl.models.project_trajectories(model, runs)
    begin = time.process_time()
    found = grounding.learn_automaton(world, shown, num_memory, discount=DISCOUNT, num_starts=2)
    return {
        "index": index,
        "shape": shape,
        "right": bool(jl.automata.is_equivalent(found.automaton, model.automaton)),
        "states": len(found.automaton.delta),
        "seconds": time.process_time() - begin,
    }


PARTS: dict[str, tuple[Callable[[int], dict[str, Any]], int]] = {
    "tasks": (run_task, 100),
    "noisy": (run_noisy, 100),
    "baselines": (run_baselines, 40),
    "automata": (run_automaton, 30),
}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means of numbers, shares of truths, and the largest seconds, over rows and by shape."""
    found: dict[str, Any] = {"cases": len(rows)}
    for key in rows[0]:
        values = [row[key] for row in rows if isinstance(row.get(key), int | float)]
        if len(values) == len(rows) and key != "index":
            found[key] = round(float(np.mean(values)), 4)
        if key.endswith("seconds"):
            found[f"most {key}"] = round(max(values), 1)
    if "robust_true" in rows[0]:
        inside = [row for row in rows if row["robust_inside"]]
        holds = [row["robust_true"] >= row["robust_worst"] - 1e-6 for row in inside]
        found["robust_holds"] = f"{sum(holds)} of {len(inside)}"
    by_shape: dict[str, list[bool]] = {}
    for row in rows:
        by_shape.setdefault(row["shape"], []).append(bool(row["right"]))
    found["right by shape"] = {k: f"{sum(v)} of {len(v)}" for k, v in by_shape.items()}
    return found


def main() -> None:
    """Runs the chosen parts, or summarises the lines of earlier runs."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.grounding", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help=", ".join(PARTS))
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--step", type=int, default=1, help="of the numbers of cases")
    parser.add_argument("--last", type=int, help="number of cases; default all")
    parser.add_argument("--lines", nargs="*", default=[], help="files of lines to summarise")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    lines = [line for name in chosen.lines for line in Path(name).read_text().splitlines()]
    rows = [json.loads(line) for line in lines if '"index"' in line]
    for part in chosen.parts:
        run, number = PARTS[part]
        for index in range(chosen.first, min(number, chosen.last or number), chosen.step):
            rows.append({"part": part, **run(index)})
            print(json.dumps(rows[-1], default=float), flush=True)
    for part in PARTS:
        if own := [row for row in rows if row["part"] == part]:
            print(json.dumps({"part": part, **summary(own)}))


if __name__ == "__main__":
    main()
