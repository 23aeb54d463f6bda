"""Certified values of policy against nature, or with it, by policy iteration inside ``jit``.

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
from jaxltl.core import struct
from jaxltl.core.models.protocols import Array
from jax import lax
from numpy.typing import DTypeLike

from jaxltl.core.values.engine.linear import row_system

_AIM = 0.1  # of the tolerance: how much of it the extra of all steps may take
_HASTY = 12  # rounds in which both sides move at once; then the leader waits for the other one
_ROUNDS = 100
_GROWTH = 8.0  # of the extra where no choice changes and yet no bound is proven
_MOST_GROWTH = 1e5
_PAIRS = 16  # entries of a row up to which each pair is compared
_EQUAL = 2.0**12  # roundings by which equal values may differ


@struct.dataclass
class Contest:
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


class Bounds(NamedTuple):
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
    remaining, free = _left(lower, upper, key)
    remaining = jnp.where(remaining > rounding(key.shape[1], key.dtype), remaining, 0)
    return jnp.where(remaining >= free, upper, lower + jnp.maximum(remaining, 0))


def _left(lower: jax.Array, upper: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
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


class _Play(NamedTuple):
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


def enclose(contest: Contest, tolerance: jax.Array, max_rounds: jax.Array) -> Bounds:
    """Certified lower and upper bounds."""
    every = jnp.sum(contest.upper - contest.lower, axis=1, keepdims=True)
    rest = jnp.maximum(1 - jnp.sum(contest.lower, axis=1, keepdims=True), 0)
    share = jnp.where(every > 0, jnp.minimum(rest / jnp.where(every > 0, every, 1), 1), 0)
    p = contest.lower + (contest.upper - contest.lower) * share
    zero, no = jnp.zeros(contest.size, p.dtype), jnp.asarray(False)
    start = _Play(
        contest.first,
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
    apart = jnp.arange(contest.size + 2)
    lower = _played(contest, start, -1.0, apart, tolerance, max_rounds)
    label = apart
    if contest.has_free_cycles:
        label = jnp.concatenate([_groups(lower.base, contest.eps)[0], apart[contest.size :]])
    again = start._replace(row=lower.row, probability=lower.probability)
    upper = _played(contest, again, 1.0, label, tolerance, max_rounds)
    low, high = contest.ahead(lower.z), contest.ahead(upper.z)
    p_low, p_high = contest.greedy(low), contest.greedy(high)
    lows, highs = (jnp.sum(p * d, axis=1) + contest.cost for p, d in ((p_low, low), (p_high, high)))
    # The leader's choices attain the one bound, those of the opponent the other.
    row = contest.best(lows if contest.policy_leads else highs)[1]
    middle = jnp.where(lower.proven & upper.proven, (lower.z + upper.z) / 2, lower.base)
    return Bounds(
        lower.z,
        upper.z,
        lower.proven,
        upper.proven,
        middle,
        row,
        p_low if contest.nature_leads else p_high,
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


def _played(
    contest: Contest,
    start: _Play,
    sign: float,
    label: jax.Array,
    tolerance: jax.Array,
    max_rounds: jax.Array,
) -> _Play:
    """Policy iteration until a lower or an upper bound is proven."""
    out, size = contest.out, contest.size
    earning = out & (label[contest.target] != label[contest.owner][:, None])
    equal = contest.has_free_cycles and sign > 0

    def body(play: _Play) -> _Play:
        target = contest.target[play.row]
        p = jnp.where(out[play.row], play.probability[play.row], 0)
        mass, share = leaving(target, p)
        known = jnp.where(target == size + 1, share, 0)
        steps = jnp.sum(jnp.where(earning[play.row], share, 0), axis=1)
        solve = row_system(target, share).solve
        base = solve(jnp.sum(known, axis=1) + contest.cost[play.row] / mass)
        time = solve(steps)
        # The extra never grows here: otherwise choices that cycle to earn it would alternate with it.
        aim = _extra(contest, base, time, tolerance)
        least = jnp.where(jnp.isfinite(aim), jnp.minimum(play.extra, aim), play.extra)
        extra = play.growth * least
        z = base + sign * extra * time
        if equal:
            z = _groups(z, contest.eps)[1]
        row, chance = _moved(contest, play, z, sign * extra * earning)
        # Simultaneous moves may end in a pair that never leaves the open states; alternating ones
        # do not.
        lost = ~(jnp.all(jnp.isfinite(z)) & jnp.all(time >= 0))
        again = lost & play.hasty
        row, chance = (
            jnp.where(again, x, y) for x, y in ((start.row, row), (start.probability, chance))
        )
        z = jnp.where(again, 0, z)
        hasty = play.hasty & ~lost & (play.rounds < _HASTY)
        still = jnp.all(row == play.row) & jnp.all(chance == play.probability)
        proven = _proves(contest, z, sign) & ~lost
        growth = jnp.where(still & ~proven, _GROWTH * play.growth, play.growth)
        return _Play(row, chance, base, z, least, growth, play.rounds + 1, hasty, still, proven)

    def goes_on(play: _Play) -> jax.Array:
        alive = jnp.all(jnp.isfinite(play.z)) & (play.growth < _MOST_GROWTH)
        done = play.proven & play.still
        return ~done & alive & (play.rounds < jnp.minimum(max_rounds, _ROUNDS))

    return lax.while_loop(goes_on, body, start)


def _extra(contest: Contest, base: jax.Array, time: jax.Array, tolerance: jax.Array) -> jax.Array:
    """Extra of a step: small relative to the tolerance, and more than rounding."""
    largest = jnp.max(jnp.abs(base))
    scale: jax.Array | float = 1.0
    if contest.relative:
        scale = jnp.min(jnp.where(base != 0, jnp.abs(base), largest))
    width = contest.target.shape[1]
    finest = 64 * (width + 8) * contest.eps * jnp.maximum(largest, 0.0 if contest.relative else 1.0)
    tiny = 1e6 * float(jnp.finfo(base.dtype).tiny)
    aim = _AIM * tolerance * scale / jnp.maximum(jnp.max(time), 1)
    return jnp.maximum(jnp.maximum(aim, finest), tiny)


def _moved(
    contest: Contest, play: _Play, z: jax.Array, more: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Improved rows and distributions."""
    gain = contest.ahead(z) + more
    greedy = contest.greedy(gain)
    now = jnp.sum(play.probability * gain, axis=1) + contest.cost
    then = jnp.sum(greedy * gain, axis=1) + contest.cost
    slack = 4 * contest.eps * (jnp.abs(z) + rounding(contest.target.shape[1], z.dtype))
    policy = 1.0 if contest.policy_leads else -1.0
    nature = 1.0 if contest.nature_leads else -1.0
    best, row = contest.best(then)
    switches = policy * best > slack
    moved = jnp.where(switches, row, play.row)
    better = nature * (then - now) > slack[contest.owner]
    fresh = jnp.zeros(contest.owner.shape, bool).at[moved].max(switches)
    chance = jnp.where((better | fresh)[:, None], greedy, play.probability)
    if contest.policy_leads == contest.nature_leads:
        return moved, chance
    if contest.policy_leads:
        answers = better[play.row]
        only = play.row, jnp.where(better[:, None], greedy, play.probability)
    else:
        best, row = contest.best(now)
        answers = -best > slack
        only = jnp.where(answers, row, play.row), play.probability
        # A leader that waited moves, and the policy answers its distributions.
        moved = jnp.where(play.hasty, moved, play.row)
        chance = jnp.where(play.hasty, chance, jnp.where(better[:, None], greedy, play.probability))
    waits = ~play.hasty & jnp.any(answers)
    return jnp.where(waits, only[0], moved), jnp.where(waits, only[1], chance)


def _proves(contest: Contest, z: jax.Array, sign: float) -> jax.Array:
    """True if values are a bound: every node gains strictly, or none gains, rounding included."""
    gain = contest.ahead(z)
    p = contest.greedy(gain)
    size = jnp.abs(gain)
    width, dtype = contest.target.shape[1], z.dtype
    terms = (2 * width + 8) * contest.eps
    # Mass is known up to rounding where it is not certain to be all or nothing.
    remaining, free = _left(contest.lower, contest.upper, contest.key(gain))
    miss = rounding(width, dtype)
    partly = (remaining > -miss) & (remaining < free + miss)
    slack = terms * (jnp.sum(p * size, axis=1) + jnp.abs(contest.cost))
    slack = slack + miss * jnp.max(jnp.where(partly, size, 0), axis=1)
    slack = slack + (width + 2) * float(jnp.finfo(dtype).tiny) * (slack > 0)
    image = jnp.sum(p * gain, axis=1) + contest.cost
    best = contest.best(image + sign * slack)[0]
    return jnp.all(best <= 0) if sign > 0 else jnp.all(best > 0)
