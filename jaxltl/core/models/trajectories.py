"""Trajectories of a model: validation, padding and simulation."""

from __future__ import annotations

from typing import cast

import contextlib
from collections.abc import Sequence
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct, validation
from jaxltl.core.validation import first_true

from jaxltl.core.pretty_print import brief
from jaxltl.core.models.action_numbers import with_action_numbers
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.ops.array_namespace import jax_array, is_traced, namespace, to_jax
from jaxltl.core.models.ops.operators import policy_distribution, sample_successor
from jaxltl.core.models.pomdp import POMDP, policy_of_states
from jaxltl.core.models.protocols import ActionModel, Model, PyTree
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy


struct.register(
    FiniteMemoryPolicy,
    arrays=("action", "initial_memory", "next_memory", "automaton", "letter"),
    static=("label_on",),
    text={"actions": (), "states": ()},
)


@brief
@struct.dataclass
class Trajectories:
    """N sequences of state-action pairs, padded with zeros to length T.

    Attributes:
      state, action: ``int32[N, T]``.
      length: ``int32[N]``, the number of pairs of each.
      state_shape: of the model, ``(S,)`` or in a product ``(S, Q)``; None: unknown. Static.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.make_mdp([[[1]], [[1]]], [[[1.0]], [[1.0]]])
      >>> shown = jl.make_trajectories(path, [[(0, 0), (1, 0)], [(1, 0)]])
      >>> shown.state.tolist(), shown.mask.tolist()
      ([[0, 1], [1, 0]], [[True, True], [True, False]])
    """

    state: jax.Array
    action: jax.Array
    length: jax.Array
    state_shape: tuple[int, ...] | None = struct.field(pytree_node=False, default=None)

    @property
    def mask(self) -> jax.Array:
        """``bool[N, T]``, False in padding."""
        xp, length = namespace(self.length)
        return jax_array(xp.arange(self.state.shape[-1]) < length[..., None])


def make_trajectories(
    model: MDP | DenseMDP, sequences: Sequence[Sequence[tuple[int, int]]]
) -> Trajectories:
    """Validated trajectories of a model from sequences of ``(state, action)`` pairs.

    Args:
      model, sequences: a model, and N sequences of at least one pair each.

    Returns:
      :class:`Trajectories` with N rows.

    Raises:
      ValueError: naming the trajectory, the step and the values (from 0): an unknown state or action,
        an unavailable action, or an impossible transition.

    Example:
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[0, 1.0]], [[0, 1.0]]])
      >>> make_trajectories(world, [[(0, 0), (1, 0)], [(1, 0)]]).length.tolist()
      [2, 1]
    """
    if not len(sequences):
        raise ValueError("there are no trajectories; give at least one.")
    checked = [_pairs(pairs, n) for n, pairs in enumerate(sequences)]
    length = [len(pairs) for pairs in checked]
    state = np.zeros((len(sequences), max(length)), np.int32)
    action = np.zeros_like(state)
    available = np.asarray(model.available)
    for n, pairs in enumerate(checked):
        for t, (s, a) in enumerate(pairs.tolist()):
            where = f"trajectory {n}, step {t}"
            if not 0 <= s < model.num_states:
                raise ValueError(
                    f"{where}: state {s} does not exist; states are 0 to {model.num_states - 1}."
                )
            if not 0 <= a < model.num_actions or not available[s, a]:
                raise ValueError(
                    f"{where}: action {a} is not available in state {s}; "
                    f"available are {np.flatnonzero(available[s]).tolist()}."
                )
            state[n, t], action[n, t] = s, a
    steps = (state, action, np.asarray(length, np.int32))
    _check_steps(model, *steps)
    state, action, length = to_jax(steps)
    return Trajectories(state, action, length, state_shape=model.state_shape)


def _pairs(trajectory: Sequence[tuple[int, int]], number: int) -> np.ndarray:
    """One trajectory as ``int[T, 2]``."""
    if not len(trajectory):
        raise ValueError(f"trajectory {number} is empty; give at least one (state, action) pair.")
    with contextlib.suppress(ValueError):  # ragged
        pairs = np.asarray(trajectory)
        if pairs.shape == (len(trajectory), 2) and pairs.dtype.kind in "iu":
            return pairs
    for t, pair in enumerate(trajectory):
        place = f"trajectory {number}, step {t} is {validation.shorten(pair)}"
        if np.shape(pair) == (3,):
            raise ValueError(
                f"{place}; give (state, action) alone: the next pair has the successor's state."
            )
        if np.shape(pair) == (2,) and np.asarray(pair).dtype.kind == "f":
            raise ValueError(f"{place}; give integers: [(int(s), int(a)) for s, a in pairs].")
        if np.shape(pair) != (2,) or np.asarray(pair).dtype.kind not in "iu":
            raise ValueError(f"{place}; give a pair of integers, (state, action).")
    raise ValueError(
        f"trajectory {number} is {validation.shorten(trajectory)}; give (state, action) pairs."
    )


def require_states(trajectories: Trajectories, model: Model) -> None:
    """Raises ValueError for trajectories of a model with other states."""
    expected, actual = model.state_shape, trajectories.state_shape
    if actual is not None and actual != expected:
        hint = ""
        if len(actual) > len(expected):
            hint = "; project_trajectories(product, trajectories) leaves out the memory"
        elif len(actual) < len(expected):
            hint = "; lift_trajectories(product, trajectories) adds the memory"
        raise ValueError(
            f"the trajectories belong to a model of shape {actual}; expected {expected}{hint}."
        )
    if actual is None and not is_traced(trajectories):
        state = np.where(trajectories.mask, trajectories.state, 0)
        for n, t in first_true((state < 0) | (state >= model.num_states)):
            raise ValueError(
                f"trajectory {n}, step {t}: state {state[n, t]} does not exist; states are 0 to "
                f"{model.num_states - 1}."
            )


def _check_steps(
    model: MDP | DenseMDP, state: np.ndarray, action: np.ndarray, length: np.ndarray
) -> None:
    s, a, t = state[:, :-1], action[:, :-1], state[:, 1:]
    if isinstance(model, DenseMDP):
        possible = np.asarray(model.transition)[s, a, t] > 0
    else:
        hit = np.asarray(model.successor)[s, a] == t[..., None]
        possible = (hit & (np.asarray(model.probability)[s, a] > 0)).any(axis=-1)
    wrong = ~possible & (np.arange(s.shape[1]) < length[:, None] - 1)
    for n, i in first_true(wrong):
        raise ValueError(
            f"trajectory {n}, step {i}: action {a[n, i]} in state {s[n, i]} cannot lead to "
            f"state {t[n, i]}, which is recorded next; the demonstration does not fit the model."
        )


def rollout(
    model: ActionModel | POMDP,
    policy: jax.Array | FiniteMemoryPolicy,
    key: chex.PRNGKey,
    *,
    num_trajectories: int,
    num_steps: int,
    stop: jax.Array | None = None,
) -> Trajectories:
    """Simulated trajectories of a policy.

    Args:
      model: an MDP, a DenseMDP, a SparseMDP, a POMDP or a Product (states then numbered ``s * Q + q``).
      policy: ``float[S, A]`` or ``int32[S]``; ``[S, Q, A]`` or ``[S, Q]`` in a product; or a
        :class:`~jaxltl.core.policies.finite_memory.FiniteMemoryPolicy` of the model, in a POMDP of its
        observations.
      key: a PRNG key, consumed.
      num_trajectories, num_steps: N, and the length T of the longest; static under ``jit``.
      stop: ``bool[S]`` (or ``bool[S, Q]``): a trajectory ends with the pair that enters such a state,
        and has length 0 if it starts in one.

    Returns:
      :class:`Trajectories` with N rows; there is no derivative.

    Raises:
      ValueError: an invalid policy.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.make_mdp([[[1]], [[0]]], [[[1.0]], [[1.0]]], initial=[1, 0])
      >>> policy, key = jnp.zeros(2, jnp.int32), jax.random.key(0)
      >>> rollout(path, policy, key, num_trajectories=2, num_steps=3).state.tolist()
      [[0, 1, 0], [0, 1, 0]]
    """
    if isinstance(model, POMDP):
        policy, model = (
            policy_of_states(model, cast(FiniteMemoryPolicy, policy)),
            to_padded(model.fully_observable),
        )
    elif isinstance(model, SparseMDP):
        if isinstance(policy, FiniteMemoryPolicy) and policy.num_states == model.num_states:
            policy = with_action_numbers(model, policy)
        model = to_padded(model)
    if not isinstance(policy, FiniteMemoryPolicy):
        distribution = policy_distribution(model, policy).reshape(-1, 1, model.num_actions)
        zeros = np.zeros((len(distribution), 1), np.int32)
        policy = FiniteMemoryPolicy(distribution, zeros[:, 0], zeros)
    elif policy.next_memory.shape[:-1] != model.state_shape:
        raise ValueError(
            f"the policy is of a model of {policy.num_states} states, and this one has the shape "
            f"{model.state_shape}; give the model that the policy was projected to."
        )
    nowhere = np.zeros(model.state_shape, bool)
    return cast(
        Trajectories,
        _rollout(
            model, policy, key, nowhere if stop is None else stop, num_trajectories, num_steps
        ),
    )


@partial(jax.jit, static_argnums=(4, 5))
def _rollout(
    model: Model,
    policy: FiniteMemoryPolicy,
    key: chex.PRNGKey,
    stop: jax.Array,
    num_trajectories: int,
    num_steps: int,
) -> Trajectories:
    initial = jnp.log(model.initial.ravel())
    stop = stop.ravel()

    def one(key: chex.PRNGKey) -> tuple[jax.Array, jax.Array, jax.Array]:
        start_key, key = jax.random.split(key)
        start = jax.random.categorical(start_key, initial).astype(jnp.int32)

        def step(at: PyTree, t: jax.Array) -> PyTree:
            action_key, successor_key = jax.random.split(jax.random.fold_in(key, t))
            action = jnp.asarray(policy.act(action_key, at), jnp.int32)
            successor = sample_successor(model, successor_key, at.state, action)
            ended = stop[at.state]
            # A stopped trajectory keeps its state; its pairs are cut off below.
            after = policy.update(at, jnp.where(ended, at.state, successor))
            return jax.tree.map(lambda x, y: y.astype(x.dtype), at, after), (
                at.state,
                action,
                ended,
            )

        begin = jax.tree.map(jnp.asarray, policy.start(start))
        _, (states, actions, ended) = jax.lax.scan(step, begin, jnp.arange(num_steps))
        return states, actions, jnp.sum(~ended).astype(jnp.int32)

    states, actions, length = jax.vmap(one)(jax.random.split(key, num_trajectories))
    mask = jnp.arange(num_steps) < length[:, None]
    return Trajectories(
        jnp.where(mask, states, 0),
        jnp.where(mask, actions, 0),
        length,
        state_shape=model.state_shape,
    )
