"""Symbol grounding problems: data, settings, and the likelihood of demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from numpy.typing import ArrayLike

from jaxltl.algos.common import optimizers
from jaxltl.algos.common.networks import NetworkLike, as_network
from jaxltl.algos.common.settings import (
    Number,
    applied,
    finite_features,
    require_output,
    static,
    traced,
)
from jaxltl.core import struct
from jaxltl.core.array_types import PyTree
from jaxltl.core.automata import Automaton, to_automaton
from jaxltl.core.automata.language import is_empty, is_universal
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models import MDP, Product, Trajectories, expectation, make_trajectories
from jaxltl.core.models.construct.batch import stack_observations, stack_products, unstack_product
from jaxltl.core.models.ops.array_namespace import namespace, to_jax
from jaxltl.core.validation import Range, errors_in
from jaxltl.core.values.discounted.soft import policy_logits, soft_value


_MAX_SYMBOLS = 10  # 2^P letters


class LinearGrounding(nn.Module):
    """Logits of the symbols, linear in the observation: ``float[..., O] -> float[..., P]``.

    Attributes:
      num_symbols: P.

    >>> network = LinearGrounding(2)
    >>> jax.eval_shape(network.init_with_output, jax.random.key(0), jnp.zeros((5, 3)))[0].shape
    (5, 2)
    """

    num_symbols: int

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        return nn.Dense(self.num_symbols, kernel_init=nn.initializers.normal(1.0))(observation)


@struct.dataclass
class Problem:
    """Worlds, observations, demonstrations, and a task over symbols without a labelling.

    Attributes:
      model: products of W worlds with the task's automaton; their letters are unknown, and those
        here have no meaning.
      observation: ``float[W, S, O]``, of each world state.
      world: ``int32[N]``, the world of each demonstration.
      state, action: ``int32[N, T]``, the demonstrations, padded with zeros.
      length: ``int32[N]``, their numbers of steps.
      event: ``float[Q, L]``, the event reward: that of a transition of the automaton, in units of
        ``scale``; see :func:`event_reward`.
      features: ``float[W, S, Q, A, F]`` of a linear reward added to the event reward; F may be 0.
      network: the grounding, ``float[..., O] -> float[..., P]`` logits; static.
    """

    model: Product
    observation: jax.Array
    world: jax.Array
    state: jax.Array
    action: jax.Array
    length: jax.Array
    event: jax.Array
    features: jax.Array
    network: NetworkLike = struct.field(pytree_node=False)

    @property
    def symbols(self) -> tuple[str, ...]:
        """`[P]` names, the propositions of the automaton."""
        return self.model.automaton.propositions


@struct.dataclass
class Hparams:
    """Settings; numbers are traced.

    Attributes:
      discount: in [0, 1), of the demonstrator; default 0.95.
      scale: positive; first value of the learned inverse temperature, the reward of an accepting
        event; default 10.
      l2: at least 0; precision of the Gaussian prior on the grounding's parameters and on the weights
        of features; default 1e-2.
      entropy_weight: at least 0; weight of the mean entropy of the letters, which hardens the grounding;
        default 0.
      learning_rate: default 0.1.
      optimizer: the name of one of optax; static; default ``"adam"``.
    """

    discount: Number = traced("discount", default=0.95)
    scale: Number = traced(Range(0, open_below=True, open_above=True), default=10.0)
    l2: Number = traced(Range(0, open_above=True), default=1e-2)
    entropy_weight: Number = traced(Range(0, open_above=True), default=0.0)
    learning_rate: Number = traced(Range(0, open_above=True), default=0.1)
    optimizer: str = static(optimizers.NAMES, default="adam")


def make_problem(
    worlds: MDP | Sequence[MDP],
    observation: ArrayLike | Sequence[ArrayLike],
    demonstrations: Trajectories | Sequence[Trajectories],
    formula: Automaton | Formula | str,
    *,
    network: NetworkLike | Callable[..., PyTree] | None = None,
    features: ArrayLike | None = None,
) -> Problem:
    """A checked :class:`Problem`.

    Args:
      worlds: a world, or several with the same actions; their labels are not read.
      observation: ``float[S, O]``, or one for each world: what is seen in each state.
      demonstrations: of a world, or one batch for each world; states and actions alone.
      formula: a formula over P symbols without a meaning yet, or its automaton, co-safe, safety or Buchi.
      network: the grounding ``float[..., O] -> float[..., P]``, of
        :func:`~jaxltl.algos.common.networks.as_network`; default :class:`LinearGrounding`.
      features: ``float[S, Q, A, F]``, or one for each world, of a linear reward added to the event reward;
        default none.

    Raises:
      ValueError: a formula that no word or every word satisfies, or that needs parity acceptance;
        observations, features or a network of another shape; demonstrations that do not fit.

    >>> import jaxltl as jl
    >>> path = jl.make_mdp([[[1]], [[1]]], [[[1.0]], [[1.0]]])
    >>> shown = jl.make_trajectories(path, [[(0, 0), (1, 0)]])
    >>> make_problem(path, jnp.eye(2), shown, "F goal").symbols
    ('goal',)
    """
    worlds = [worlds] if isinstance(worlds, MDP) else list(worlds)
    several = [demonstrations] if isinstance(demonstrations, Trajectories) else demonstrations
    automaton = require_task(formula)
    blank = [
        replace(
            world,
            label=jnp.zeros((world.num_states, len(automaton.propositions)), bool),
            propositions=automaton.propositions,
        )
        for world in worlds
    ]
    model = stack_products(blank, automaton, label_on="entry")
    observation = stack_observations(model, _padded(observation, worlds))
    world, state, action, length = joined_demonstrations(worlds, several)
    network = LinearGrounding(len(automaton.propositions)) if network is None else network
    network = as_network(network)
    logits = (*observation.shape[:-1], len(automaton.propositions))
    subject = "the grounding's logits have"
    require_output(subject, network, (observation,), logits, "one for each symbol.")
    return Problem(
        model=model,
        observation=observation,
        world=world,
        state=state,
        action=action,
        length=length,
        event=jnp.asarray(event_reward(automaton), model.dtype),
        features=_features(model, features),
        network=network,
    )


def require_task(formula: Automaton | Formula | str) -> Automaton:
    """The automaton of a task that some words satisfy and some violate; ValueError otherwise."""
    automaton = formula if isinstance(formula, Automaton) else to_automaton(formula)
    text = f"the task {formula}" if not isinstance(formula, Automaton) else "the task"
    if not automaton.propositions:
        raise ValueError(f"{text} has no symbols; there is nothing to ground.")
    if len(automaton.propositions) > _MAX_SYMBOLS:
        raise ValueError(
            f"{text} has {len(automaton.propositions)} symbols; at most {_MAX_SYMBOLS} are supported."
        )
    if is_empty(automaton):
        raise ValueError(
            f"{text} is unsatisfiable, so that no demonstration follows it; change it."
        )
    if is_universal(automaton):
        raise ValueError(
            f"{text} is satisfied by every word, so that nothing can be learned from it."
        )
    if automaton.is_parity:
        raise ValueError(
            f"{text} needs parity acceptance, which has no reward of single events; give a co-safe, "
            "safety or Buchi task."
        )
    return automaton


def event_reward(automaton: Automaton) -> jax.Array:
    """The event reward ``float[Q, L]``: 1 where a task is completed, -1 where it is violated.

    Of an `automaton` that is co-safe 1 on entering a final state; of a safety task -1 on leaving the final states; of
    a Buchi task 1 on each accepting transition.

    >>> event_reward(to_automaton("F a")).tolist()
    [[0.0, 1.0], [0.0, 0.0]]
    """
    _, own = namespace(automaton)
    if not own.has_final_states:
        return to_jax((own.priority == 0).astype(float))
    return to_jax(own.final[own.delta].astype(float) - own.final[:, None])


def joined_demonstrations(
    worlds: Sequence[MDP], several: Sequence[Trajectories]
) -> tuple[jax.Array, ...]:
    """World, states, actions and lengths of the demonstrations of all worlds, checked."""
    if len(several) != len(worlds):
        raise ValueError(
            f"there are demonstrations in {len(several)} worlds; expected {len(worlds)}."
        )
    batches, number = [], []
    for w, (world, batch) in enumerate(zip(worlds, several, strict=True)):
        columns = (np.asarray(x).tolist() for x in (batch.state, batch.action, batch.length))
        rows = [list(zip(s[:n], a[:n], strict=True)) for s, a, n in zip(*columns, strict=True) if n]
        if rows:
            with errors_in(f"demonstrations in world {w}: "):
                batches.append(make_trajectories(world, rows))
            number += [w] * len(rows)
    if not batches:
        raise ValueError("there are no demonstrations; give at least one.")
    width = max(x.state.shape[1] for x in batches)
    state, action = (
        np.concatenate([np.pad(x, ((0, 0), (0, width - x.shape[1]))) for x in tables])
        for tables in ([x.state for x in batches], [x.action for x in batches])
    )
    length = np.concatenate([np.asarray(x.length) for x in batches])
    return to_jax((np.asarray(number, np.int32), state, action, length))


def _padded(observation: ArrayLike | Sequence[ArrayLike], worlds: Sequence[MDP]) -> np.ndarray:
    """Observations ``[W, S, O]`` of worlds padded to the largest; ValueError names the world."""
    if isinstance(observation, list | tuple):
        tables = [np.asarray(x) for x in observation]
        tables = tables if tables and tables[0].ndim > 1 else [np.asarray(observation)]
    else:
        table = np.asarray(observation)
        tables = list(table) if table.ndim == 3 else [table]
    if len(tables) != len(worlds):
        raise ValueError(f"there are observations of {len(tables)} worlds; expected {len(worlds)}.")
    width = tables[0].shape[1] if tables[0].ndim == 2 else "O"
    num_states = max(world.num_states for world in worlds)
    for w, (x, world) in enumerate(zip(tables, worlds, strict=True)):
        if x.ndim != 2 or x.shape != (world.num_states, width):
            raise ValueError(
                f"world {w}: observation has shape {x.shape}; "
                f"expected ({world.num_states}, {width}), one row for each state."
            )
    # As in the last state: padding adds no kind of observation.
    return np.stack([np.pad(x, ((0, num_states - len(x)), (0, 0)), "edge") for x in tables])


def _features(model: Product, features: ArrayLike | None) -> jax.Array:
    lane = unstack_product(model, 0)
    shape = (len(model.letter), *lane.state_shape, model.mdp.available.shape[-1])
    if features is None:
        return jnp.zeros((*shape, 0), model.dtype)
    values = np.asarray(features)
    values = values[None] if values.ndim == 4 else values
    return finite_features("features", values, shape, model.dtype)


_TOLERANCE = 1e-3  # of soft values: changes a log-likelihood by as much a step
NEVER = -1e30  # logarithm of probability 0: finite, so that derivatives stay finite


def letter_log_probability(
    network: NetworkLike, parameters: PyTree, observation: jax.Array, letters: jax.Array
) -> jax.Array:
    """``log lambda(l | s)``, ``float[..., L]``: independent symbols, conditioned on an existing letter.

    The softmax over letters of the sum of their symbols' logits: with all ``2^P`` letters the product
    of Bernoulli distributions of the symbols.
    """
    logits = applied(network, parameters, observation)
    return jax.nn.log_softmax(logits @ jnp.asarray(letters).T.astype(logits.dtype), axis=-1)


def memory_log_moves(log_letter: jax.Array, delta: jax.Array) -> jax.Array:
    """``log M(s, q, q')``, ``float[..., Q, Q]``, of letters ``float[..., L]`` and ``int32[Q, L]``."""
    to = jnp.asarray(delta)[:, None, :] == jnp.arange(len(delta))[:, None]  # [Q, Q', L]
    return jax.nn.logsumexp(jnp.where(to, log_letter[..., None, None, :], NEVER), axis=-1)


def soft_product(world: MDP, moves: jax.Array) -> MDP:
    """The MDP on states ``s * Q + q`` in which the memory moves with ``M``, ``float[S, Q, Q]``.

    Differentiable in `moves`. The successors of ``(s, q)`` are ``(t, q')`` with probability
    ``P(t | s, a) M(t, q, q')``.
    """
    num_memory = moves.shape[-1]
    count, actions, width = world.successor.shape
    after = moves[world.successor]  # [S, A, K, Q, Q']
    probability = world.successor_probability[..., None, None] * after
    probability = jnp.moveaxis(probability, 3, 1)  # [S, Q, A, K, Q']
    successor = world.successor[..., None] * num_memory + jnp.arange(num_memory)
    rows = (count * num_memory, actions)
    successor = jnp.broadcast_to(successor[:, None], probability.shape)
    return MDP(
        successor=successor.reshape(*rows, width * num_memory),
        probability=probability.reshape(*rows, width * num_memory),
        available=jnp.repeat(world.available, num_memory, axis=0),
        initial=jnp.zeros(rows[0], probability.dtype),
        label=jnp.zeros((rows[0], 0), bool),
    )


def mean_event_reward(world: MDP, letter: jax.Array, event: jax.Array) -> jax.Array:
    """Expected reward ``float[S, Q, A]`` of the next event ``float[Q, L]``, by letters ``float[S, L]``."""
    return jax.vmap(lambda row: expectation(world, letter @ row), out_axes=1)(event)


def demonstrator_policy(model: Product, scale: Number, discount: Number) -> jax.Array:
    """The demonstrator's policy for a task with known labels, ``float[S, Q, A]``.

    The soft policy of the event reward in a `model` with the task: the events of
    :func:`~jaxltl.algos.grounding.problem.event_reward` times `scale`, at a `discount`.

    >>> import jaxltl as jl
    >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[0, 1.0], [1.0, 0]]], label={"g": [1]})
    >>> policy = demonstrator_policy(jl.product(world, "F g"), 5.0, 0.9)
    >>> round(policy[0, 0, 0].item(), 2)
    0.69
    """
    event = jnp.asarray(event_reward(model.automaton), model.dtype)
    return jnp.exp(demonstrator_log_policy(model, event, scale, discount))


def demonstrator_log_policy(
    model: Product, event: jax.Array, scale: Number, discount: Number
) -> jax.Array:
    """Logarithm of the soft policy of events ``float[Q, L]`` in a product, ``float[S, Q, A]``."""
    letter = jax.nn.one_hot(model.letter, event.shape[1], dtype=model.dtype)
    reward = scale * mean_event_reward(model.mdp, letter, event)
    solution = soft_value(model, reward, discount, tolerance=_TOLERANCE)
    return jax.nn.log_softmax(policy_logits(model, reward, discount, solution.value), axis=-1)


def forward(start: jax.Array, emit: jax.Array, move: jax.Array, length: jax.Array) -> jax.Array:
    """Log-likelihood ``float[]`` of a sequence with a hidden memory, by the forward recursion.

    Args:
      start: ``float[Q]``, logarithms of the first memory's probabilities.
      emit: ``float[T, Q]``, log-likelihoods of the steps in each memory state.
      move: ``float[T - 1, Q, Q]``, ``log M`` between the steps.
      length: ``int32[]``, number of steps that count.
    """

    def step(alpha: jax.Array, data: tuple[jax.Array, ...]) -> tuple[jax.Array, None]:
        emitted, moved, inside = data
        after = jax.nn.logsumexp(alpha[:, None] + moved, axis=0) + emitted
        return jnp.where(inside, after, alpha), None

    inside = jnp.arange(1, len(emit)) < length
    alpha, _ = jax.lax.scan(step, start + emit[0], (emit[1:], move, inside))
    total = jax.nn.logsumexp(alpha)
    return jnp.where(total > NEVER / 2, total, -jnp.inf)


def certain_memory(model: Product, state: jax.Array) -> jax.Array:
    """Memory states ``int32[T]`` along states ``int32[T]`` of a product with known letters."""
    letter = model.letter[state]
    first = model.automaton.delta[model.automaton.initial, letter[0]]

    def read(memory: jax.Array, one: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = model.automaton.delta[memory, one]
        return after, after

    _, rest = jax.lax.scan(read, first, letter[1:])
    return jnp.concatenate([first[None], rest])
