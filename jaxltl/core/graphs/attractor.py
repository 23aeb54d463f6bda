"""Exact questions about supports: attractors, almost-sure sets, end components.

Regions are Boolean, and only whether a probability is positive matters. There is one
answer and two ways to it. Sweeps of the primitives work inside ``jit`` and ``vmap`` and are
fast where regions grow in few steps. On concrete arrays, a region that is still growing
after a few hundred sweeps is finished by worklists on the host, in time linear in
the transitions, so that depth costs nothing.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.graphs.support import _label_on, _support, is_traced, repeat
from jaxltl.core.models.operators import exists_successor, first_action, forall_successor

_MAX_SWEEPS = 256  # beyond, a worklist on the host is faster


class Attractor(NamedTuple):
    """A region that a goal attracts, with an action that makes progress.

    Attributes:
      region: ``bool[S]``.
      action: ``int32[S]``: in the region outside the goal, an allowed action with a
        successor that is nearer to the goal; elsewhere the first available one.
      rank: ``int32[S]``: the round in which the state joined, 0 in the goal; meaningless
        outside of the region.
    """

    region: jax.Array
    action: jax.Array
    rank: jax.Array


def attractor(
    model: Any,
    goal: jax.Array,
    allowed: jax.Array | None = None,
    *,
    rule: str | jax.Array = "exists",
    chance: str = "some",
    among: jax.Array | None = None,
) -> Attractor:
    """States that a goal attracts: the least R with ``goal <= R`` closed under a rule.

    With a rule for each state it is the attractor of a player in a game: ``"exists"`` where
    that player moves, ``"forall"`` where the other does.

    Args:
      model: the model.
      goal: ``bool[S]``.
      allowed: ``bool[S, A]``, the actions that count; default the available ones.
      rule: ``"exists"``: some allowed action leads to R; ``"forall"``: every allowed
        action does (so a state without any is attracted). Or ``bool[S]``: True for exists.
      chance: what leading to R means: ``"some"`` successor lies in R, so that chance
        helps, or ``"all"`` do, so that it does not.
      among: ``bool[S]``, the states outside the goal that may join; default all.

    Returns:
      :class:`Attractor`. With ``"exists"`` the action is the one that makes progress.

    Raises:
      ValueError: unknown rule or chance.

    Example:
      >>> from jaxltl.core.models.mdp import from_dense
      >>> mdp = from_dense([[[0, 1.0]], [[0, 1.0]]])
      >>> attractor(mdp, jnp.array([True, False])).region.tolist()
      [True, False]
    """
    if isinstance(rule, str):
        if rule not in ("exists", "forall"):
            raise ValueError(f"rule={rule!r}; choose exists or forall, or give bool[S].")
        rule = jnp.full(model.state_shape, rule == "exists")
    if chance not in ("some", "all"):
        raise ValueError(f"chance={chance!r}; choose some or all.")
    allowed = model.available if allowed is None else allowed
    traced = is_traced((model, goal, allowed, rule, among))
    most = jnp.iinfo(jnp.int32).max if traced else _MAX_SWEEPS
    among = jnp.ones(model.state_shape, bool) if among is None else among
    found, n, growing = _attractor_sweeps(model, goal, allowed, rule, among, most, chance=chance)
    if traced or not growing:
        return found
    return _attractor_worklist(model, found, int(n), allowed, rule, among, chance)


@partial(jax.jit, static_argnames=("chance",))
def _attractor_sweeps(model, goal, allowed, rule, among, max_sweeps, *, chance):
    leads = exists_successor if chance == "some" else forall_successor

    def body(carry):
        region, action, rank, _, n = carry
        hit = allowed & leads(model, region)
        some, first = first_action(hit)
        joins = jnp.where(rule, some, ~first_action(allowed & ~hit)[0])
        new = joins & among & ~region
        action = jnp.where(new, first, action)
        return region | new, action, jnp.where(new, n + 1, rank), new.any(), n + 1

    def unfinished(carry):
        *_, growing, n = carry
        return growing & (n < max_sweeps)

    _, first = first_action(model.available)
    start = (goal, first, jnp.zeros_like(first), jnp.bool_(True), jnp.int32(0))
    region, action, rank, growing, n = lax.while_loop(unfinished, body, start)
    return Attractor(region, action, rank), n, growing


def avoidable(model: Any, goal: jax.Array, allowed: jax.Array | None = None) -> jax.Array:
    """States from which some policy surely never reaches the goal: ``bool[S]``.

    The complement of the ``"forall"`` attractor; the minimal reachability probability is
    zero exactly there.
    """
    return ~attractor(model, goal, allowed, rule="forall").region


def almost_surely_reaching(
    model: Any,
    goal: jax.Array,
    allowed: jax.Array | None = None,
    *,
    reaching: Attractor | None = None,
) -> Attractor:
    """States from which some policy reaches the goal with probability one.

    The greatest X such that within X, by actions that surely stay in X, the goal is
    reachable (de Alfaro 1997).

    Args:
      model: the model.
      goal: ``bool[S]``.
      allowed: ``bool[S, A]``, the actions that count; default the available ones.
      reaching: ``attractor(model, goal, allowed)``, if it is known already.

    Returns:
      :class:`Attractor`: the region and, outside the goal, the actions of such a policy.
    """
    allowed = model.available if allowed is None else allowed

    def inner(region: jax.Array) -> Attractor:
        # First all states that are forced out, then those that cannot reach the goal inside.
        outside = attractor(model, ~region, allowed, rule="forall", among=~goal).region
        return attractor(model, goal, allowed & forall_successor(model, ~outside))

    found = attractor(model, goal, allowed) if reaching is None else reaching

    def body(carry):
        found, _ = carry
        smaller = inner(found.region)
        return smaller, jnp.any(smaller.region != found.region)

    # A state that cannot reach the goal at all is what removes others.
    start = (found, ~jnp.all(found.region))
    return repeat(body, start, (model, goal, allowed, found))[0]


def _predecessors(successor: np.ndarray, used: np.ndarray) -> Any:
    """World predecessors: column t holds the numbers ``s * A + a`` of the pairs that lead to t."""
    from scipy import sparse  # a tenth of a second that only host graphs need

    num_states, num_actions, width = successor.shape
    rows = num_states * num_actions
    if used.all():
        indptr = np.arange(rows + 1, dtype=np.int32) * width
        indices = successor.reshape(-1)
    else:
        indptr = np.concatenate([[0], used.reshape(rows, width).sum(-1).cumsum()])
        indices = successor[used]
    data = np.ones(indices.size, np.int8)
    return sparse.csr_array((data, indices, indptr), shape=(rows, num_states)).tocsc()


_SCALAR = 24  # transitions into a frontier up to which Python's own loop beats NumPy's overhead


def _attractor_worklist(
    model: Any, found: Attractor, round_: int, allowed: jax.Array, rule: jax.Array,
    among: jax.Array, chance: str,
) -> Attractor:
    """Finishes an attractor after some rounds, touching each transition once."""
    successor, used, next_memory = (np.asarray(x) for x in _support(model))
    num_actions, num_memory = successor.shape[1], next_memory.shape[1]
    into = _predecessors(successor, used)
    on_entry = _label_on(model) == "entry"
    region = np.array(found.region).ravel()
    action, rank = (np.array(x).ravel() for x in (found.action, found.rank))
    open_ = np.array(allowed).ravel()  # pairs that count and do not lead to the region yet
    remaining = open_.reshape(-1, num_actions).sum(-1)
    exists = np.array(rule).ravel()
    blocked = ~np.array(among).ravel()
    missing = np.ones(open_.size, np.int64)  # successors that must still join before a pair leads
    if chance == "all":
        count = used.sum(-1)[:, None, :]
        missing = np.broadcast_to(count, (*next_memory.shape, num_actions)).ravel().copy()

    def leading_to(frontier: np.ndarray) -> np.ndarray:
        """Flat pairs ``(s * Q + q) * A + a`` with a successor in the frontier, one a transition."""
        target, memory = np.divmod(frontier, num_memory)
        count = into.indptr[target + 1] - into.indptr[target]
        offset = np.arange(count.sum()) - np.repeat(count.cumsum() - count, count)
        pair = into.indices[np.repeat(into.indptr[target], count) + offset]
        if num_memory == 1:
            return pair
        s, a = np.divmod(pair, num_actions)
        read = np.repeat(target, count) if on_entry else s
        row, q = np.nonzero(next_memory[read] == np.repeat(memory, count)[:, None])
        return (s[row] * num_memory + q) * num_actions + a[row]

    def join(pairs: np.ndarray) -> np.ndarray:
        """The states that join by pairs that now lead to the region."""
        np.subtract.at(missing, pairs, 1)
        pair = np.unique(pairs[open_[pairs] & (missing[pairs] <= 0)])
        open_[pair] = False
        s, a = np.divmod(pair, num_actions)
        np.subtract.at(remaining, s, 1)
        joins = (exists[s] | (remaining[s] == 0)) & ~region[s] & ~blocked[s]
        frontier, first = np.unique(s[joins], return_index=True)
        action[frontier] = a[joins][first]
        region[frontier] = True
        rank[frontier] = round_
        return frontier

    def join_few(pairs: list[int]) -> list[int]:
        """The same for few pairs, by plain loops."""
        frontier = []
        for pair in sorted(pairs):
            missing[pair] -= 1
            if missing[pair] > 0 or not open_[pair]:
                continue
            open_[pair] = False
            s, a = divmod(pair, num_actions)
            remaining[s] -= 1
            if (exists[s] or remaining[s] == 0) and not region[s] and not blocked[s]:
                action[s], region[s], rank[s] = a, True, round_
                frontier.append(s)
        return frontier

    indptr, indices = into.indptr, into.indices
    frontier: Any = np.flatnonzero(region)
    while len(frontier):
        round_ += 1
        if num_memory == 1 and len(frontier) <= _SCALAR:
            # Along a chain every frontier is small, and there are very many.
            ends = [(indptr[t], indptr[t + 1]) for t in frontier]
            if sum(stop - start for start, stop in ends) <= _SCALAR:
                few = [x for start, stop in ends for x in indices[start:stop].tolist()]
                frontier = join_few(few)
                continue
        frontier = join(leading_to(np.asarray(frontier)))
    shape = found.region.shape
    return Attractor(*(jnp.asarray(x.reshape(shape)) for x in (region, action, rank)))
