"""Robust policy iteration of interval models inside ``jit``, with certified bounds.

Values carry a sign, such that one player, the leader, maximises them and must leave the open
states: the maximiser of a probability, the minimiser of a reward until a target. Policy iteration
(Howard 1960; with two players, Hoffman and Karp 1966) over rows and distributions together, each
round one linear system. It solves the problem in which each step costs the leader a little more,
and that in which each earns a little more: the solutions are bounds, by one application of the
operator with room for rounding.

- Where each open state gains strictly, the leader's choices leave the open states against every
  opponent, and attain the bound.
- Where none gains, the bound holds for probabilities, as the value is the least solution, and for
  rewards, as a trajectory that does not reach the target has infinite cost. If the leader has free
  cycles, this needs equal values on them: steps between states of equal value earn nothing, and
  values that differ by rounding only are made equal.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from numpy.typing import DTypeLike

from jaxltl.core import struct
from jaxltl.core.models.protocols import Array
from jaxltl.core.values.engine.linear import row_system

_AIM = 0.1  # of the tolerance: how much of it the extra of all steps may take
_HASTY = 12  # rounds in which both sides move at once; then the leader waits for the other one
_ROUNDS = 100
_GROWTH = 8.0  # of the extra where no choice changes and yet no bound is proven
_MAX_GROWTH = 1e5
_PAIRS = 16  # entries of a row up to which each pair is compared
_EQUAL = 2.0**12  # roundings by which equal values may differ


@struct.dataclass
class RobustProblem:
    """Optimality equations of interval rows between open states."""

    target: jax.Array  # int32[R, W], nodes; N is worth 0, N + 1 is worth 1
    owner: jax.Array  # int32[R]
    choice: jax.Array  # int32[N, A], the rows of each node
    first: jax.Array  # int32[N], rows by which the policy gets out, if it leads
    lower: jax.Array  # float[R, W], 0 where there is no entry
    upper: jax.Array
    cost: jax.Array  # float[R], with the sign
    policy_leads: bool = struct.field(pytree_node=False)
    nature_leads: bool = struct.field(pytree_node=False)
    # whether the tolerance is a share of the value
    relative: bool = struct.field(pytree_node=False)
    # whether the leader may stay forever at no cost
    has_free_cycles: bool = struct.field(pytree_node=False)

    @property
    def size(self) -> int:
        """The number N of nodes."""
        return self.first.shape[0]

    @property
    def eps(self) -> float:
        return float(jnp.finfo(self.lower.dtype).eps)

    @property
    def out(self) -> jax.Array:
        """Entries that leave their node, ``bool[R, W]``."""
        return (self.target != self.owner[:, None]) & (self.upper > 0)

    def ahead(self, z: jax.Array) -> jax.Array:
        """Differences ``x_t - x_s`` of the entries, ``float[R, W]``."""
        return jnp.where(self.out, _all(z)[self.target] - z[self.owner][:, None], 0)

    def greedy(self, gain: jax.Array) -> jax.Array:
        """Nature's optimal distributions for some gains."""
        return greedy_distributions(self.lower, self.upper, self.key(gain))

    def key(self, gain: jax.Array) -> jax.Array:
        """The key by which nature distributes mass."""
        return -gain if self.nature_leads else gain

    def best(self, gain: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Optimal gain of each node, and its row, ``[N]``."""
        each = gain[self.choice]
        rank = jnp.argmax(each if self.policy_leads else -each, axis=1)[:, None]
        return (
            jnp.take_along_axis(each, rank, 1)[:, 0],
            jnp.take_along_axis(self.choice, rank, 1)[:, 0],
        )


class NodeBounds(NamedTuple):
    """Bounds of the nodes, and a pair of policy and nature."""

    lower: jax.Array  # float[N], with the sign: the bound that the leader attains
    upper: jax.Array  # float[N], the bound that it cannot exceed
    lower_proven: jax.Array  # whether they are proven
    upper_proven: jax.Array
    middle: jax.Array  # float[N], the solution between them
    row: jax.Array  # int32[N], rows of the policy
    probability: jax.Array  # float[R, W], nature's distributions
    rounds: jax.Array  # systems solved


def _all(z: jax.Array) -> jax.Array:
    """Values of the nodes, then 0 and 1."""
    return jnp.concatenate([z, jnp.asarray([0, 1], z.dtype)])


def rounding(width: Array, dtype: DTypeLike) -> Array:
    """Bound on the rounding error of a sum of `width` masses."""
    return 4 * float(jnp.finfo(dtype).eps) * (width + 1)


def greedy_distributions(lower: jax.Array, upper: jax.Array, key: jax.Array) -> jax.Array:
    """Greedy distributions ``float[R, W]`` between the ends; differentiable, the order held fixed."""
    remaining, free = _remaining_mass(lower, upper, key)
    remaining = jnp.where(remaining > rounding(key.shape[1], key.dtype), remaining, 0)
    return jnp.where(remaining >= free, upper, lower + jnp.maximum(remaining, 0))


def _remaining_mass(
    lower: jax.Array, upper: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Mass that better entries leave to each entry, and its room."""
    width = key.shape[1]
    free = upper - lower
    rest = jnp.maximum(1 - jnp.sum(lower, axis=1, keepdims=True), 0)
    key = lax.stop_gradient(key)
    if width <= _PAIRS:
        rank = jnp.arange(width)
        mine, other = key[:, :, None], key[:, None, :]
        earlier = (other < mine) | ((other == mine) & (rank < rank[:, None]))
        before = jnp.sum(jnp.where(earlier, free[:, None, :], 0), axis=2)
    else:
        order = jnp.argsort(key, axis=1)
        ranked = jnp.take_along_axis(free, order, 1)
        sums = jnp.concatenate([jnp.zeros_like(rest), jnp.cumsum(ranked[:, :-1], axis=1)], axis=1)
        before = jnp.take_along_axis(sums, jnp.argsort(order, axis=1), 1)
    return rest - before, free


def leaving(target: jax.Array, probability: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mass that leaves each node (1 where none does), and the weights divided by it."""
    own = jnp.arange(target.shape[0])[:, None]
    out = jnp.where(target != own, probability, 0)
    mass = jnp.sum(out, axis=1)
    mass = jnp.where(mass > 0, mass, 1)
    return mass, out / mass[:, None]


# --- policy iteration -----------------------------------------------------------------------------


class _Iteration(NamedTuple):
    row: jax.Array
    probability: jax.Array
    base: jax.Array  # the solution without anything extra
    z: jax.Array
    extra: jax.Array
    growth: jax.Array
    rounds: jax.Array
    hasty: jax.Array  # whether both sides move at once
    still: jax.Array  # whether nobody moves
    proven: jax.Array


def enclose(problem: RobustProblem, tolerance: jax.Array, max_rounds: jax.Array) -> NodeBounds:
    """Certified lower and upper bounds."""
    every = jnp.sum(problem.upper - problem.lower, axis=1, keepdims=True)
    rest = jnp.maximum(1 - jnp.sum(problem.lower, axis=1, keepdims=True), 0)
    share = jnp.where(every > 0, jnp.minimum(rest / jnp.where(every > 0, every, 1), 1), 0)
    p = problem.lower + (problem.upper - problem.lower) * share
    zero, no = jnp.zeros(problem.size, p.dtype), jnp.asarray(False)
    start = _Iteration(
        problem.first,
        p,
        zero,
        zero,
        jnp.full((), jnp.inf, p.dtype),
        jnp.ones((), p.dtype),
        jnp.int32(0),
        ~no,
        no,
        no,
    )
    apart = jnp.arange(problem.size + 2)
    lower = _policy_iteration(problem, start, -1.0, apart, tolerance, max_rounds)
    label = apart
    if problem.has_free_cycles:
        label = jnp.concatenate([_groups(lower.base, problem.eps)[0], apart[problem.size :]])
    again = start._replace(row=lower.row, probability=lower.probability)
    upper = _policy_iteration(problem, again, 1.0, label, tolerance, max_rounds)
    low, high = problem.ahead(lower.z), problem.ahead(upper.z)
    p_low, p_high = problem.greedy(low), problem.greedy(high)
    lows, highs = (jnp.sum(p * d, axis=1) + problem.cost for p, d in ((p_low, low), (p_high, high)))
    # The leader's choices attain the one bound, those of the opponent the other.
    row = problem.best(lows if problem.policy_leads else highs)[1]
    middle = jnp.where(lower.proven & upper.proven, (lower.z + upper.z) / 2, lower.base)
    return NodeBounds(
        lower.z,
        upper.z,
        lower.proven,
        upper.proven,
        middle,
        row,
        p_low if problem.nature_leads else p_high,
        lower.rounds + upper.rounds,
    )


def _groups(z: jax.Array, eps: float) -> tuple[jax.Array, jax.Array]:
    """Groups of values that are equal up to rounding, and the largest of each group."""
    order = jnp.argsort(z)
    ranked = z[order]
    apart = _EQUAL * eps * jnp.max(jnp.abs(z))
    new = jnp.diff(ranked, prepend=ranked[:1]) > apart
    number = jnp.cumsum(new)
    largest = jax.ops.segment_max(ranked, number, z.shape[0], indices_are_sorted=True)
    label = jnp.zeros_like(number).at[order].set(number)
    return label, largest[label]


def _policy_iteration(
    problem: RobustProblem,
    start: _Iteration,
    sign: float,
    label: jax.Array,
    tolerance: jax.Array,
    max_rounds: jax.Array,
) -> _Iteration:
    """Policy iteration until a lower or an upper bound is proven."""
    out, size = problem.out, problem.size
    earning = out & (label[problem.target] != label[problem.owner][:, None])
    equal = problem.has_free_cycles and sign > 0

    def body(iteration: _Iteration) -> _Iteration:
        target = problem.target[iteration.row]
        p = jnp.where(out[iteration.row], iteration.probability[iteration.row], 0)
        mass, share = leaving(target, p)
        known = jnp.where(target == size + 1, share, 0)
        steps = jnp.sum(jnp.where(earning[iteration.row], share, 0), axis=1)
        solve = row_system(target, share).solve
        base = solve(jnp.sum(known, axis=1) + problem.cost[iteration.row] / mass)
        time = solve(steps)
        # The extra never grows here: otherwise choices that cycle to earn it would alternate with it.
        aim = _extra(problem, base, time, tolerance)
        least = jnp.where(jnp.isfinite(aim), jnp.minimum(iteration.extra, aim), iteration.extra)
        extra = iteration.growth * least
        z = base + sign * extra * time
        if equal:
            z = _groups(z, problem.eps)[1]
        row, chance = _improved(problem, iteration, z, sign * extra * earning)
        # Simultaneous moves may end in a pair that never leaves the open states; alternating ones
        # do not.
        lost = ~(jnp.all(jnp.isfinite(z)) & jnp.all(time >= 0))
        again = lost & iteration.hasty
        row, chance = (
            jnp.where(again, x, y) for x, y in ((start.row, row), (start.probability, chance))
        )
        z = jnp.where(again, 0, z)
        hasty = iteration.hasty & ~lost & (iteration.rounds < _HASTY)
        still = jnp.all(row == iteration.row) & jnp.all(chance == iteration.probability)
        proven = _proves(problem, z, sign) & ~lost
        growth = jnp.where(still & ~proven, _GROWTH * iteration.growth, iteration.growth)
        return _Iteration(
            row, chance, base, z, least, growth, iteration.rounds + 1, hasty, still, proven
        )

    def goes_on(iteration: _Iteration) -> jax.Array:
        alive = jnp.all(jnp.isfinite(iteration.z)) & (iteration.growth < _MAX_GROWTH)
        done = iteration.proven & iteration.still
        return ~done & alive & (iteration.rounds < jnp.minimum(max_rounds, _ROUNDS))

    return lax.while_loop(goes_on, body, start)


def _extra(
    problem: RobustProblem, base: jax.Array, time: jax.Array, tolerance: jax.Array
) -> jax.Array:
    """Extra of a step: small relative to the tolerance, and more than rounding."""
    largest = jnp.max(jnp.abs(base))
    scale: jax.Array | float = 1.0
    if problem.relative:
        scale = jnp.min(jnp.where(base != 0, jnp.abs(base), largest))
    width = problem.target.shape[1]
    finest = 64 * (width + 8) * problem.eps * jnp.maximum(largest, 0.0 if problem.relative else 1.0)
    tiny = 1e6 * float(jnp.finfo(base.dtype).tiny)
    aim = _AIM * tolerance * scale / jnp.maximum(jnp.max(time), 1)
    return jnp.maximum(jnp.maximum(aim, finest), tiny)


def _improved(
    problem: RobustProblem, iteration: _Iteration, z: jax.Array, more: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Improved rows and distributions."""
    gain = problem.ahead(z) + more
    greedy = problem.greedy(gain)
    now = jnp.sum(iteration.probability * gain, axis=1) + problem.cost
    then = jnp.sum(greedy * gain, axis=1) + problem.cost
    slack = 4 * problem.eps * (jnp.abs(z) + rounding(problem.target.shape[1], z.dtype))
    policy = 1.0 if problem.policy_leads else -1.0
    nature = 1.0 if problem.nature_leads else -1.0
    best, row = problem.best(then)
    switches = policy * best > slack
    moved = jnp.where(switches, row, iteration.row)
    better = nature * (then - now) > slack[problem.owner]
    fresh = jnp.zeros(problem.owner.shape, bool).at[moved].max(switches)
    chance = jnp.where((better | fresh)[:, None], greedy, iteration.probability)
    if problem.policy_leads == problem.nature_leads:
        return moved, chance
    if problem.policy_leads:
        answers = better[iteration.row]
        only = iteration.row, jnp.where(better[:, None], greedy, iteration.probability)
    else:
        best, row = problem.best(now)
        answers = -best > slack
        only = jnp.where(answers, row, iteration.row), iteration.probability
        # A leader that waited moves, and the policy answers its distributions.
        moved = jnp.where(iteration.hasty, moved, iteration.row)
        chance = jnp.where(
            iteration.hasty, chance, jnp.where(better[:, None], greedy, iteration.probability)
        )
    waits = ~iteration.hasty & jnp.any(answers)
    return jnp.where(waits, only[0], moved), jnp.where(waits, only[1], chance)


def _proves(problem: RobustProblem, z: jax.Array, sign: float) -> jax.Array:
    """True if values are a bound: every node gains strictly, or none gains, rounding included."""
    gain = problem.ahead(z)
    p = problem.greedy(gain)
    size = jnp.abs(gain)
    width, dtype = problem.target.shape[1], z.dtype
    terms = (2 * width + 8) * problem.eps
    # Mass is known up to rounding where it is not certain to be all or nothing.
    remaining, free = _remaining_mass(problem.lower, problem.upper, problem.key(gain))
    miss = rounding(width, dtype)
    partly = (remaining > -miss) & (remaining < free + miss)
    slack = terms * (jnp.sum(p * size, axis=1) + jnp.abs(problem.cost))
    slack = slack + miss * jnp.max(jnp.where(partly, size, 0), axis=1)
    slack = slack + (width + 2) * float(jnp.finfo(dtype).tiny) * (slack > 0)
    image = jnp.sum(p * gain, axis=1) + problem.cost
    best = problem.best(image + sign * slack)[0]
    return jnp.all(best <= 0) if sign > 0 else jnp.all(best > 0)
