"""References for partially observable models: exhaustive controllers, and exact trees of beliefs."""

import itertools
from fractions import Fraction

import numpy as np

import jaxltl as jl


def random_pomdp(seed, num_states=5, num_observations=2, num_actions=2):
    """A POMDP with dyadic probabilities, a hidden target, end components, and a sink."""
    rng = np.random.default_rng(seed)
    table = np.zeros((num_states, num_actions, num_states))
    for s in range(num_states):
        for a in range(num_actions):
            support = rng.choice(num_states, size=rng.integers(1, 4), replace=False)
            weight = rng.multinomial(8, np.ones(support.size) / support.size)
            table[s, a, support] = weight / 8
    table[-1] = 0
    table[-1, :, -1] = 1  # the sink; the target is the state before
    initial = np.zeros(num_states)
    initial[rng.choice(num_states - 2, size=2, replace=False)] = [0.25, 0.75]
    seen = rng.integers(num_observations, size=num_states)
    seen[0] = num_observations - 1
    world = jl.to_sparse(
        jl.from_dense(
            table, initial=initial, label={"goal": [num_states - 2], "sink": [num_states - 1]}
        )
    )
    return jl.models.make_pomdp(world, seen), table


def controllers(num_observations, num_actions, num_memory=2):
    """All deterministic controllers: actions and updates ``[O, M]`` by the observation that is entered."""
    cells = num_observations * num_memory
    for action in itertools.product(range(num_actions), repeat=cells):
        for update in itertools.product(range(num_memory), repeat=cells):
            shape = num_observations, num_memory
            yield np.reshape(action, shape), np.reshape(update, shape)


def controller_values(pomdp, table, target, sweeps=400, cost=None):
    """Values from below of all controllers with two memory states, by value iteration in one batch."""
    seen, size = np.asarray(pomdp.observation), len(table)
    all_controllers = list(controllers(pomdp.num_observations, pomdp.num_actions))
    action = np.stack([c[0] for c in all_controllers])[:, seen]  # [C, S, M]
    update = np.stack([c[1] for c in all_controllers])[:, seen]
    number, memory = len(all_controllers), 2
    value = np.zeros((number, size, memory))
    reach = np.zeros((number, size, memory))
    each = np.arange(number)[:, None, None]
    entered = np.arange(size)[None, :, None], np.broadcast_to(update, (number, size, memory))
    step = table[np.arange(size)[None, :, None], action]  # [C, S, M, S]
    for _ in range(sweeps):
        for x, gain in ((value, cost), (reach, None)):
            x[:, target] = 1.0 if (gain is None and cost is None) or x is reach else 0.0
            after = x[each, entered[0], entered[1]]  # value at s' if memory m: [C, S', M]
            new = np.einsum("csmt,ctm->csm", step, after)
            if gain is not None:
                new += gain
            x[...] = new
            x[:, target] = 1.0 if x is reach or cost is None else 0.0
    start = np.asarray(pomdp.initial)
    return value[:, :, 0] @ start, reach[:, :, 0] @ start


def tree_value(pomdp, table, target, depth, objective="max"):
    """Bound of the optimum of reaching by an exact tree of beliefs, with values of the seen states at its leaves."""
    best = max if objective == "max" else min
    leaf = jl.reachability_probability(
        pomdp.fully_observable, np.eye(len(table), dtype=bool)[target], objective=objective
    )
    bound = leaf.upper if objective == "max" else leaf.lower
    exact = [Fraction(float(x)) for x in np.asarray(bound)]
    exact[target] = Fraction(1)
    seen = np.asarray(pomdp.observation).tolist()
    rows = [[{t: Fraction(p) for t, p in enumerate(r) if p} for r in s] for s in table.tolist()]

    def value(belief, depth):
        if not belief:
            return Fraction(0)
        if depth == 0:
            return sum(w * exact[s] for s, w in belief.items())
        options = []
        for a in range(table.shape[1]):
            total, groups = Fraction(0), {}
            for s, w in belief.items():
                for t, p in rows[s][a].items():
                    if t == target:
                        total += w * p
                    elif t != len(table) - 1:
                        group = groups.setdefault(seen[t], {})
                        group[t] = group.get(t, Fraction(0)) + w * p
            options.append(total + sum(value(g, depth - 1) for g in groups.values()))
        return best(options)

    groups = {}
    for s, w in enumerate(np.asarray(pomdp.initial).tolist()):
        if w:
            groups.setdefault(seen[s], {})[s] = Fraction(w)
    return sum(value(g, depth) for g in groups.values())
