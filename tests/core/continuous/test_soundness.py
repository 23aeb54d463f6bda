"""Certificates against simulated runs of random worlds, networks and formulas."""

import random
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.special import ndtr, ndtri

from jaxltl.core.automata import to_automaton
from jaxltl.core.automata.runs import Verdict, lasso_verdicts
from jaxltl.core.automata.runs import verdicts as verdicts_of
from jaxltl.core.continuous import (
    Dynamics,
    box,
    certify_policy,
    counterexample,
    gaussian,
    half_space,
    make_dynamics,
    shield_dynamics,
    synthesize_policy,
    triangular,
    truncated_gaussian,
    uniform,
)
from jaxltl.core.continuous.abstraction import Successors, winning_cells
from jaxltl.core.continuous.task_product import task_product
from jaxltl.core.environments.episodes import make_agent, run_episode
from jaxltl.core.environments.task_environment import stack_tasks, task_environment
from jaxltl.core.logic.ltl import Formula, parse_ltl
from tests.reference_logic import random_formula
from tests.support import seeds

MAX_PROGRAMS = 450  # that the default tests compile at most

LEVEL = 1e-6


def no_action(x):
    return jnp.zeros(0, x.dtype)


def interval(hits, runs, level=LEVEL):
    """Clopper-Pearson interval."""
    low = scipy.stats.beta.ppf(level / 2, hits, runs - hits + 1) if hits else 0.0
    high = scipy.stats.beta.isf(level / 2, hits + 1, runs - hits) if hits < runs else 1.0
    return low, high


# --- runs -----------------------------------------------------------------------------------------


def labels_of_runs(world, policy, starts, num_steps, seed=0, disturbance=None):
    """Labels ``bool[T + 1, N, P]`` and domain membership ``bool[T + 1, N]``."""
    bounds = world.actions if isinstance(world.actions, tuple) else None

    def step(carry, key):
        x, alive = carry
        u = jax.vmap(policy)(x)
        u = u if bounds is None else jnp.clip(u, *map(jnp.asarray, bounds))
        keys = jax.random.split(key, len(x))
        after = jax.vmap(lambda k, x, u: world.next_state(k, x, u, disturbance))(keys, x, u)
        after = jnp.where(alive[:, None], after, x)  # the last state outside is kept
        return (after, alive & jax.vmap(world.inside)(after)), (jax.vmap(world.label)(x), alive)

    keys = jax.random.split(jax.random.key(seed), num_steps + 1)
    alive = jnp.ones(len(starts), bool)
    _, found = jax.jit(lambda x: jax.lax.scan(step, (x, alive), keys))(jnp.asarray(starts))
    return tuple(np.asarray(x) for x in found)


def verdicts(formula, world, labels, alive):
    """Runs that surely satisfy and surely violate a formula, after their finite number of steps.

    The reference reads all letters of the formula: leaving violates unless every continuation of the
    labels inside satisfies it, whatever the labels of the domain are.
    """
    automaton = to_automaton(formula)
    told, forever = verdicts_of(automaton), lasso_verdicts(automaton)
    columns = [list(world.propositions).index(p) for p in automaton.propositions]
    weights = 2 ** np.arange(len(columns))
    letter_of = np.argsort(np.asarray(automaton.letters, int) @ weights)
    q = np.full(labels.shape[1], int(automaton.initial))
    lost = np.zeros(labels.shape[1], bool)
    for label, inside in zip(labels, alive, strict=True):
        letter = letter_of[label[:, columns].astype(int) @ weights]
        if world.outside == "violates":
            lost |= ~inside & (told[q] != Verdict.SATISFIED)
        q = np.where(lost, q, automaton.delta[q, letter])
    found = told[q]
    if world.outside == "out":  # its letter repeats for ever
        found = np.where(alive[-1], found, forever[q, letter])
    return (found == Verdict.SATISFIED) & ~lost, (found == Verdict.VIOLATED) | lost


def check(proof, formula, world, policy, start, runs, num_steps, **options):
    """Raises AssertionError if simulated frequencies from a state contradict its bounds."""
    starts = np.tile(np.asarray(start, np.float32), (runs, 1))
    good, bad = verdicts(
        formula, world, *labels_of_runs(world, policy, starts, num_steps, **options)
    )
    lower, upper = proof.at(np.asarray(starts[0], np.float64))
    least, most = interval(good.sum(), runs)[0], 1 - interval(bad.sum(), runs)[0]
    assert least <= upper and lower <= most, (formula, start, (lower, upper), (least, most))
    return float(upper - lower)


# --- couplings of coordinates ---------------------------------------------------------------------

DIFFER = box([[-1, 0], [0, -1]], [[0, 1], [1, 0]])
COUPLED = {
    "the first one has both": lambda x, u, w: jnp.stack([0.3 * w[0] + 0.3 * w[1], 0.3 * w[0]]),
    "the second one has both": lambda x, u, w: jnp.stack([0.3 * w[0], 0.3 * w[0] - 0.3 * w[1]]),
    "both have both": lambda x, u, w: jnp.stack([0.3 * w[0] + 0.1 * w[1], 0.1 * w[0] + 0.3 * w[1]]),
    "one noise": lambda x, u, w: 0.5 * jnp.stack([w[0], -w[0]]),
}


@pytest.mark.parametrize("formula", ["X d", "X !d"])
@pytest.mark.parametrize("name", COUPLED)
def test_coordinates_with_common_noise(name, formula):
    step = COUPLED[name]
    world = make_dynamics(
        lambda x, u, w: step(x, u, w) + 0 * x,
        domain=([-1, -1], [1, 1]),
        noise=[uniform(-1, 1)] * 2,
        labels={"d": DIFFER},
        initial=([-0.1, -0.1], [0.1, 0.1]),
    )
    proof = certify_policy(world, no_action, formula, cells=[20, 20], max_cells=400)
    check(proof, formula, world, no_action, [0.03, 0.05], 20_000, 1)


def test_a_triangular_coupling_keeps_probabilities():
    """The coordinate with both noises is bounded given the other one, in either order of axes."""
    for swap in (False, True):
        step = lambda x, u, w: (0.3 * w + 0.02 * jnp.stack([w[1], 0 * w[0]]))[:: -1 if swap else 1]  # noqa: B023, E731
        world = make_dynamics(
            step,
            domain=([-1, -1], [1, 1]),
            noise=[uniform(-1, 1)] * 2,
            labels={"d": DIFFER},
            initial=([-0.1, -0.1], [0.1, 0.1]),
        )
        proof = certify_policy(world, no_action, "X d", cells=[20, 20], max_cells=400)
        lower, upper = proof.initial_bounds
        assert 0.4 < lower <= 0.5 <= upper < 0.6
        check(proof, "X d", world, no_action, [0.03, 0.05], 20_000, 1)


GAINS = {
    "proportional": lambda x, w: (1 + x) * 0.3 * w,
    "a tangent": lambda x, w: 0.4 * jnp.tanh(2 * w),
    "clipped": lambda x, w: jnp.clip(w, -0.3, 0.15),
    "a jump": lambda x, w: jnp.where(w > 0.2, 0.5, -0.1) + 0.01 * w,
    "a sign": lambda x, w: 0.15 * jnp.sign(w) + 0.1 * w,
    "a square": lambda x, w: w * w - 0.1,
    "negative": lambda x, w: 0.1 - 0.25 * w,
}


@pytest.mark.filterwarnings("ignore:the step may jump")
@pytest.mark.parametrize(
    ("name", "noise"),
    [
        pytest.param(
            name,
            noise,
            marks=pytest.mark.exhaustive if i % 2 != j else pytest.mark.slow if i > 2 else (),
        )
        for i, name in enumerate(GAINS)
        for j, noise in enumerate((uniform(-1, 1), truncated_gaussian(0.5, -1.0, 0.8, 0.1)))
    ],
)
def test_noise_that_is_not_additive(name, noise):
    gain = GAINS[name]
    world = make_dynamics(
        lambda x, u, w: gain(x, w) + 0.1 * x,
        domain=([-1.0], [1.0]),
        noise=noise,
        labels={"d": ([-0.2], [0.2])},
        initial=([-0.9], [0.9]),
    )
    for formula in ("X d", "X !d"):
        proof = certify_policy(world, no_action, formula, cells=[10], max_cells=40)
        for start in (-0.35, 0.05, 0.75):
            check(proof, formula, world, no_action, [start], 10_000, 1)


def test_reflected_noise_with_a_mean():
    world = make_dynamics(
        lambda x, u, w: 0.5 * x - w,
        domain=([-2.0], [2.0]),
        noise=gaussian(0.3, mean=0.4),
        labels={"d": ([-0.6], [-0.1])},
        initial=([-0.9], [0.9]),
    )
    proof = certify_policy(world, no_action, "X d", cells=[80])
    for start in (-0.5, 0.0, 0.5):
        middle = 0.5 * start - 0.4
        value = np.diff(scipy.stats.norm.cdf([-0.6, -0.1], middle, 0.3))[0]
        lower, upper = proof.at([start + 0.01])
        assert lower - 0.02 <= value <= upper + 0.02 and upper - lower < 0.05


# --- random worlds --------------------------------------------------------------------------------

ENDS = ndtr(np.array([-0.4, 0.2]) / 0.3)
# Distributions, and how NumPy draws them.
NOISES = (
    (uniform(-0.3, 0.3), lambda draw, n: draw.uniform(-0.3, 0.3, n)),
    (triangular(-0.5, 0.5), lambda draw, n: draw.triangular(-0.5, 0, 0.5, n)),
    (gaussian(0.15, 0.05), lambda draw, n: draw.normal(0.05, 0.15, n)),
    (truncated_gaussian(0.3, -0.4, 0.2), lambda draw, n: 0.3 * ndtri(draw.uniform(*ENDS, n))),
)
OUTSIDE = ("violates", "clip", "out")
CELLS = {1: [100], 2: [24, 24], 3: [10, 10, 10]}
FORMULAS = ("F a", "!b U a", "X (a | b)", "X (!a & X !b)", "G !a", "F (a & X b)", "F a & G !b",
            "X G (a -> X !a)", "F G a | F b", "G F a -> F b")  # fmt: skip


@dataclass
class Triple:
    """Dynamics, a network and a formula, with a NumPy twin of both functions for simulation."""

    world: Dynamics
    policy: object
    formula: Formula
    draws: list
    step: object

    def simulate(self, draw, x, num_steps):
        """Labels ``bool[T + 1, N, P]`` and membership ``bool[T + 1, N]``, states outside kept."""
        (low, high), alive, found = self.world.domain, np.ones(len(x), bool), []
        for _ in range(num_steps + 1):
            label = [self.world.labels[p].contains(x) & alive for p in self.world.labels]
            if self.world.outside == "out":
                label.append(~alive)
            found.append((np.stack(label, -1), alive))
            w = [one(draw, len(x)) for one in self.draws]
            if self.world.disturbance is not None:  # an adversary with one of three habits
                ends = self.world.disturbance
                w.append(np.full(len(x), ends[draw.integers(2)][0])
                         if draw.random() < 0.7 else draw.uniform(*ends, len(x)))  # fmt: skip
            u = np.clip(self.policy(x), -1, 1)
            after = np.where(alive[:, None], self.step(x, u, np.stack(w, -1)), x)
            x = np.clip(after, low, high) if self.world.outside == "clip" else after
            alive = alive & ((x >= low) & (x <= high)).all(-1)
        return tuple(np.stack(part) for part in zip(*found, strict=True))


def random_triple(seed):
    """A random world in one to three dimensions with a network and a formula."""
    draw, n = np.random.default_rng(seed), 1 + seed % 3
    a, b, c = (draw.normal(size=(n, n)) * s / np.sqrt(n) for s in (0.7, 0.5, 0.3))
    kernels = draw.normal(size=(n, 6)), draw.normal(size=(6, n)) / 2
    bias, offset = draw.normal(size=6), draw.uniform(-0.2, 0.2, n)
    kind, bent = draw.integers(4), draw.random() < 0.5
    mixing = np.eye(n) if kind else draw.normal(size=(n, n)) / np.sqrt(n)
    adverse = draw.random() < 0.3

    def policy(x):
        xp = np if isinstance(x, np.ndarray) else jnp
        hidden = x @ kernels[0] + bias
        return (xp.tanh(hidden) if bent else xp.maximum(hidden, 0)) @ kernels[1]

    def step(x, u, w):
        xp = np if isinstance(x, np.ndarray) else jnp
        gain = 1 + 0.5 * xp.sin(x) if kind == 1 else 1.0
        noise = w[..., :n] @ mixing.T
        noise = xp.tanh(2 * noise) / 2 if kind == 2 else noise
        push = 0.2 * w[..., n:] * x if adverse else 0.0
        return x @ a.T + u @ b.T + xp.sin(3 * x) @ c.T + offset + gain * noise + push

    kinds = [NOISES[i] for i in draw.integers(len(NOISES), size=n)]
    corner = draw.uniform(-0.8, 0.2, (2, n))
    normal = draw.normal(size=n)
    world = make_dynamics(
        step,
        domain=(np.full(n, -1.0), np.full(n, 1.0)),
        noise=[one for one, _ in kinds],
        disturbance=([-0.5], [1.0]) if adverse else None,
        actions=(np.full(n, -1.0), np.full(n, 1.0)),
        labels={
            "a": box(corner[0], corner[0] + draw.uniform(0.4, 0.8, n)),
            "b": box(corner[1], corner[1] + draw.uniform(0.4, 0.8, n))
            if draw.random() < 0.7 else half_space(normal, 0.3 * np.abs(normal).sum()),
        },
        outside=OUTSIDE[draw.integers(3)],
    )  # fmt: skip
    chooser = random.Random(seed)
    formula = parse_ltl(chooser.choice(FORMULAS))
    while seed % 2 or not formula.propositions:
        formula = random_formula(chooser, chooser.randint(4, 7), world.propositions)
        if formula.propositions and any(x in str(formula) for x in "XFGUWRM"):
            break
    return Triple(world, policy, formula, [draw_one for _, draw_one in kinds], step)


def check_triples(seeds, runs, num_steps=15, num_starts=10):
    """Simulated frequencies from random states meet the bounds; the shares of tight bounds and of
    bounds that are neither 0 nor 1."""
    widths, inner = [], 0
    for seed in seeds:
        triple, draw = random_triple(seed), np.random.default_rng(seed + 10**6)
        cells = CELLS[triple.world.num_states]
        proof = certify_policy(
            triple.world, triple.policy, triple.formula, cells=cells, tolerance=0.02,
            max_cells=3000, max_sweeps=30,
        )  # fmt: skip
        starts = draw.uniform(-1, 1, (num_starts, triple.world.num_states))
        lower, upper = proof.at(starts)
        x = np.repeat(starts, runs // num_starts, 0)
        good, bad = verdicts(triple.formula, triple.world, *triple.simulate(draw, x, num_steps))
        good, bad = (y.reshape(num_starts, -1) for y in (good, bad))
        for i in range(num_starts):
            least, most = (interval(y[i].sum(), y.shape[1])[0] for y in (good, bad))
            found = seed, str(triple.formula), starts[i], (lower[i], upper[i]), (least, 1 - most)
            assert least <= upper[i] and lower[i] <= 1 - most, found
        widths.extend(upper - lower)
        inner += ((lower > 0) & (lower < 1) | (upper > 0) & (upper < 1)).sum()
    return (np.array(widths) < 0.1).mean(), inner / len(widths)


def test_simulated_runs_of_random_worlds_lie_inside():
    tight, _ = check_triples(range(3, 9), 2000)
    assert tight > 0.5  # the bounds say something


# --- leaving the domain ---------------------------------------------------------------------------

# Of each class; the labels of some worlds satisfy or violate some of them whatever the run does.
TASKS = (
    "G !u", "G (u -> m)", "G (m | !u)", "X !u", "X X !m",  # safety
    "F m", "!u U m", "F (m & X !m)", "F (u & !m)", "X (m | !m & X !u)",  # co-safety
    "G F m", "G F !u", "G F (u & !m)", "F G m", "F G !u",  # recurrence, persistence
    "G !u | F m", "G (u -> m) & F m", "G (u -> m) | F u", "G F m -> G F u", "F G !u | F m",
    "G F m & G !u", "(G F m | F G !m) & F u", "G F (u & !m) | F m", "!(G F m & F u) | X !u",
)  # fmt: skip
REGIONS = {  # of u and m: one inside the other, apart, across, all of the domain
    "nested": ((-0.4, -0.1), (-0.5, 0.3)),
    "apart": ((-0.6, -0.2), (0.1, 0.5)),
    "across": ((-0.3, 0.3), (0.1, 0.6)),
    "everywhere": ((-0.5, -0.2), (-1.0, 1.0)),
}
# A contraction that noise of the first kinds may not leave, and one that it soon does.
MOTIONS = {"stays": (0.5, 0.05), "leaves": (0.9, 0.1)}


def leaving_triple(n, motion, regions, noise, outside):
    """A world in n dimensions, without control, whose runs stay or leave."""
    gain, drift = MOTIONS[motion]
    distribution, draw_noise = NOISES[noise]
    ends = [np.array([[end, *(-0.7, 0.8)[i : i + n - 1]] for i, end in enumerate(x)])
            for x in REGIONS[regions]]  # fmt: skip
    if regions == "everywhere":
        ends[1] = np.array([[-1.0] * n, [1.0] * n])
    world = make_dynamics(
        lambda x, u, w: gain * x + drift + w,
        domain=(np.full(n, -1.0), np.full(n, 1.0)),
        noise=[distribution] * n,
        labels={"u": box(*ends[0]), "m": box(*ends[1])},
        outside=outside,
    )
    step = lambda x, u, w: gain * x + drift + w  # noqa: E731
    return Triple(world, lambda x: np.zeros(len(x)), parse_ltl("F m"), [draw_noise] * n, step)


def check_leaving(case, formulas, runs=1500, num_steps=25):
    """Bounds from random states against simulated runs; the number of bounds that are not trivial."""
    draw, informative = np.random.default_rng(7), 0  # starts are in all of the domain
    triple = leaving_triple(*case)
    starts = draw.uniform(-1, 1, (6, case[0]))
    found = triple.simulate(draw, np.repeat(starts, runs, 0), num_steps)
    cells = {1: [40], 2: [12, 12]}[case[0]]
    options = {"cells": cells, "max_cells": 400, "tolerance": 0.02, "max_sweeps": 200}
    for formula in formulas:
        proof = certify_policy(triple.world, no_action, formula, **options)
        good, bad = (x.reshape(len(starts), -1) for x in verdicts(formula, triple.world, *found))
        lower, upper = proof.at(starts)
        for i in range(len(starts)):
            least, most = (interval(x[i].sum(), runs)[0] for x in (good, bad))
            says = case, str(formula), starts[i], (lower[i], upper[i]), (least, 1 - most)
            assert least <= upper[i] and lower[i] <= 1 - most, says
        informative += (upper - lower < 0.3).sum()
    return informative / len(starts) / len(formulas)


def leaving_cases():
    """All worlds; by default some that have each value of each part."""
    for i, motion in enumerate(MOTIONS):
        for j, regions in enumerate(REGIONS):
            for k, outside in enumerate(OUTSIDE):
                yield 1 + (i + j + k) % 2, motion, regions, (i + 2 * j + k) % 4, outside


RARE = (pytest.mark.slow, pytest.mark.exhaustive, pytest.mark.exhaustive)


FEW = (7, 12, 14)  # by default a third of the tasks each


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=[] if i in FEW else RARE[i % 3])
        for i, case in enumerate(leaving_cases())
    ],
    ids=str,
)
def test_leaving_the_domain_means_what_outside_says(case):
    number = list(leaving_cases()).index(case)
    tasks = TASKS[FEW.index(number) :: len(FEW)] if number in FEW else TASKS
    assert check_leaving(case, tasks) > 0.4


@pytest.mark.parametrize("seed", seeds(0, 3, 24))
def test_random_formulas_where_runs_leave_the_domain(seed):
    chooser = random.Random(seed)
    case = list(leaving_cases())[seed]
    names = ["u", "m", *(["out"] if case[-1] == "out" else [])]
    formulas = [random_formula(chooser, chooser.randint(3, 7), names) for _ in range(20)]
    check_leaving(case, [f for f in formulas if f.propositions])


def test_episodes_that_leave_the_domain_have_the_verdicts_of_the_proofs():
    """The label outside satisfies no formula, such as `X !u`, that was not satisfied before."""
    world = leaving_triple(1, "leaves", "nested", 2, "violates").world
    open_tasks = [f for f in TASKS if set(verdicts_of(to_automaton(f))[:1]) == {0}]
    tasks = stack_tasks([task_environment(world, f) for f in open_tasks])
    agent = make_agent(lambda seen, key: jnp.int32(0))
    keys = jax.random.split(jax.random.key(0), 200)
    run = jax.vmap(lambda e: jax.vmap(lambda k: run_episode(k, e, agent, num_steps=30))(keys))
    found = jax.device_get(jax.jit(run)(tasks))
    seen = set()
    for formula, states, told, valid in zip(
        open_tasks, found.world.world, found.world.verdict, found.valid, strict=True
    ):
        steps, row = valid.sum(-1), np.arange(len(valid))
        at = np.minimum(np.arange(states.shape[1])[:, None], steps)  # the last state is kept
        x, last = states[row, at], told[row, steps]
        inside = (np.abs(x) <= 1).all(-1)
        label = np.stack([world.labels[p].contains(x) & inside for p in world.labels], -1)
        good, bad = verdicts(formula, world, label, inside)
        assert (good == (last == 1)).all() and (bad == (last == 2)).all(), formula
        seen |= {(formula, *pair) for pair in zip(inside[-1].tolist(), last.tolist(), strict=True)}
    assert len(seen) > len(open_tasks)


def test_a_shield_keeps_learners_inside_where_labels_satisfy_the_formula():
    world = make_dynamics(
        lambda x, u, w: x + u + w,
        domain=([-1.0], [1.0]),
        noise=uniform(-0.1, 0.1),
        actions=([-0.4], [0.4]),
        labels={"u": ([-0.3], [0.1]), "m": ([-0.5], [0.2])},
        initial=([-0.5], [0.5]),
    )
    formula = "G (u -> m)"
    found = synthesize_policy(world, formula, np.array([[-0.4], [0.4]]), cells=[40])
    assert found.certificate.initial_bounds == (1, 1)
    low, high = found.certificate.grid.boxes()
    reach = [
        x[:, None, 0] + u for x, u in zip((low, high), ([-0.5, 0.3], [-0.3, 0.5]), strict=True)
    ]
    leaves = (reach[0] < -1) | (reach[1] > 1)
    assert leaves.any() and not (found.allowed & leaves).any()
    shielded = task_environment(shield_dynamics(found), formula)
    agent = make_agent(lambda seen, key: jnp.full(1, 0.4))
    run = run_episode(jax.random.key(0), shielded, agent, num_steps=30)
    assert int(np.asarray(run.world.verdict)[-1]) != Verdict.VIOLATED
    proof = certify_policy(world, lambda x: x * 0 + 0.4, formula, cells=[40])
    violating = counterexample(jax.random.key(0), world, lambda x: x * 0 + 0.4, formula, proof)
    assert proof.initial_bounds == (0, 0) and violating[-1, 0] > 1 > violating[-2, 0]


# --- winning strategies ---------------------------------------------------------------------------


def random_game(draw, formula, num_cells=12, num_actions=2):
    """A product and boxes of successors on a line of cells."""
    certain = draw.random((num_cells, 2)) < 0.4
    possible = certain | (draw.random((num_cells, 2)) < 0.1)
    task = task_product(formula, ["a", "b"], certain, possible, None)
    first = draw.integers(0, num_cells, (num_cells * num_actions, 1))
    stop = np.minimum(first + draw.integers(1, 4, first.shape), num_cells)
    inner = draw.integers(first, stop)
    outside = draw.random(len(first)) < 0.05
    cells = np.arange(num_cells)
    certain_box = inner, inner + 1, outside
    return task, Successors(cells, num_actions, first, stop, outside, certain_box, (num_cells,))


def wins(task, rows, action):
    """States ``bool[Q, C]`` from which a strategy wins surely: no reachable odd cycle or exit."""
    num_memory, num_cells = action.shape
    edges, bad = {}, set()
    for q in range(num_memory):
        for c in range(num_cells):
            row = c * rows.num_actions + action[q, c]
            to = range(int(rows.start[row, 0]), int(rows.stop[row, 0]))
            edges[q, c] = [
                (r, d) for d in to for r in np.flatnonzero(task.moves[q, task.label_class[d]])
            ]
            if rows.outside[row] and not task.outside[q]:
                bad.add((q, c))
    edges |= {s: [s] for s in edges if task.decided[s[0]] >= 0}
    bad = {s for s in bad if task.decided[s[0]] < 0} | {s for s in edges if task.decided[s[0]] == 0}
    for p in sorted({int(x) for x in task.priority if x % 2}):
        allowed = {s for s in edges if task.priority[s[0]] >= p and task.decided[s[0]] < 0}
        for s in allowed:
            if task.priority[s[0]] == p and s in closure(edges, edges[s], allowed):
                bad.add(s)
    found = np.zeros(action.shape, bool)
    for q, c in edges:
        found[q, c] = not (closure(edges, [(q, c)], set(edges)) & bad)
    return found


def closure(edges, begin, allowed):
    """States that are reachable through allowed ones."""
    todo = [s for s in begin if s in allowed]
    found = set(todo)
    while todo:
        new = [t for t in edges[todo.pop()] if t in allowed and t not in found]
        found |= set(new)
        todo += new
    return found


GAMES = ["F G a", "G F a & G F b", "F G a | G F b", "F G a & G F b",
         "(F G a | G F b) & (F G b | G F a)"]  # fmt: skip


@pytest.mark.parametrize("formula", GAMES)
def test_winning_strategies_win(formula):
    """Against every path of the graph of a strategy, enumerated by reachability."""
    draw, won = np.random.default_rng(len(formula)), 0
    for _ in range(12):
        task, rows = random_game(draw, formula)
        rows, none = replace(rows, certain=None), np.zeros((task.num_memory, 12), bool)
        found, action = winning_cells(task, rows, none)
        lost, _ = winning_cells(task.complement(), rows, none, False)
        assert not (found & lost).any()
        assert not (found & ~wins(task, rows, action)).any()
        won += (found & (task.decided < 0)[:, None]).sum()
    assert won > 20


@pytest.mark.parametrize("formula", GAMES)
def test_winning_states_of_a_fixed_policy_are_exact(formula):
    """Without choices, a state wins if and only if no losing path begins there."""
    draw = np.random.default_rng(len(formula))
    for _ in range(12):
        task, rows = random_game(draw, formula, num_actions=1)
        rows, none = replace(rows, certain=None), np.zeros((task.num_memory, 12), bool)
        found, _ = winning_cells(task, rows, none)
        exact = wins(task, rows, none.astype(int))
        assert (found == exact)[task.decided < 0].all()
