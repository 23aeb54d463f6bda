"""Learned inside the actions that lose nothing, a policy does its task as well as any can.

Whatever was learned: from few steps, from demonstrations that err, with weights out of all measure.
What a policy attains is computed here anew, from the tables of world and automaton alone.
"""

import random
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.csgraph import connected_components, shortest_path

import jaxltl as jl
from jaxltl.algos import mlirl, todirl
from jaxltl.core.models.construct.lifting import allowed_steps
from tests import reference
from tests.reference_logic import random_formula
from tests.support import as_mdp

# One shape of worlds, automata and demonstrations, so that a program serves all of a kind.
S, A, K, Q, N, T = 12, 4, 3, 6, 5, 12
NAMES = ("a", "b")
LEGEND = {".": [], "a": ["a"], "b": ["b"], "c": ["a", "b"]}
SEEDS = 3
# Kind of task, which label a step reads, and the optimiser.
USUAL = (
    ("cosafe", "entry", "lbfgs"),
    ("safety", "exit", "adam"),
    ("buchi", "exit", "adam"),
    ("parity", "entry", "lbfgs"),
)
OTHER = (
    ("cosafe", "exit", "adam"),
    ("safety", "entry", "lbfgs"),
    ("buchi", "entry", "lbfgs"),
    ("parity", "exit", "adam"),
)


# --- random tasks ------------------------------------------------------------------------------


def random_text_map(rng):
    cells = rng.choice(list(LEGEND), size=(3, 4), p=[0.55, 0.2, 0.15, 0.1])
    text = "\n".join(" ".join(row) for row in cells)
    slip = rng.choice([0.1, 0.2, 0.5])
    absorbing = ["b"] if rng.random() < 0.4 else []
    world = jl.gridworld(text, slip=slip, legend=LEGEND, absorbing=absorbing)
    if rng.random() < 0.3:  # a step never slips
        probability = np.asarray(world.probability)
        kept = np.eye(K)[probability.argmax(-1)].astype(probability.dtype)
        world = world.replace(probability=np.where(probability > 0, kept, 0))
    return world


def random_world(rng):
    """A map or any model, of one shape, over a and b."""
    if rng.random() < 0.5:
        world = random_text_map(rng)
    else:
        world = as_mdp(
            reference.random_model(rng, S, A, K), label=rng.random((S, 2)) < 0.3, propositions=NAMES
        )
    starts = rng.random(S) < 0.5
    starts[rng.integers(S)] = True
    assert world.successor.shape == (S, A, K)
    return jax.tree.map(np.asarray, world.replace(initial=starts / starts.sum()))


def random_automaton(rng, kind):
    """That of a random formula."""
    dice = random.Random(int(rng.integers(2**31)))
    fragment = kind if kind in ("cosafe", "safety") else "all"
    while True:
        formula = random_formula(dice, dice.randint(4, 9), NAMES, fragment)
        found = jl.to_automaton(formula)
        same = (found.acceptance, found.propositions) == (kind, NAMES)
        if same and 2 <= len(found.delta) <= Q:
            return padded(found)


def padded(automaton):
    """The automaton with states that nothing reaches, Q of them in all."""
    more = Q - len(automaton.delta)
    own = np.arange(Q - more, Q)[:, None].repeat(automaton.delta.shape[1], 1)
    return replace(
        automaton,
        state_names=(),
        delta=np.concatenate([automaton.delta, own]).astype(np.int32),
        priority=np.pad(automaton.priority, ((0, more), (0, 0)), constant_values=1),
    )


def walk(rng, model, best, follow):
    """States and actions of a run that mostly, or seldom, does what the best policy does."""
    world, memory = model.mdp, np.asarray(model.next_memory)
    s = int(rng.choice(S, p=world.initial))
    q = int(np.asarray(model.initial_memory)[s])
    pairs = []
    for _ in range(rng.integers(1, T + 1)):
        a = int(best.policy[s, q])
        if rng.random() > follow:
            a = int(rng.choice(np.flatnonzero(world.available[s])))
        pairs.append((s, a))
        t = int(rng.choice(world.successor[s, a], p=world.probability[s, a]))
        q = int(memory[t if model.label_on == "entry" else s, q])
        s = t
    return pairs


def random_demonstrations(rng, model, found):
    """One to five runs, each with a step that is allowed; the first is repeated to make five."""
    rows, follow = [], rng.choice([0.3, 0.8, 1.0])
    wanted, allowed = rng.integers(1, N + 1), jl.with_allowed(model, found.allowed)
    while len(rows) < wanted:
        pairs = walk(rng, model, found.best, follow)
        try:
            allowed_steps(allowed, jl.make_trajectories(model.mdp, [pairs]))
        except ValueError:
            continue
        rows.append(pairs)
    rows += rows[:1] * (N - len(rows))
    shown = jl.make_trajectories(model.mdp, rows)
    wide = ((0, 0), (0, T - shown.state.shape[1]))
    return shown.replace(state=np.pad(shown.state, wide), action=np.pad(shown.action, wide))


def random_task(rng, kind, label_on, num_worlds=1):
    """Products of worlds with one automaton, with their masks; one in which the mask matters."""
    while True:
        automaton = random_automaton(rng, kind)
        models = [
            jl.product(random_world(rng), automaton, label_on=label_on) for _ in range(num_worlds)
        ]
        found = [jl.optimal_actions(m) for m in models]
        narrow = (np.asarray(models[0].available) & ~np.asarray(found[0].allowed)).any()
        open_ = (np.asarray(found[0].best.upper) > 0).any()
        if (narrow and open_) or rng.random() < 0.05:
            return models, found


# --- what a policy attains ---------------------------------------------------------------------


def bottoms(model, policy):
    """The chain of a policy on pairs of state and memory, and where it ends.

    In bottom components, each of which is accepting if the least priority read in it is even.

    Returns:
      The chain ``[N, N]``, accepting and other bottom components ``bool[N]``, and the pairs from
      which the others cannot be reached ``bool[S, Q]``.
    """
    world, task = jax.tree.map(np.asarray, (model.mdp, model.automaton))
    letter, policy = np.asarray(model.letter), np.asarray(policy)
    shape = model.state_shape
    size = shape[0] * shape[1]
    chain = np.zeros(shape * 2, np.longdouble)
    step, read = np.zeros(shape * 2, bool), np.full(shape * 2, 99)
    for s, q, a, k in np.ndindex(*policy.shape, world.successor.shape[-1]):
        if policy[s, q, a] > 0 and world.probability[s, a, k] > 0:
            assert world.available[s, a]
            t = world.successor[s, a, k]
            shown = letter[t] if model.label_on == "entry" else letter[s]
            place = s, q, t, task.delta[q, shown]
            chain[place] += np.longdouble(policy[s, q, a]) * world.probability[s, a, k]
            step[place], read[place] = True, task.priority[q, shown]
    chain, step, read = (x.reshape(size, size) for x in (chain, step, read))
    assert step.any(1).all() and np.abs(chain.sum(1) - 1).max() < 1e-6
    links = scipy.sparse.csr_array(step)
    count, component = connected_components(links, connection="strong")
    left = (step & (component[:, None] != component)).any(1)
    good, bad = np.zeros(size, bool), np.zeros(size, bool)
    for c in range(count):
        here = component == c
        if not left[here].any():
            accepted = read[step & here[:, None]].min() % 2 == 0
            good, bad = (good | here, bad) if accepted else (good, bad | here)
    reached = np.isfinite(shortest_path(links, unweighted=True))
    return chain, good, bad, ~reached[:, bad].any(1).reshape(shape)


def evaluate(model, policy):
    """The probability of the task ``[S, Q]``, and where it is 1 for sure."""
    chain, good, bad, sure = bottoms(model, policy)
    return absorbed(chain, good, bad).reshape(sure.shape).astype(float), sure


def absorbed(chain, good, bad):
    """The probability to end in `good`, by eliminating states without a subtraction."""
    inner = np.flatnonzero(~good & ~bad)
    rows = np.column_stack(
        [chain[np.ix_(inner, inner)], chain[inner][:, good].sum(1), chain[inner][:, bad].sum(1)]
    )
    for n in range(len(inner)):
        rows[n, : n + 1] = 0  # what goes back has been led on
        total = rows[n].sum()
        assert total > 0
        rows[n] /= total
        rows[n + 1 :] += rows[n + 1 :, n, None] * rows[n]
    value = np.zeros(len(inner) + 2, np.longdouble)
    value[-2] = 1
    for n in reversed(range(len(inner))):
        value[n] = rows[n] @ value
    whole = good.astype(np.longdouble)
    whole[inner] = value[:-2]
    return whole


def test_what_is_attained_by_hand():
    """From the first state a step goes to a goal or a trap, or, but for 3e-200, nowhere."""
    successor = np.arange(S)[:, None, None].repeat(A, 1).repeat(K, 2)
    probability = np.zeros((S, A, K)) + np.array([1, 0, 0])
    successor[0, 0], probability[0, 0] = [0, 1, 2], [1, 1e-200, 2e-200]
    world = jl.make_mdp(
        successor,
        probability,
        initial=np.eye(S)[0],
        label=np.eye(S)[1, :, None] > 0,
        propositions=["a"],
    )
    model = jl.product(world, padded(jl.to_automaton("F a")))
    value, sure = evaluate(model, np.broadcast_to(np.eye(A)[0], (S, Q, A)))
    start, done = (int(model.initial_memory[s]) for s in (0, 1))
    assert value[0, start] == pytest.approx(1 / 3, rel=1e-15)
    np.testing.assert_array_equal(value[1:, start], np.arange(1, S) == 1)
    np.testing.assert_array_equal(sure[:, start], np.arange(S) == 1)
    assert sure[:, done].all() and (value[:, done] == 1).all()


def check_policies(model, found, policies):
    """Each is optimal from everywhere; surely so, where the best is."""
    best = found.best
    choice = np.eye(A)[np.asarray(best.policy)]
    optimum, surely = evaluate(model, choice)
    np.testing.assert_allclose(best.value, optimum, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(best.lower) == 1, surely)
    allowed = np.asarray(found.allowed)
    for policy in np.asarray(policies):
        assert ((policy > 0) == allowed).all(), "every action of the mask, and no other"
        value, sure = evaluate(model, policy)
        np.testing.assert_array_equal(sure, surely)
        np.testing.assert_allclose(value, optimum, rtol=1e-9, atol=0)


# --- learners ----------------------------------------------------------------------------------


def shared(model):
    """The product as learners read it, who never look at the acceptance; one program for all."""
    return model.replace(automaton=replace(model.automaton, acceptance="parity"))


@partial(jax.jit, static_argnames="steps")
def mlirl_policies(problem, hparams, steps=10):
    """Of every seed, and of weights out of all measure: ``[SEEDS + 1, S, Q, A]``."""

    def one(key):
        state, _ = mlirl.train(key, problem, hparams, num_steps=steps)
        return state.parameters

    parameters = jax.vmap(one)(jax.random.split(jax.random.key(0), SEEDS))
    wild = jax.random.normal(jax.random.key(1), parameters[:1].shape) * 300
    rows = jax.numpy.concatenate([parameters, wild])
    return jax.lax.map(lambda x: mlirl.solve(x, problem, hparams).policy, rows)


def check_mlirl(rng, kind, label_on, optimizer):
    (model,), (found,) = random_task(rng, kind, label_on)
    shown = random_demonstrations(rng, model, found)
    progress = {"progress": ()} if kind == "cosafe" else {}  # which is static
    features = mlirl.task_features(model, shown, best=found.best, **progress)
    assert features.names[-1] == ("demonstrated" if kind == "safety" else "nearer")
    columns = np.pad(features.values, ((0, 0),) * 3 + ((0, 5 - len(features.names)),))
    problem = mlirl.make_problem(model, columns, shown, allowed=found.allowed)
    problem = problem.replace(model=shared(problem.model))
    assert (np.asarray(problem.counts) * ~np.asarray(found.allowed)).sum() == 0
    hparams = mlirl.Hparams(discount=0.9, optimizer=optimizer)
    check_policies(model, found, mlirl_policies(problem, hparams))
    return model, found


@pytest.mark.few(1)
@pytest.mark.parametrize("setting", USUAL, ids="-".join)
def test_mlirl_inside_the_mask_attains_the_optimum(setting):
    rng = np.random.default_rng(USUAL.index(setting))
    for _ in range(3):
        check_mlirl(rng, *setting)


@pytest.mark.exhaustive
@pytest.mark.parametrize("setting", USUAL + OTHER, ids="-".join)
def test_mlirl_inside_the_mask_attains_the_optimum_of_many_tasks(setting):
    rng = np.random.default_rng([1, (USUAL + OTHER).index(setting)])
    cases = [check_mlirl(rng, *setting) for _ in range(25)]
    best = [np.asarray(found.best.value) for _, found in cases]
    assert sum(((x > 0) & (x < 1)).any() for x in best) > 3
    assert sum((x == 1).any() for x in best) > 3


NETWORK = todirl.RewardNetwork((4,))


@jax.jit
def todirl_policies(problem, hparams, model, observation, allowed):
    """Of every seed, in the worlds that it learned in and in another."""

    def one(key):
        state, _ = todirl.train(key, problem, hparams, num_steps=10)
        other = todirl.plan(
            NETWORK, state.best.parameters, model, observation, hparams, allowed=allowed
        )
        return todirl.policy(state, problem, hparams), other.policy

    return jax.vmap(one)(jax.random.split(jax.random.key(0), SEEDS))


def check_todirl(rng, kind, label_on, num_worlds):
    models, found = random_task(rng, kind, label_on, num_worlds + 1)
    seen = [np.eye(4)[np.asarray(m.letter)] for m in models]
    shown = [random_demonstrations(rng, m, f) for m, f in zip(models, found, strict=True)]
    problem = todirl.make_problem(
        models[:-1], seen[:-1], shown[:-1], network=NETWORK, allowed=[f.allowed for f in found[:-1]]
    )
    # Predecessors have another shape in every world.
    problem = problem.replace(model=shared(problem.model), predecessors=None)
    hparams = todirl.Hparams(discount=0.9, learning_rate=0.1)
    inside, other = todirl_policies(
        problem, hparams, shared(models[-1]), seen[-1], found[-1].allowed
    )
    for w in range(num_worlds):
        check_policies(models[w], found[w], inside[:, w])
    check_policies(models[-1], found[-1], other)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind, _, _ in USUAL])
def test_todirl_inside_the_mask_attains_the_optimum_in_worlds_never_seen_too(kind):
    """Of all kinds with the label that one program reads; the others below."""
    rng = np.random.default_rng([2, len(kind)])
    check_todirl(rng, kind, "exit", num_worlds=2)


@pytest.mark.exhaustive
@pytest.mark.parametrize("setting", USUAL + OTHER, ids="-".join)
def test_todirl_inside_the_mask_attains_the_optimum_of_many_tasks(setting):
    rng = np.random.default_rng([3, (USUAL + OTHER).index(setting)])
    num_worlds = 1 + (setting in USUAL)
    for _ in range(25):
        check_todirl(rng, *setting[:2], num_worlds)
