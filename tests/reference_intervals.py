"""Small random interval models, and their values by trying all policies and all vertices."""

import itertools

import numpy as np

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP


def vertices(lower, upper):
    """The extreme distributions of a row."""
    found = set()
    for order in itertools.permutations(range(len(lower))):
        p, rest = list(lower), 1 - sum(lower)
        for i in order:
            given = min(upper[i] - lower[i], rest)
            p[i], rest = p[i] + given, rest - given
        found.add(tuple(p))
    return [np.array(p) for p in found]


def ball_vertices(lower, upper, center, radius):
    """The extreme distributions of a row in a ball, from all sets of constraints that may bind."""
    k = len(lower)
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=k)))
    rows = np.concatenate([-np.eye(k), np.eye(k), signs])
    ends = np.concatenate([-lower, upper, signs @ center + radius])
    found = set()
    for binds in itertools.combinations(range(len(rows)), k - 1):
        system = np.concatenate([rows[list(binds)], np.ones((1, k))])
        if abs(np.linalg.det(system)) < 1e-9:
            continue
        p = np.linalg.solve(system, np.append(ends[list(binds)], 1))
        if (rows @ p <= ends + 1e-12).all():
            found.add(tuple(np.round(p, 12)))
    return [np.array(p) for p in found]


def with_ball(rng, model, unit=8):
    """The same with random centers and radii, all multiples of 1 / unit."""
    center = []
    for first, last in itertools.pairwise(model.mdp.entry_start):
        low, high = (np.round(x[first:last] * unit).astype(int) for x in (model.lower, model.upper))
        while low.sum() < unit:
            low[rng.choice(np.flatnonzero(low < high))] += 1
        center += list(low / unit)
    radius = rng.choice([0.0, 0.25, 0.5, 0.75, 1.0, 2.0], model.mdp.num_rows)
    mdp = model.mdp
    return interval_rows(
        mdp.row_start,
        mdp.entry_start,
        mdp.successor,
        model.lower,
        model.upper,
        center=center,
        radius=radius,
    ).host


def random_model(rng, num_states=4, most_rows=2, width=3, unit=8):
    """Ends are multiples of 1 / unit, half of the lower ones 0: ties, and edges to be cut."""
    row_start, entry_start, successor, lower, upper = [0], [0], [], [], []
    for _ in range(num_states):
        for _ in range(rng.integers(1, most_rows + 1)):
            k = rng.integers(1, width + 1)
            target = np.sort(rng.choice(num_states, k, replace=False))
            while True:
                low = rng.integers(0, unit // 2, k) * (rng.random(k) < 0.5)
                high = np.minimum(low + rng.integers(0, unit + 1, k), unit)
                if low.sum() <= unit <= high.sum():
                    break
            high = np.minimum(high, low + unit - low.sum())
            successor += list(target[high > 0])
            lower += list(low[high > 0] / unit)
            upper += list(high[high > 0] / unit)
            entry_start.append(len(successor))
        row_start.append(len(entry_start) - 1)
    shape = (np.array(x, np.int32) for x in (row_start, entry_start, successor))
    mdp = HostMDP(*shape, np.array(lower))
    model = UncertainMDP(mdp, np.array(lower), np.array(upper))
    chance = model.interior_distributions(np.ones(len(successor), bool))
    return UncertainMDP(
        HostMDP(mdp.row_start, mdp.entry_start, mdp.successor, chance), model.lower, model.upper
    )


def chains(model, goal):
    """Each policy, with the transition matrices of all natures ``[N, S, S]``; goals stand still."""
    mdp = model.mdp
    corner = []
    for r in range(mdp.num_rows):
        of = slice(mdp.entry_start[r], mdp.entry_start[r + 1])
        rows = np.zeros((0, mdp.num_states))
        ends = model.lower[of], model.upper[of]
        ball = model.ball
        for p in (
            vertices(*ends)
            if ball is None
            else ball_vertices(*ends, ball.center[of], 2 * ball.gain[r])
        ):
            row = np.zeros((1, mdp.num_states))
            row[0, mdp.successor[of]] = p
            rows = np.concatenate([rows, row])
        corner.append(rows)
    choices = [
        [mdp.row_start[s]] if goal[s] else range(mdp.row_start[s], mdp.row_start[s + 1])
        for s in range(mdp.num_states)
    ]
    for policy in itertools.product(*choices):
        options = [
            np.eye(mdp.num_states)[[s]] if goal[s] else corner[policy[s]]
            for s in range(mdp.num_states)
        ]
        yield policy, np.array([np.stack(c) for c in itertools.product(*options)])


def limit(matrix):
    """The matrices to a power in which what is transient is left."""
    for _ in range(60):
        matrix = matrix @ matrix
    return matrix


def reach(matrix, goal):
    """Probabilities of reaching a goal that stands still, ``[N, S]``."""
    return limit(matrix)[:, :, goal].sum(-1)


def reward(matrix, goal, cost):
    """Expected costs until a goal, infinite where it is not surely reached."""
    sure = reach(matrix, goal) > 1 - 1e-9
    inner = matrix * sure[:, :, None] * sure[:, None, :] * ~goal[:, None] * ~goal
    size = goal.size
    cost = np.where(goal, 0, cost)[None] * sure
    found = np.linalg.solve(np.eye(size) - inner, cost[..., None])[..., 0]
    return np.where(sure, found, np.inf)


def parity(matrix, priority):
    """Probabilities that the least priority met for ever is even."""
    size = priority.size
    leads = (matrix > 0) | np.eye(size, dtype=bool)
    for _ in range(size.bit_length()):
        leads = leads.astype(int) @ leads.astype(int) > 0
    recurrent = (~leads | leads.transpose(0, 2, 1)).all(2)
    least = np.where(leads, priority, priority.max() + 1).min(2)
    good = recurrent & (least % 2 == 0)
    still = np.where(recurrent[:, :, None], np.eye(size), matrix)
    return (limit(still) * good[:, None, :]).sum(2)


def optima(answers):
    """Of arrays ``[natures, S]``, one a policy: by (policy large, nature large)."""
    large, small = (np.array([op(x, 0) for x in answers]) for op in (np.max, np.min))
    return {
        (True, True): large.max(0),
        (True, False): small.max(0),
        (False, True): large.min(0),
        (False, False): small.min(0),
    }
