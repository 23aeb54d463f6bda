"""Tabulation: the reachable states of a simulated environment as a sparse MDP."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxltl.core import struct, validation
from jaxltl.core.validation import first_true
from jaxltl.core.environments.environment import (
    Environment,
    Finite,
    Timestep,
    allowed_in,
    as_partial,
    marked_results,
    reads_key,
    require_key,
)
from jaxltl.core.environments.episodes import without_time_limit
from jaxltl.core.models.protocols import Array, Key, PyTree
from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.rows import offsets_from_counts

_BATCH = 1024  # states of a batch, at most
_BYTES = 2**26  # bytes of the successors of a batch, at most
_LIVE, _TERMINATED, _TRUNCATED = range(3)
_EVIDENCE = ("keyless", "declared", "keys", "distinct")  # from the strongest to the weakest


@brief
@struct.dataclass
class TabulatedEnvironment:
    """A tabulated environment; see :func:`tabulate`.

    Attributes:
      model: a state for each reachable state of the environment and each way in which the episode
        continues or ends there (ended states are absorbing), with the environment's actions and the
        rewards ``"reward"`` and ``"cost"``, without discounts.
      world: the environment's states, a tree with a leading axis of S.
      start: ``int32[N]``, the initial states.
      terminated, truncated: ``bool[S]``, the absorbing states. Truncated states would continue:
        properties hold for the time before truncation, as in
        :func:`~jaxltl.core.values.evaluation.optimality_gap.optimality_gap`.
      num_steps: the time limit, which is not part of the states, or None; static.
      evidence: the weakest justification of the probabilities, in this order; static. ``"keyless"``:
        the program does not read the key; ``"declared"``: `starts` and `outcomes` agreed with samples;
        ``"keys"``: all sampled keys gave the same result; ``"distinct"``: the caller's `distinct`,
        which the program does not imply.

    >>> over = TabulatedEnvironment(
    ...     make_sparse(None, [0, 1], [0], [1.0]), world=np.array([7]), start=np.array([0]),
    ...     terminated=np.array([True]), truncated=np.array([False]), evidence="declared")
    >>> over.model.num_states, over.world[over.start].tolist(), over.num_steps
    (1, [7], None)
    """

    model: SparseMDP
    world: PyTree
    start: Array
    terminated: Array
    truncated: Array
    num_steps: int | None = struct.field(pytree_node=False, default=None)
    evidence: str = struct.field(pytree_node=False, default="keys")


def tabulate(
    environment: Environment,
    *,
    worlds: PyTree = None,
    max_states: int = 100_000,
    num_keys: int = 4,
    key: Key | None = None,
    distinct: Callable[[PyTree], PyTree] | None = None,
) -> TabulatedEnvironment:
    """The reachable states of an environment and their transition probabilities, as a model.

    Breadth-first search on batches of states, which are equal if their bytes are. A time limit is
    removed and reported as `num_steps`. A random environment needs `starts` and `outcomes`; any other
    must be deterministic: proven if no result depends on the key, else tested with several keys, which
    may miss rare differences (see `evidence`).

    Args:
      environment: with finitely many actions.
      worlds: initial states, equally likely, instead of those of `reset`: a tree with a leading axis,
        such as ``vmap(environment.reset)(keys)``.
      max_states: an upper bound on the number of states.
      num_keys, key: the number of keys for the test, and their source; default ``jax.random.key(0)``.
      distinct: ``world -> tree``, the part of a state that distinguishes it; default: all of it. It may
        omit parts without influence on later steps, such as counters or unused keys.

    Returns:
      :class:`TabulatedEnvironment`.

    Raises:
      ValueError: a box of actions, an undeclared random reset or step, distributions that disagree with
        samples, more than `max_states` states, or a state without an available action.

    >>> from jaxltl import environments, from_dense
    >>> walk = environments.model_environment(
    ...     from_dense([[[0, 1]], [[0, 1]]], initial=[1, 0]))
    >>> table = tabulate(walk)
    >>> table.world.tolist(), table.model.num_rows, table.evidence
    ([0, 1], 2, 'declared')
    """
    inner, limit = without_time_limit(environment)
    max_states = validation.integer("max_states", max_states, least=1)
    num_keys = validation.integer("num_keys", num_keys, least=1, limit=2**20)
    if not isinstance(inner.actions, Finite):
        raise ValueError("tabulate: the actions are a box; only finitely many can be listed.")
    key = jax.random.key(0) if key is None else require_key(key)
    keys = jax.random.split(key, max(num_keys, 2))
    apart = as_partial(_itself if distinct is None else distinct, "distinct")
    kind = _Kind(inner, apart, keys, inner.reset(keys[0]))
    begun, probability, evidence = _begin(kind, environment, worlds)
    listed = _search(kind, begun, max_states)
    idle = "keyless" if _left_out_is_idle(kind) else "distinct"
    initial = np.zeros(len(listed.ended))
    np.add.at(initial, listed.start, probability)
    return TabulatedEnvironment(
        _model(inner, listed, initial),
        _typed(kind, listed.world),
        listed.start,
        listed.ended == _TERMINATED,
        listed.ended == _TRUNCATED,
        limit,
        max(evidence, listed.evidence, idle, key=_EVIDENCE.index),
    )


def _itself(world: PyTree) -> PyTree:
    return world


class _Kind(NamedTuple):
    """The environment, the distinguishing part of its states, test keys, and an example state."""

    environment: Environment
    distinct: Callable[[PyTree], PyTree]
    keys: Array
    like: PyTree


# --- worlds as bytes ------------------------------------------------------------------------------


def _is_key(x: ArrayLike) -> bool:
    return jnp.issubdtype(
        jnp.asarray(x).dtype if not hasattr(x, "dtype") else x.dtype, jax.dtypes.prng_key
    )


def _plain(world: PyTree) -> PyTree:
    """The state with keys as integers, for NumPy."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else jnp.asarray(x), world)


def _typed(kind: _Kind, plain: PyTree) -> PyTree:
    """The inverse of :func:`_plain`."""

    def back(x: Array, y: Array) -> Array:
        if not _is_key(y):
            return x
        return jax.random.wrap_key_data(jnp.asarray(x), impl=jax.random.key_impl(y))

    return jax.tree.map(back, plain, kind.like)


def _bytes(world: PyTree) -> jax.Array:
    """``uint8[W]``, equal for equal states."""

    def of(x: jax.Array) -> jax.Array:
        if jnp.issubdtype(x.dtype, jnp.inexact):
            x = jnp.where(x == 0, jnp.zeros_like(x), x)  # minus zero is zero
        if jnp.issubdtype(x.dtype, jnp.complexfloating):
            x = jnp.stack([x.real, x.imag])
        if x.dtype == bool:
            return x.astype(jnp.uint8).ravel()
        return jax.lax.bitcast_convert_type(x, jnp.uint8).ravel()

    parts = [of(x) for x in jax.tree.leaves(_plain(world))]
    return jnp.concatenate(parts) if parts else jnp.zeros(0, jnp.uint8)


def _rows(table: np.ndarray) -> np.ndarray:
    """Rows of bytes as single comparable values."""
    table = np.ascontiguousarray(table)
    return table.view(np.dtype((np.void, table.shape[-1])))[..., 0]


# --- where it begins ------------------------------------------------------------------------------


def _begin(kind: _Kind, environment: Environment, worlds: PyTree) -> tuple[PyTree, np.ndarray, str]:
    """Initial states, their probabilities, and the evidence."""
    inner = kind.environment
    shape = jax.eval_shape(inner.reset, kind.keys[0])
    if worlds is not None:
        timed = jax.eval_shape(environment.reset, kind.keys[0])
        if environment is not inner and _fits(worlds, timed):
            worlds = worlds[0]
        count = _count("worlds", worlds, shape)
        return _plain(worlds), np.full(count, 1 / count), "keyless"
    drawn = jax.tree.map(np.asarray, _resets(kind))
    seen = _rows(_codes(kind, drawn)[0])
    if inner.starts is not None:
        worlds, probability = inner.starts()
        count, probability = _count("starts", worlds, shape), np.asarray(probability, np.float64)
        if (
            probability.shape != (count,)
            or not (probability >= 0).all()
            or not np.isclose(probability.sum(), 1, rtol=0, atol=1e-5)
        ):
            raise ValueError(
                f"starts: the probabilities have shape {list(probability.shape)} and sum to "
                f"{probability.sum():.9g}; give one for each of the {count} worlds, and 1 in sum."
            )
        possible = np.flatnonzero(probability)
        worlds = _plain(jax.tree.map(lambda x: jnp.asarray(x)[possible], worlds))
        if not np.isin(seen, _rows(_codes(kind, worlds)[0])).all():
            raise ValueError("reset draws a world that starts does not tell; give all of them.")
        return worlds, probability[possible] / probability.sum(), "declared"
    if len(np.unique(seen)) > 1:
        raise ValueError(
            f"tabulate: reset is random, {len(np.unique(seen))} worlds from {len(seen)} keys, and "
            "the environment does not tell how. Give worlds to begin from, or "
            "make_environment(starts=...)."
        )
    one = jax.tree.map(lambda x: x[:1], drawn)
    return one, np.ones(1), "keys" if reads_key(inner.reset, kind.keys[0]) else "keyless"


@jax.jit
def _resets(kind: _Kind) -> PyTree:
    return jax.vmap(lambda key: _plain(kind.environment.reset(key)))(kind.keys)


def _seen(kind: _Kind, world: PyTree) -> jax.Array:
    return _bytes(kind.distinct(world))


@jax.jit
def _codes_of_batch(kind: _Kind, plain: PyTree) -> tuple[jax.Array, jax.Array]:
    def one(x: PyTree) -> tuple[jax.Array, jax.Array]:
        world = _typed(kind, x)
        return _seen(kind, world), kind.environment.labels(world)

    return jax.vmap(one)(plain)


def _codes(kind: _Kind, plain: PyTree) -> tuple[np.ndarray, np.ndarray]:
    """``uint8[N, W]`` and ``bool[N, P]``, the distinguishing bytes of states and their labels."""
    plain = jax.tree.map(np.asarray, plain)
    parts = [
        jax.tree.map(lambda x, n=rows: np.asarray(x)[:n], _codes_of_batch(kind, batch))
        for rows, batch in _batches(plain, len(jax.tree.leaves(plain)[0]), _BATCH)
    ]
    return cast(tuple[np.ndarray, np.ndarray], _joined(parts))


def _fits(worlds: PyTree, shape: PyTree) -> bool:
    same: PyTree = jax.tree.structure(shape)
    return same == jax.tree.structure(worlds) and all(
        np.shape(x)[1:] == y.shape and _same_type(x, y)
        for x, y in zip(jax.tree.leaves(worlds), jax.tree.leaves(shape), strict=True)
    )


def _same_type(x: ArrayLike, like: PyTree) -> bool:
    """True also for NumPy's double-precision numbers in single precision."""
    kind = getattr(x, "dtype", None)
    return kind == like.dtype or (
        isinstance(kind, np.dtype)
        and kind.kind in "biufc"
        and jax.dtypes.canonicalize_dtype(kind) == like.dtype
    )


def _count(name: str, worlds: PyTree, shape: PyTree) -> int:
    lengths = {np.shape(x)[:1] for x in jax.tree.leaves(worlds)}
    if not _fits(worlds, shape) or len(lengths) != 1 or lengths & {(), (0,)}:
        raise ValueError(
            f"{name}: give worlds as reset returns them, each array of its type, with a first axis "
            "more, of the same length."
        )
    return int(lengths.pop()[0])


def _left_out_is_idle(kind: _Kind) -> bool:
    """True proves that no result depends on the parts that `distinct` leaves out."""
    environment = kind.environment

    def listed(world: PyTree, action: PyTree, key: Key) -> PyTree:
        step = Timestep(*environment.step(world, action, key))
        declared = None
        if environment.outcomes is not None:
            each, probability = environment.outcomes(world, action)
            declared = jax.vmap(kind.distinct)(each[0]), tuple(each)[1:5], probability
        mask = allowed_in(environment, world)
        return kind.distinct(step.world), step[1:5], declared, mask, environment.labels(world)

    kept_program = jax.make_jaxpr(kind.distinct)(kind.like).jaxpr
    # Variables that are returned as they are; nothing is known of parts of an array.
    unchanged = {id(x) for x in kept_program.outvars}
    changing = [id(x) not in unchanged for x in kept_program.invars]
    if not any(changing):
        return True
    action = jax.ShapeDtypeStruct((), jnp.int32)
    program = jax.make_jaxpr(listed)(kind.like, action, kind.keys[0]).jaxpr
    return not any(
        marked_results(program, changing + [False] * (len(program.invars) - len(changing)))
    )


# --- the search -----------------------------------------------------------------------------------


class _Followers(NamedTuple):
    """Successors of a batch ``[B, A, K]``, with bytes of states `seen` and of samples `drawn` by key."""

    world: PyTree
    label: Array
    seen: Array
    probability: Array
    reward: Array
    cost: Array
    allowed: Array
    drawn: Array


class _Listed(NamedTuple):
    """The result of the search: of all states, and of the transitions of those that are live."""

    world: PyTree
    label: np.ndarray
    ended: np.ndarray
    start: np.ndarray
    successor: np.ndarray
    followers: _Followers
    evidence: str


def _ended(step: Timestep) -> jax.Array:
    cut = jnp.where(jnp.asarray(step.truncated, bool), _TRUNCATED, _LIVE)
    return jnp.where(jnp.asarray(step.terminated, bool), _TERMINATED, cut).astype(jnp.uint8)


def _follow(kind: _Kind, draws: int, world: PyTree) -> _Followers:
    """The successors of one state, by action."""
    environment = kind.environment

    def seen(step: Timestep) -> jax.Array:
        return jnp.append(_seen(kind, step.world), _ended(step))

    def one(action: PyTree) -> _Followers:
        def draw(key: Key) -> Timestep:
            step = Timestep(*environment.step(world, action, key))
            return Timestep(*jax.tree.map(jnp.asarray, tuple(step)))

        tries = jax.vmap(draw)(kind.keys[:draws])
        drawn = jax.vmap(seen)(tries)
        if environment.outcomes is None:
            step, probability = jax.tree.map(lambda x: x[:1], tries), jnp.ones(1)
            paid = jax.vmap(lambda x: _bytes((x.reward, x.cost)))(tries)
            drawn = jnp.concatenate([drawn, paid], axis=-1)
        else:
            declared, probability = environment.outcomes(world, action)
            probability = jnp.asarray(probability)
            rest = [
                jnp.broadcast_to(jnp.asarray(x), probability.shape) for x in tuple(declared)[1:]
            ]
            step = Timestep(declared[0], *rest)
        return _Followers(
            _plain(step.world),
            jax.vmap(environment.labels)(step.world),
            jax.vmap(seen)(step),
            probability,
            step.reward,
            step.cost,
            jnp.bool_(True),
            drawn,
        )

    every = jax.vmap(one)(jnp.arange(environment.actions.num, dtype=jnp.int32))  # type: ignore[union-attr]
    mask = allowed_in(environment, world)
    return every if mask is None else every._replace(allowed=mask)


@partial(jax.jit, static_argnums=0)  # so that worlds of one shape share one compilation
def _followers(draws: int, kind: _Kind, plain: PyTree) -> _Followers:
    return jax.vmap(lambda x: _follow(kind, draws, _typed(kind, x)))(plain)


def _search(kind: _Kind, begun: PyTree, max_states: int) -> _Listed:
    """Breadth-first search in batches."""
    environment, shape = kind.environment, kind.like
    action = jax.ShapeDtypeStruct((), jnp.int32)
    evidence = "declared"
    if environment.outcomes is not None:
        _count("outcomes", jax.eval_shape(environment.outcomes, shape, action)[0][0], shape)
    else:
        reads = reads_key(environment.step, shape, action, kind.keys[0])
        evidence = "keys" if reads else "keyless"
    draws = 1 if evidence == "keyless" else len(kind.keys)
    one = jax.tree.map(lambda x: x[:1], begun)
    results = jax.tree.leaves(jax.eval_shape(partial(_followers, draws), kind, one))
    width = sum(x.size * x.dtype.itemsize for x in results)
    size = int(np.clip(_BYTES // max(width, 1), 1, _BATCH))

    number: dict[bytes, int] = {}
    ended: list[int] = []
    codes, label = _codes(kind, begun)
    live = np.full((len(codes), 1), _LIVE, np.uint8)
    start, first = _numbered(_rows(np.concatenate([codes, live], axis=1)), number, ended)
    listed = [jax.tree.map(lambda x: np.asarray(x)[first], (begun, label))]
    frontier, successor = listed[0][0], []
    parts: list[_Followers] = []
    while (count := len(jax.tree.leaves(frontier)[0])) > 0:
        new = []
        for rows, batch in _batches(frontier, count, size):
            followers = jax.tree.map(
                lambda x, n=rows: np.asarray(x)[:n], _followers(draws, kind, batch)
            )
            _check(followers, sum(len(x.allowed) for x in parts), evidence == "declared")
            real = followers.allowed[..., None] & (followers.probability > 0)
            before, places = len(ended), np.zeros(real.shape, np.int64)
            places[real], first = _numbered(_rows(followers.seen)[real], number, ended)
            if len(ended) > max_states:
                raise ValueError(
                    f"tabulate: there are more than max_states={max_states} worlds. Allow more, "
                    "take less into a world, or say by distinct= what of it matters."
                )
            successor.append(places)
            parts.append(followers._replace(world=None, label=None, seen=None, drawn=None))
            listed.append(
                jax.tree.map(lambda x, r=real, f=first: x[r][f], (followers.world, followers.label))
            )
            going = np.array(ended[before:], int) == _LIVE
            new.append(jax.tree.map(lambda x, g=going: x[g], listed[-1][0]))
        frontier = _joined(new)
    world, label = _joined(listed)
    return _Listed(
        world,
        label,
        np.array(ended, np.uint8),
        start.astype(np.int32),
        np.concatenate(successor),
        _joined(parts),
        evidence,
    )


def _batches(frontier: PyTree, count: int, size: int) -> Iterator[tuple[int, PyTree]]:
    """Batches of one size, the last one padded, with their numbers of valid rows."""
    for begin in range(0, count, size):
        place = np.minimum(np.arange(begin, begin + size), count - 1)
        yield (
            min(size, count - begin),
            jax.tree.map(partial(np.take, indices=place, axis=0), frontier),
        )


def _numbered(
    rows: np.ndarray, number: dict[bytes, int], ended: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """The state number of each row, ``int[N]``, and the rows that are new."""
    unique, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
    order = np.argsort(first)  # numbers in the order in which worlds are met
    place, new = np.empty(len(unique), np.int64), []
    for i in order:
        code = unique[i].tobytes()
        if (index := number.get(code)) is None:
            index = number[code] = len(ended)
            ended.append(code[-1])
            new.append(first[i])
        place[i] = index
    return place[inverse.reshape(-1)], np.array(new, np.int64)


def _check(followers: _Followers, base: int, declared: bool) -> None:
    """Refuses undeclared randomness, disagreeing distributions and states without actions."""
    stuck = np.flatnonzero(~followers.allowed.any(axis=1))
    if stuck.size:
        raise ValueError(
            f"tabulate: no action is allowed in world {base + stuck[0]}, counted in "
            "the order of the search; end the episode there."
        )
    drawn = _rows(followers.drawn)  # [B, A, N]
    if declared:
        sums = followers.probability.sum(axis=-1, dtype=np.float64)
        bad = (
            (np.abs(sums - 1) > 1e-5) | (followers.probability < 0).any(axis=-1)
        ) & followers.allowed
        for b, a in first_true(bad):
            raise ValueError(
                f"outcomes: of action {a} in world {base + b} the probabilities are "
                f"{followers.probability[b, a].tolist()}; they must be a distribution."
            )
        seen = _rows(followers.seen)
        known = (drawn[..., None] == seen[:, :, None]) & (followers.probability > 0)[:, :, None]
        for b, a in first_true(~known.any(axis=-1).all(axis=-1) & followers.allowed):
            raise ValueError(
                f"outcomes: action {a} in world {base + b} leads to a world that they do not tell; "
                "give every world to which the step may lead, with how the episode ends there."
            )
        return
    for b, a in first_true((drawn != drawn[..., :1]).any(axis=-1) & followers.allowed):
        raise ValueError(
            f"tabulate: step is random: action {a} in world {base + b} leads to "
            f"{len(np.unique(drawn[b, a]))} outcomes from {drawn.shape[-1]} keys, and the "
            "environment does not tell how. Give make_environment(outcomes=...), which tells the "
            "worlds and their probabilities."
        )


# --- as a model -----------------------------------------------------------------------------------


def _joined(parts: list[PyTree]) -> PyTree:
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _model(environment: Environment, listed: _Listed, initial: np.ndarray) -> SparseMDP:
    num_states, live = len(listed.ended), np.flatnonzero(listed.ended == _LIVE)
    followers = listed.followers
    state, action = np.nonzero(followers.allowed)
    successor = listed.successor[state, action]
    columns = [
        np.asarray(x, np.float64)[state, action]
        for x in (followers.probability, followers.reward, followers.cost)
    ]
    # Ended states have a self-loop without reward.
    over = np.flatnonzero(listed.ended != _LIVE)
    owner = np.concatenate([live[state], over])
    order = np.argsort(owner, kind="stable")
    width = successor.shape[1]
    successor = np.concatenate([successor, np.tile(over[:, None], (1, width))])[order].ravel()
    single = np.tile(np.arange(width) == 0, (len(over), 1)).astype(float)
    probability, reward, cost = (
        np.concatenate([x, y])[order].ravel()
        for x, y in zip(columns, (single, 0 * single, 0 * single), strict=True)
    )
    rewards = {"reward": Rewards(transition=reward)}
    if cost.any():
        rewards["cost"] = Rewards(transition=cost)
    return make_sparse(
        offsets_from_counts(np.bincount(owner, minlength=num_states)),
        np.arange(len(owner) + 1) * width,
        successor,
        probability,
        initial=initial,
        label=listed.label,
        propositions=environment.propositions,
        rewards=rewards,
        action=np.concatenate([action, np.zeros(len(over), np.int64)])[order],
    )
