"""Partially observable Markov decision processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core import struct
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.number_source import NumberSource
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.refusals import refuse_traced
from jaxltl.core.models.sparse import Rewards, SparseMDP
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.pretty_print import brief
from jaxltl.core.validation import first_true


@brief
@struct.dataclass
class POMDP:
    """Partially observable Markov decision process; :func:`make_pomdp` builds one.

    A policy reads the observation of each state that it enters and not the state. States of equal
    observation have the same actions, with the same numbers.

    Attributes:
      fully_observable: the same model for policies that see its states. Its maximal values are upper
        bounds of those of the POMDP, its minimal values lower bounds.
      observation: ``int32[S]``, the observation of each state.
      observables: values of named variables in each observation, ``[O]`` each; may be empty.

    Example:
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[0, 0.5, 0.5]], [[1.0, 0, 0]], [[1.0, 0, 0]]])
      >>> pomdp = make_pomdp(world, [0, 1, 1])
      >>> pomdp.num_states, pomdp.num_observations, pomdp.available.tolist()
      (3, 2, [[True], [True]])
    """

    fully_observable: SparseMDP
    observation: Array
    observables: dict[str, Array] = struct.field(default_factory=dict)

    @property
    def num_states(self) -> int:
        """S."""
        return self.fully_observable.num_states

    @cached_property
    def num_observations(self) -> int:
        """O."""
        return int(np.asarray(self.observation).max()) + 1

    @property
    def num_actions(self) -> int:
        """A, one more than the largest action number."""
        return int(self.fully_observable.action_number.max()) + 1

    @property
    def initial(self) -> Array:
        """``float[S]``, the initial belief."""
        return self.fully_observable.initial

    @property
    def label(self) -> Array:
        """``bool[S, P]``, the propositions that hold in each state."""
        return self.fully_observable.label

    @property
    def propositions(self) -> tuple[str, ...]:
        """The P names."""
        return self.fully_observable.propositions

    @property
    def rewards(self) -> dict[str, Rewards]:
        """Named rewards of the fully observable model."""
        return self.fully_observable.rewards

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the probabilities."""
        return self.fully_observable.dtype

    @cached_property
    def available(self) -> Booleans:
        """``bool[O, A]``, the actions in each observation."""
        model = self.fully_observable
        mask = np.zeros((self.num_observations, self.num_actions), bool)
        mask[np.asarray(self.observation)[model.host.state], model.action_number] = True
        return mask

    @property
    def action_names(self) -> tuple[str, ...]:
        """Name of each action number; empty if the states of some observations name them otherwise."""
        model, names = self.fully_observable, [""] * self.num_actions
        if model.action is None or not model.action_names:
            return ()
        for number, name in zip(model.action_number, np.asarray(model.action), strict=True):
            text = model.action_names[name]
            if names[number] not in ("", text):
                return ()
            names[number] = text
        return tuple(names)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """The values of the observables in each observation, ``"x=1, door=0"``; empty without them."""
        columns = [
            [f"{name}={x}" for x in np.asarray(values).tolist()]
            for name, values in self.observables.items()
        ]
        return tuple(map(", ".join, zip(*columns, strict=True)))

    @cached_property
    def row_of_action(self) -> Integers:
        """``int[S, A]``, the row of each action in each state; -1 where it is unavailable."""
        model = self.fully_observable
        table = np.full((self.num_states, self.num_actions), -1)
        table[model.host.state, model.action_number] = np.arange(model.num_rows)
        return table


def make_pomdp(
    model: Model, observation: ArrayLike, *, observables: Mapping[str, ArrayLike] | None = None
) -> POMDP:
    """Validated :class:`POMDP` of a model and the observation of each state.

    Args:
      model: a concrete MDP, DenseMDP or SparseMDP, kept as a SparseMDP.
      observation: ``int[S]``, numbers from 0 on.
      observables: values of named variables in each observation, ``[O]`` each.

    Returns:
      :class:`POMDP`.

    Raises:
      ValueError: another kind of model, an observation for each state that is no number, or two states
        of equal observation with different actions.

    Example:
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[0, 0.5, 0.5]], [[1.0, 0, 0]], [[1.0, 0, 0]]])
      >>> make_pomdp(world, [0, 1, 1]).observation.tolist()
      [0, 1, 1]
    """
    if isinstance(model, Game | IntervalMDP | POMDP) or not hasattr(model, "state_shape"):
        raise ValueError(
            f"make_pomdp: the model is {type(model).__name__}; give an MDP, a DenseMDP or a SparseMDP."
        )
    refuse_traced("make_pomdp", [("model", model), ("observation", observation)])
    sparse = to_sparse(model)
    number = cast(Integers, np.asarray(observation))
    size = sparse.num_states
    if number.shape != (size,) or number.dtype.kind not in "iu":
        raise ValueError(
            f"observation is {number.dtype}{list(number.shape)}; expected integers [{size}], one for "
            "each state."
        )
    for state in first_true((number < 0) | (number >= size)):
        raise ValueError(
            f"observation[{state}] is {number[state]}; number the observations from 0 on, at most "
            f"{size - 1} of {size} states."
        )
    if _different_actions(sparse, number).any():
        sparse = _ordered(sparse)
        _require_equal_actions(sparse, number)
    count = int(number.max()) + 1
    values = {name: np.asarray(x) for name, x in (observables or {}).items()}
    for name, x in values.items():
        if x.shape != (count,):
            raise ValueError(
                f"observables[{name!r}] has shape {x.shape}; expected ({count},), a value for each "
                "observation."
            )
    return POMDP(sparse, number.astype(np.int32), values)


def _ordered(model: SparseMDP) -> SparseMDP:
    """The model with the rows of each state in the order of their actions."""
    if model.action is None:
        return model
    action, host = np.asarray(model.action), model.host
    order = np.lexsort((action, host.state))
    if (order == np.arange(order.size)).all():
        return model
    rows, entry = host.select(host.row_start, order)
    states = np.arange(host.num_states)
    return replace(
        model,
        entry_start=rows.entry_start,
        successor=rows.successor,
        probability=rows.probability,
        action=action[order],
        rewards={name: x.gathered(states, order, entry) for name, x in model.rewards.items()},
        numbers=NumberSource(),  # whose rows are in the other order
    )


def _first_alike(observation: Integers) -> Integers:
    """The first state of equal observation of each state, ``int[S]``."""
    _, first, number = np.unique(observation, return_index=True, return_inverse=True)
    return cast(Integers, first[number.ravel()])


def _row_actions(model: SparseMDP) -> Integers:
    return model.action_number if model.action is None else np.asarray(model.action)


def _different_actions(model: SparseMDP, observation: Integers) -> Booleans:
    """Mask of the states with other actions than the first state of equal observation."""
    host = model.host
    count, action = np.diff(host.row_start), _row_actions(model)
    like = _first_alike(observation)
    different = count != count[like]
    same = ~different[host.state]
    row = host.row_start[like[host.state]] + model.rank
    wrong = np.flatnonzero(same)
    wrong = wrong[action[wrong] != action[row[wrong]]]
    different[host.state[wrong]] = True
    return cast(Booleans, different)


def _require_equal_actions(model: SparseMDP, observation: Integers) -> None:
    """Raises ValueError that names two states of equal observation with different actions."""
    host, like, action = model.host, _first_alike(observation), _row_actions(model)
    for state in first_true(_different_actions(model, observation)):
        listed = []
        for s in (int(like[state]), state):
            numbers = action[host.row_start[s] : host.row_start[s + 1]].tolist()
            listed.append(
                [model.action_names[i] for i in numbers] if model.action_names else numbers
            )
        raise ValueError(
            f"states {like[state]} and {state} have the observation {observation[state]} and different "
            f"actions, {listed[0]} and {listed[1]}; give them different observations, or equal actions."
        )


def observation_numbers(columns: Mapping[str, Array]) -> tuple[Integers, dict[str, Array]]:
    """Numbers ``int[S]`` of the tuples of values of observables ``[S]``, and their values ``[O]``."""
    table = np.stack([np.asarray(x) for x in columns.values()])
    _, first, number = np.unique(table, axis=1, return_index=True, return_inverse=True)
    return cast(Integers, number.ravel()), {
        name: np.asarray(x)[first] for name, x in columns.items()
    }


def belief_filter(pomdp: POMDP, observation: ArrayLike, action: ArrayLike) -> Floats:
    """Beliefs along a trajectory of observations and actions, by the Bayes filter.

    ``b_0(s)`` is the initial belief given the first observation, and ``b_{t+1}(s')`` is proportional to
    ``sum_s b_t(s) P(s' | s, a_t)`` in the states s' of observation ``o_{t+1}`` (Kaelbling, Littman and
    Cassandra 1998).

    Args:
      pomdp: the model.
      observation: ``int[T]``, observed at each step.
      action: ``int[T - 1]`` or more, taken between them; later ones are not read.

    Returns:
      ``float64[T, S]``, probabilities of the states.

    Raises:
      ValueError: an observation or action that is impossible after those before.

    Example:
      >>> from jaxltl import from_dense
      >>> coin = from_dense([[[0, 0.5, 0.5]], [[1.0, 0, 0]], [[1.0, 0, 0]]], initial=[1, 0, 0])
      >>> belief_filter(make_pomdp(coin, [0, 1, 1]), [0, 1, 0], [0, 0]).tolist()
      [[1.0, 0.0, 0.0], [0.0, 0.5, 0.5], [1.0, 0.0, 0.0]]
    """
    seen, did = np.atleast_1d(np.asarray(observation)), np.atleast_1d(np.asarray(action))
    if not seen.size or did.size < seen.size - 1:
        raise ValueError(
            f"action has {did.size} steps for {seen.size} observations; give one observation at least, and "
            "an action between any two."
        )
    of_state, table = np.asarray(pomdp.observation), pomdp.row_of_action
    matrix, belief = pomdp.fully_observable.host.matrix, np.asarray(pomdp.initial, np.float64)
    beliefs = np.zeros((seen.size, pomdp.num_states))
    for t, o in enumerate(seen.tolist()):
        if t:
            a = int(did[t - 1])
            row = table[:, a] if 0 <= a < pomdp.num_actions else np.full(pomdp.num_states, -1)
            held = np.flatnonzero(belief > 0)
            if (row[held] < 0).any():
                raise ValueError(f"action[{t - 1}] is {a}, which is not available there.")
            belief = belief[held] @ matrix[row[held]]
        belief = np.where(of_state == o, belief, 0)
        if not belief.any():
            raise ValueError(f"observation[{t}] is {o}, which cannot follow the steps before it.")
        belief = belief / belief.sum()
        beliefs[t] = belief
    return beliefs


def policy_of_states(pomdp: POMDP, policy: FiniteMemoryPolicy) -> FiniteMemoryPolicy:
    """The policy of a POMDP's observations as one of its states; it acts alike in look-alike states."""
    is_policy = isinstance(policy, FiniteMemoryPolicy)
    if not is_policy or policy.num_states != pomdp.num_observations:
        raise ValueError(
            f"policy is {f'of {policy.num_states} states' if is_policy else type(policy).__name__}; give a "
            f"FiniteMemoryPolicy whose states are the {pomdp.num_observations} observations."
        )
    seen = np.asarray(pomdp.observation)
    table = policy.on_host()
    return table.replace(
        action=table.action[..., seen, :, :] if table.is_random else table.action[..., seen, :],
        initial_memory=table.initial_memory[seen],
        next_memory=table.next_memory[seen],
        letter=None if table.letter is None else np.asarray(table.letter)[seen],
        states=(),
    )
