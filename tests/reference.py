"""Slow and obvious references, which share no code with the library.

Quantities that solve linear equations are computed in exact rational arithmetic
(``fractions.Fraction``), those with exponentials by long iteration in extended precision, and
those about supports by brute force. Random models have dyadic numbers, so floats are exact.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

FRACTION = np.vectorize(Fraction, otypes=[object])


@dataclass(frozen=True)
class Model:
    """An explicit model: ``successor int[S, A, K]``, ``probability float[S, A, K]``, ..."""

    successor: np.ndarray
    probability: np.ndarray
    available: np.ndarray
    initial: np.ndarray

    @property
    def num_states(self) -> int:
        return self.available.shape[0]

    @property
    def num_actions(self) -> int:
        return self.available.shape[1]

    @property
    def transition(self) -> np.ndarray:
        """``float[S, A, S]``, by loops."""
        dense = np.zeros((*self.available.shape, self.num_states), self.probability.dtype)
        for s, a, k in np.ndindex(self.successor.shape):
            dense[s, a, self.successor[s, a, k]] += self.probability[s, a, k]
        return dense


# --- random models -----------------------------------------------------------------------------


def random_model(
    rng: np.random.Generator,
    num_states: int,
    num_actions: int,
    num_successors: int,
    certainty: float | None = None,
) -> Model:
    """Sparse random rows in eighths, missing actions, absorbing states and end components.

    `certainty` is the share of deterministic actions; by default few in one half of the models,
    many in the other, which makes end components.
    """
    if certainty is None:
        certainty = rng.choice([0.2, 0.7])
    shape = (num_states, num_actions, num_successors)
    available = rng.random(shape[:2]) < 0.75
    available[np.arange(num_states), rng.integers(num_actions, size=num_states)] = True
    successor = rng.integers(num_states, size=shape)
    certain = rng.random(shape[:2]) < certainty
    eighths = rng.multinomial(8, np.full(num_successors, 1 / num_successors), shape[:2])
    eighths[certain] = [8] + [0] * (num_successors - 1)
    absorbing = rng.random(num_states) < 0.15
    successor[absorbing] = np.arange(num_states)[absorbing, None, None]
    probability = np.where(available[:, :, None], eighths / 8, 0)
    return Model(
        np.where(probability > 0, successor, 0),
        probability,
        available,
        random_distribution(rng, num_states),
    )


def random_distribution(rng: np.random.Generator, size: int) -> np.ndarray:
    """A distribution in 64ths."""
    return rng.multinomial(64, np.full(size, 1 / size)) / 64


def random_policy(rng: np.random.Generator, model: Model) -> np.ndarray:
    """A stochastic policy in eighths over the available actions, often not all of them."""
    policy = np.zeros(model.available.shape)
    for s, actions in enumerate(model.available):
        policy[s, actions] = rng.multinomial(8, np.full(actions.sum(), 1 / actions.sum())) / 8
    return policy


def random_reward(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Rewards in eighths between -2 and 2."""
    return rng.integers(-16, 17, shape) / 8


def random_target(rng: np.random.Generator, num_states: int) -> np.ndarray:
    """A set of up to three states, sometimes none."""
    target = np.zeros(num_states, bool)
    target[rng.integers(num_states, size=rng.integers(4))] = True
    return target


def random_acceptor(
    rng: np.random.Generator, num_memory: int, num_letters: int, acceptance: str
) -> tuple[np.ndarray, np.ndarray]:
    """Tables ``delta[Q, L]`` and ``final[Q]`` whose last state is absorbing, as acceptance asks."""
    delta = rng.integers(num_memory, size=(num_memory, num_letters))
    delta[-1] = num_memory - 1
    last = np.arange(num_memory) == num_memory - 1
    return delta, last if acceptance == "cosafe" else ~last


# --- operators by loops ------------------------------------------------------------------------


def expectation(model: Model, value: np.ndarray) -> np.ndarray:
    result = np.zeros(model.available.shape)
    for s, a, k in np.ndindex(model.successor.shape):
        result[s, a] += model.probability[s, a, k] * value[model.successor[s, a, k]]
    return result


def pushforward(model: Model, mass: np.ndarray) -> np.ndarray:
    result = np.zeros(model.num_states)
    for s, a, k in np.ndindex(model.successor.shape):
        result[model.successor[s, a, k]] += model.probability[s, a, k] * mass[s, a]
    return result


def successors(model: Model, s: int, a: int) -> set[int]:
    """The states to which the action leads with positive probability."""
    pairs = zip(model.successor[s, a], model.probability[s, a], strict=True)
    return {int(t) for t, p in pairs if p > 0}


def exists_successor(model: Model, region: np.ndarray) -> np.ndarray:
    result = np.zeros(model.available.shape, bool)
    for s, a in np.ndindex(result.shape):
        result[s, a] = any(region[t] for t in successors(model, s, a))
    return result


def forall_successor(model: Model, region: np.ndarray) -> np.ndarray:
    result = np.zeros(model.available.shape, bool)
    for s, a in np.ndindex(result.shape):
        result[s, a] = all(region[t] for t in successors(model, s, a))
    return result


# --- exact solutions ---------------------------------------------------------------------------


def exact_solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Gauss-Jordan elimination over fractions."""
    rows = [[*row, b] for row, b in zip(matrix.tolist(), right.tolist(), strict=True)]
    size = len(rows)
    for i in range(size):
        pivot = next(j for j in range(i, size) if rows[j][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        scale = rows[i][i]
        rows[i] = [x / scale if x else x for x in rows[i]]
        for j in range(size):
            factor = rows[j][i]
            if j != i and factor:
                pairs = zip(rows[j], rows[i], strict=True)
                rows[j] = [x - factor * y if y else x for x, y in pairs]
    return np.array([row[-1] for row in rows], object)


def chain(transition: np.ndarray, policy: np.ndarray) -> np.ndarray:
    """The matrix of a policy's chain: ``P[s, t] = sum_a pi(a | s) T(t | s, a)``."""
    return (policy[:, :, None] * transition).sum(axis=1)


def one_hot(policy: np.ndarray, num_actions: int) -> np.ndarray:
    return FRACTION(np.eye(num_actions, dtype=int)[policy])


def exact_policy_value(model: Model, policy, reward, discount) -> np.ndarray:
    """``(I - discount P)^-1 r``."""
    transition, policy, reward = FRACTION(model.transition), FRACTION(policy), FRACTION(reward)
    matrix = np.eye(model.num_states, dtype=int) - Fraction(discount) * chain(transition, policy)
    return exact_solve(matrix, (policy * reward).sum(axis=1))


def exact_optimal_value(model: Model, reward, discount) -> np.ndarray:
    """Policy iteration, ended by a proof: no action improves on the policy's exact value."""
    transition, reward = FRACTION(model.transition), FRACTION(reward)
    discount = Fraction(discount)
    policy = model.available.argmax(axis=1)
    states = np.arange(model.num_states)
    while True:
        matrix = np.eye(model.num_states, dtype=int) - discount * transition[states, policy]
        value = exact_solve(matrix, reward[states, policy])
        better = _improve(reward + discount * (transition @ value), value, policy, model.available)
        if (better == policy).all():
            return value
        policy = better


def _improve(quantity, value, policy, available) -> np.ndarray:
    """Changes the policy only where some available action is strictly better."""
    better = policy.copy()
    for s in range(len(policy)):
        best = max(np.flatnonzero(available[s]), key=lambda a, s=s: quantity[s, a])
        if quantity[s, best] > value[s]:
            better[s] = best
    return better


def exact_occupancy(model: Model, policy, discount, initial=None) -> np.ndarray:
    """``x(s, a) = d(s) pi(a | s)`` with ``d = (I - discount P')^-1 initial``."""
    policy = FRACTION(policy)
    start = FRACTION(model.initial if initial is None else initial)
    matrix = chain(FRACTION(model.transition), policy).T
    visits = exact_solve(np.eye(model.num_states, dtype=int) - Fraction(discount) * matrix, start)
    return visits[:, None] * policy


def exact_reachability(transition: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Probability that a chain ``P[s, t]`` of fractions reaches the target."""
    reaching = target.copy()
    for _ in target:
        reaching |= ((transition > 0) & reaching).any(axis=1)
    value = FRACTION(target.astype(int))
    inner = np.flatnonzero(reaching & ~target)
    if inner.size:
        matrix = np.eye(inner.size, dtype=int) - transition[np.ix_(inner, inner)]
        value[inner] = exact_solve(matrix, transition[inner][:, target].sum(axis=1))
    return value


def exact_policy_reachability(model: Model, policy: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The same for a policy, ``int[S]`` or ``float[S, A]``."""
    if policy.ndim == 1:
        policy = one_hot(policy, model.num_actions)
    return exact_reachability(chain(FRACTION(model.transition), FRACTION(policy)), target)


def exact_optimal_reachability(model: Model, target: np.ndarray, objective: str) -> np.ndarray:
    """Policy iteration over fractions, ended by a proof that the value is optimal.

    A maximum: the value bounds every action's expectation, so it bounds the least fixed point.
    A minimum: the value is zero wherever the target can be avoided for sure (from the first
    policy on, as values only fall) and below every action's expectation, which bounds every policy.
    """
    transition = FRACTION(model.transition)
    states = np.arange(model.num_states)
    sign = 1 if objective == "max" else -1
    stay = model.available & forall_successor(model, avoidable(model, target))
    policy = np.where(stay.any(axis=1), stay.argmax(axis=1), model.available.argmax(axis=1))
    if objective == "max":
        policy = model.available.argmax(axis=1)
    while True:
        value = exact_reachability(transition[states, policy], target)
        better = _improve(sign * (transition @ value), sign * value, policy, model.available)
        better = np.where(target, policy, better)
        if (better == policy).all():
            return value
        policy = better


# --- soft and Boltzmann values, in extended precision ------------------------------------------


def iterate_values(
    transition: np.ndarray,
    available: np.ndarray,
    reward: np.ndarray,
    discount: float,
    operator: str,
    num_steps: int,
) -> np.ndarray:
    """Damped iteration of the soft or the Boltzmann operator from zero, on a batch of models."""
    transition, reward = transition.astype(np.longdouble), reward.astype(np.longdouble)
    value = np.zeros(reward.shape[:-1], np.longdouble)
    for _ in range(num_steps):
        q = reward + discount * np.einsum("...sat,...t->...sa", transition, value)
        value = soft_maximum(q, available, operator) / 2 + value / 2
    return value


def soft_maximum(q: np.ndarray, available: np.ndarray, operator: str) -> np.ndarray:
    """``log sum exp q`` (soft) or the mean of q under its softmax (Boltzmann), over actions."""
    top = np.where(available, q, -np.inf).max(axis=-1, keepdims=True)
    weight = np.where(available, np.exp(np.where(available, q - top, 0)), 0)
    total = weight.sum(axis=-1)
    if operator == "soft":
        return top[..., 0] + np.log(total)
    return (weight * q).sum(axis=-1) / total


def likelihood_gradient(
    transition: np.ndarray,
    policy: np.ndarray,
    slope: np.ndarray,
    counts: np.ndarray,
    discount: float,
) -> np.ndarray:
    """(3.6) and (3.7): every parameter's sensitivity of Q by a dense solve, then of log pi.

    `transition` is ``[S, A, S]``, `slope` the derivative of the reward ``[S, A, F]``.
    """
    num_states, num_actions, num_parameters = slope.shape
    chain = np.einsum("sat,tb->satb", transition, policy)
    chain = chain.reshape(num_states * num_actions, num_states * num_actions)
    system = np.eye(len(chain)) - discount * chain
    q = np.linalg.solve(system, slope.reshape(-1, num_parameters)).reshape(slope.shape)
    mean = np.einsum("sa,saf->sf", policy, q)
    return np.einsum("sa,saf->f", counts, q - mean[:, None])


# --- supports by brute force -------------------------------------------------------------------


def attractor(model: Model, goal: np.ndarray, allowed: np.ndarray, rule: str) -> np.ndarray:
    """One naive sweep after another."""
    region = goal.copy()
    while True:
        hit = exists_successor(model, region)
        joins = (allowed & hit).any(axis=1) if rule == "exists" else (~allowed | hit).all(axis=1)
        if (region | joins == region).all():
            return region
        region = region | joins


def avoidable(model: Model, goal: np.ndarray) -> np.ndarray:
    """The largest set outside the goal in which some available action surely stays."""
    region = ~goal
    while True:
        stay = (model.available & forall_successor(model, region)).any(axis=1)
        if (region & stay == region).all():
            return region
        region = region & stay


def memoryless_policies(allowed: np.ndarray) -> Iterator[tuple[int, ...]]:
    """Every deterministic policy that takes allowed actions."""
    return itertools.product(*(np.flatnonzero(row) for row in allowed))


def almost_surely_reaching(model: Model, goal: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """States from which some memoryless policy reaches the goal surely, policy by policy.

    In a finite chain the goal is reached almost surely iff it can be reached from every state
    that can be reached before it. Without an allowed action, a state is left for nowhere.
    """
    support = model.transition > 0
    stuck = ~allowed.any(axis=1)
    usable = allowed | stuck[:, None]
    found = goal.copy()
    for policy in memoryless_policies(usable):
        step = support[np.arange(model.num_states), list(policy)]
        step[stuck | goal] = False
        connected = closure(step)
        hopeless = ~(connected & goal).any(axis=1)
        found |= ~(connected & hopeless).any(axis=1)
    return found


def closure(step: np.ndarray) -> np.ndarray:
    """Reflexive and transitive closure of ``bool[S, S]``."""
    connected = step | np.eye(len(step), dtype=bool)
    for _ in range(len(step).bit_length()):
        connected = (connected.astype(int) @ connected.astype(int)) > 0
    return connected


def end_components(model: Model, region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maximal end components within a region by trying every set of states.

    Returns:
      The smallest state of each state's component (itself outside), and the staying actions.
    """
    components = []
    support = model.transition > 0
    inside = np.flatnonzero(region)
    for size in range(1, inside.size + 1):
        for states in itertools.combinations(inside.tolist(), size):
            outside = np.setdiff1d(np.arange(model.num_states), states)
            stay = model.available & ~support[:, :, outside].any(axis=2)
            step = (support & stay[:, :, None]).any(axis=1)[np.ix_(states, states)]
            if stay[list(states)].any(axis=1).all() and closure(step).all():
                components.append((set(states), stay))
    number = np.arange(model.num_states)
    actions = np.zeros_like(model.available)
    for states, stay in components:
        if not any(states < other for other, _ in components):
            number[list(states)] = min(states)
            actions[list(states)] = stay[list(states)]
    return number, actions


# --- the product, copied out -------------------------------------------------------------------


def explicit_product(
    model: Model, delta: np.ndarray, start: int, letter: np.ndarray, label_on: str
) -> Model:
    """The product of a model and an automaton with states ``s * Q + q``, by loops."""
    num_memory = len(delta)
    num_states, num_actions, width = model.successor.shape
    size = num_states * num_memory
    successor = np.zeros((size, num_actions, width), int)
    probability = np.zeros((size, num_actions, width))
    initial = np.zeros(size)
    for s in range(num_states):
        first = delta[start, letter[s]] if label_on == "entry" else start
        initial[s * num_memory + first] = model.initial[s]
        for q, a, k in np.ndindex(num_memory, num_actions, width):
            if model.probability[s, a, k] > 0:
                t = model.successor[s, a, k]
                read = letter[t] if label_on == "entry" else letter[s]
                successor[s * num_memory + q, a, k] = t * num_memory + delta[q, read]
                probability[s * num_memory + q, a, k] = model.probability[s, a, k]
    return Model(successor, probability, np.repeat(model.available, num_memory, axis=0), initial)
