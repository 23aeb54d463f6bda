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


def controller_values(pomdp, table, target, cost=None):
    """Probabilities of reaching, or costs ``[S, A]`` until then, and probabilities, of all controllers of two
    memory states: sums over 2**20 steps, from below, by repeated squaring of their chains in one batch."""
    seen, size = np.asarray(pomdp.observation), len(table)
    both = list(controllers(pomdp.num_observations, pomdp.num_actions))
    action = np.stack([c[0] for c in both])[:, seen]  # [C, S, M]
    update = np.stack([c[1] for c in both])[:, seen]
    state = np.arange(size)[None, :, None]
    entered = update[..., None] == np.arange(2)  # [C, S', M, M']
    step = np.einsum("csmt,ctmn->csmtn", table[state, action], entered)
    step = step.reshape(len(both), 2 * size, 2 * size)
    to_target = step[:, :, 2 * target : 2 * target + 2].sum(-1)
    inner = np.arange(2 * size) // 2 != target
    step = step * inner[:, None] * inner
    gains = [to_target * inner]
    if cost is not None:
        gains.append(cost[state, action].reshape(len(both), -1) * inner)
    value = np.stack(gains, -1)
    for _ in range(20):
        value = value + step @ value
        step = step @ step
    value[:, 2 * target, 0] = 1  # probability from the target
    total = np.einsum("s,csg->cg", np.asarray(pomdp.initial), value[:, ::2])
    return total[:, -1], total[:, 0]


def tree_value(pomdp, table, target, depth, objective="max", cost=None):
    """Bound of the optimum by an exact tree of beliefs, with values of the seen states at its leaves.

    The probability of reaching, which the sink, the last state, does not; or the cost ``[S, A]`` until then.
    """
    best = max if objective == "max" else min
    goal = np.eye(len(table), dtype=bool)[target]
    world = pomdp.fully_observable
    if cost is None:
        leaf = jl.reachability_probability(world, goal, objective=objective)
    else:
        leaf = jl.total_reward(world, np.ravel(cost), goal, objective=objective)
    bound = leaf.upper if objective == "max" else leaf.lower
    exact = [Fraction(float(x)) for x in np.asarray(bound)]
    exact[target] = Fraction(int(cost is None))
    sink = len(table) - 1 if cost is None else None
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
                total += 0 if cost is None else w * Fraction(float(cost[s, a]))
                for t, p in rows[s][a].items():
                    if t == target:
                        total += w * p if cost is None else 0
                    elif t != sink:
                        group = groups.setdefault(seen[t], {})
                        group[t] = group.get(t, Fraction(0)) + w * p
            options.append(total + sum(value(g, depth - 1) for g in groups.values()))
        return best(options)

    groups = {}
    for s, w in enumerate(np.asarray(pomdp.initial).tolist()):
        if w and s != target:
            groups.setdefault(seen[s], {})[s] = Fraction(w)
    return sum(value(g, depth) for g in groups.values())
