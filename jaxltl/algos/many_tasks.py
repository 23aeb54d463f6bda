"""One agent for many formulas: it follows sequences of what to reach and what to avoid.

A network reads the world and the sequence that is still to be done. Trained on sequences that are
drawn (:func:`~jaxltl.core.models.sequence_task.sequence_environment`), by PPO or another learner,
it does any formula over the same labels: the automaton of the formula tells, for each of its
states, the sequences that lead to acceptance, and the network's own value which of them to follow
(Jackermeier and Abate 2025, "DeepLTL"). Automata are made on the host once a formula; their tables
are arrays, so that episodes of different formulas are lanes of one ``vmap``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.algos.actor_critic import dense, flat_observation
from jaxltl.core.automata import sequences
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models import sequence_task
from jaxltl.core.models.environment import Agent, as_partial


class SequenceNetwork(nn.Module):
    """An actor and a critic that read a :class:`~sequence_task.SequenceObservation`.

    Where `events_seen` tells which events the agent sees where, each place is described to the
    network by what the sequence says of its events: whether a step wants one of them or avoids one.
    Then a network that was trained on some events does the same on others, for their names have
    gone. Otherwise the observation is given as it is, beside what dense layers make of the
    sequence's rows.

    Attributes:
      num_actions, shape, hidden, activation, initial_deviation: as of PPO's default network.
      events_seen: ``observation -> float[..., E]``, or None; a function of a module.
      detailed: how many steps of the sequence are told so; of those that follow the network knows
        only how many events they ask for and avoid.
      embedding: width of the layer that reads a step's events, without `events_seen`.
    """

    num_actions: int = 0
    shape: Sequence[int] = ()
    hidden: Sequence[int] = (64, 64)
    activation: str = "relu"
    initial_deviation: float = 1.0
    events_seen: Callable[[Any], jax.Array] | None = None
    detailed: int = 4
    embedding: int = 32

    @nn.compact
    def __call__(self, observation: Any) -> tuple[Any, jax.Array]:
        world, (reach, avoid, length) = observation
        kind = jnp.result_type(float)
        depth = reach.shape[0]
        asked = jnp.stack([reach, avoid]).astype(kind)
        ahead = (jnp.arange(depth) < length).astype(kind)
        if self.events_seen is None:
            rows = jnp.concatenate([asked[0], asked[1]], -1)
            layer = nn.Dense(self.embedding, param_dtype=kind, name="events")
            parts = [flat_observation(world), jnp.ravel(nn.relu(layer(rows)) * ahead[:, None])]
        else:
            seen = self.events_seen(world)
            seen = seen.reshape(-1, seen.shape[-1]).astype(kind)
            told = asked[:, : self.detailed]
            parts = [jnp.ravel(seen @ told.reshape(-1, told.shape[-1]).T),
                     jnp.ravel(asked.mean(-1))]
        x = jnp.concatenate([*parts, ahead])
        for i, width in enumerate(self.hidden):
            x = getattr(nn, self.activation)(dense(width, np.sqrt(2), f"hidden_{i}")(x))
        scores = dense(self.num_actions or int(np.prod(self.shape)), 0.01, "actor")(x)
        value = dense(1, 1.0, "critic")(x)[0]
        if self.num_actions:
            return scores, value
        start = nn.initializers.constant(np.log(self.initial_deviation))
        spread = self.param("log_deviation", start, tuple(self.shape), x.dtype)
        return (scores.reshape(self.shape), spread), value


@struct.dataclass
class Plan:
    """For each state of an automaton the sequences that lead to acceptance, shortest first.

    Attributes:
      reach, avoid: ``bool[Q, M, D, E]``.
      length: ``int32[Q, M]``; 0 where there is none.
    """

    reach: chex.Array
    avoid: chex.Array
    length: chex.Array


def make_plan(
    task: Formula | str | Automaton,
    events: ArrayLike,
    propositions: Sequence[str],
    *,
    depth: int,
    most: int = 16,
) -> Plan:
    """The :class:`Plan` of a task; made on the host.

    Args:
      task: the formula, its text, or the automaton whose states the agent will be told.
      events: ``bool[E, P]``, the labels that occur, those that the network was trained on.
      propositions: names of the P columns.
      depth: D, as in training.
      most: M, sequences a state.

    Raises:
      ValueError: as :func:`~jaxltl.core.automata.sequences.reach_avoid_sequences`.
    """
    automaton = task if isinstance(task, Automaton) else to_automaton(task)
    found = sequences.reach_avoid_sequences(
        automaton, events, tuple(propositions), depth=depth, most=most)
    return Plan(found.reach, found.avoid, found.length)


def stack_plans(plans: Sequence[Plan]) -> Plan:
    """Plans of several tasks, padded to one shape, with a leading axis; ``vmap`` over it.

    Raises:
      ValueError: no plan, or plans of different depths or events.
    """
    shapes = [np.shape(plan.reach) for plan in plans]
    if not shapes or len({shape[2:] for shape in shapes}) > 1:
        raise ValueError(f"plans have the shapes {shapes}; give some, all of one depth and of the "
                         "same events.")
    states, most = (max(shape[i] for shape in shapes) for i in range(2))

    def padded(x: Any) -> np.ndarray:
        x = np.asarray(x)
        rest = [(0, 0)] * (x.ndim - 2)
        return np.pad(x, [(0, states - x.shape[0]), (0, most - x.shape[1]), *rest])

    return jax.tree.map(lambda *rows: jnp.stack([padded(x) for x in rows]), *plans)


class Choice(NamedTuple):
    """What an agent has taken up: a state of the automaton, and which of its sequences."""

    state: jax.Array
    sequence: jax.Array


def sequence_agent(
    network: Callable[..., Any], plan: Plan, *, act: Callable[..., Any] | None = None
) -> Agent:
    """The agent of one formula, of a network that was trained on sequences.

    In each state of the automaton that it comes to, it takes the sequence that the network values
    most, and does what the network does for that one until the state changes: choosing anew at
    every step, it might go to and fro between two that are worth the same.

    Args:
      network: ``observation -> (parameters of the action, value)`` of a trained network; a
        ``Partial`` whose arrays are its parameters, such as :func:`trained` makes.
      plan: of the formula; a lane of :func:`stack_plans` under ``vmap``.
      act: ``(parameters of the action, allowed, key) -> action``; default :func:`drawn`.

    Returns:
      An :class:`~jaxltl.core.models.environment.Agent` for observations
      :class:`~jaxltl.core.models.task_environment.TaskObservation` of that formula, one-hot in the
      automaton's state.
    """
    begin = Choice(jnp.int32(-1), jnp.int32(0))
    return Agent(Partial(_act, as_partial(act or drawn), as_partial(network), plan), begin)


def sequence_policy(
    network: Callable[..., Any], plan: Plan, observation: Any, memory: chex.Numeric
) -> jax.Array:
    """``float[A]``: how likely each of finitely many actions is to an agent that chooses anew at
    every step, by the world's observation and the automaton's state alone.

    ``Partial(sequence_policy, network, plan)`` is a policy for
    :func:`~jaxltl.core.values.optimality_gap.tabulate_policy`.
    """
    actions, best = _judged(network, plan, observation, jnp.asarray(memory))
    return jax.nn.softmax(actions[best])


@jax.tree_util.register_static
@dataclass(frozen=True)
class _Module:
    """A network's definition, which is no array."""

    network: nn.Module


def trained(network: nn.Module, parameters: Any) -> Partial:
    """``observation -> (parameters of the action, value)``: a network with its parameters."""
    return Partial(_applied, _Module(network), parameters)


def _applied(module: _Module, parameters: Any, observation: Any) -> Any:
    return module.network.apply({"params": parameters}, observation)


def drawn(parameters: Any, allowed: Any, key: chex.PRNGKey) -> jax.Array:
    """An action drawn from what a network says: of finitely many, or of a Gaussian."""
    if isinstance(parameters, tuple):
        mean, log_deviation = parameters
        return mean + jnp.exp(log_deviation) * jax.random.normal(key, mean.shape, mean.dtype)
    return jax.random.categorical(key, _masked(parameters, allowed)).astype(jnp.int32)


def likeliest(parameters: Any, allowed: Any, key: chex.PRNGKey) -> jax.Array:
    """The action that a network thinks likeliest; of a Gaussian its mean."""
    del key
    if isinstance(parameters, tuple):
        return parameters[0]
    return jnp.argmax(_masked(parameters, allowed)).astype(jnp.int32)


def _masked(scores: jax.Array, allowed: Any) -> jax.Array:
    return scores if allowed is None else jnp.where(allowed, scores, -jnp.inf)


def _judged(
    network: Callable[..., Any], plan: Plan, seen: Any, state: jax.Array
) -> tuple[Any, jax.Array]:
    """What the network would do for each sequence of a state, and which it values most."""
    rows = sequence_task.Sequence(
        jnp.asarray(plan.reach)[state], jnp.asarray(plan.avoid)[state],
        jnp.asarray(plan.length)[state])
    actions, values = jax.vmap(
        lambda row: network(sequence_task.SequenceObservation(seen, row)))(rows)
    return actions, jnp.argmax(jnp.where(rows.length > 0, values, -jnp.inf))


def _act(
    act: Callable[..., Any], network: Callable[..., Any], plan: Plan, memory: Any, observation: Any,
    allowed: Any, key: chex.PRNGKey,
) -> tuple[Any, Any]:
    seen, state = observation.world, jnp.argmax(observation.memory).astype(jnp.int32)
    actions, best = _judged(network, plan, seen, state)
    taken = jnp.where(memory.state == state, memory.sequence, best).astype(jnp.int32)
    chosen = jax.tree.map(lambda x: x[taken], actions)
    return act(chosen, allowed, key), Choice(state, taken)


@dataclass(frozen=True)
class Staged:
    """A run through stages.

    Attributes:
      state: of the learner, at the end.
      metrics: of each chunk of steps, in order.
      stages: ``int[C]``, which problem each chunk was of.
      seconds: ``float[C]``, since the start, compilation included.
    """

    state: Any
    metrics: list[Any]
    stages: np.ndarray
    seconds: np.ndarray


def train_in_stages(
    key: chex.PRNGKey,
    problems: Sequence[Any],
    hparams: Any,
    *,
    init: Callable[..., Any],
    run: Callable[..., Any],
    num_chunks: int,
    num_steps: int = 10,
    enough: float | Sequence[float] = 0.9,
    report: Callable[[int, int, Any], None] | None = None,
) -> Staged:
    """A curriculum: a learner on one problem after the other, each once the one before is mastered.

    Args:
      key: of ``init``.
      problems: from easy to hard, of the same shapes, such as PPO's of environments whose samplers
        draw longer and longer sequences; then no stage compiles anew.
      hparams: of the learner.
      init, run: the learner's, ``ppo.init`` and ``ppo.run``.
      num_chunks: how many times `run` is called.
      num_steps: steps of the learner each time.
      enough: the next problem is taken up when the mean return of the episodes that ended in a
        chunk reaches this; a number, or one for each problem but the last.
      report: called after each chunk with its number, its stage and its metrics.

    Returns:
      :class:`Staged`.

    Raises:
      ValueError: no problem, or a number of thresholds that does not fit.
    """
    count = len(problems)
    bars = np.full(max(count - 1, 0), enough, float) if np.ndim(enough) == 0 else np.asarray(
        enough, float)
    if count == 0 or num_chunks < 1 or len(bars) != count - 1:
        raise ValueError(f"{count} problems, {len(bars)} thresholds, num_chunks={num_chunks}; give "
                         "a problem at least, one threshold fewer than problems, and one chunk.")
    begin, stage = time.perf_counter(), 0
    state = init(key, problems[0], hparams)
    rows, stages, seconds = [], [], []
    for chunk in range(num_chunks):
        state, metrics = run(state, problems[stage], hparams, num_steps=num_steps)
        rows.append(jax.tree.map(np.asarray, metrics))
        stages.append(stage)
        seconds.append(time.perf_counter() - begin)
        if report is not None:
            report(chunk, stage, rows[-1])
        returns, ended = rows[-1].episode_return, rows[-1].episodes
        mean = np.nansum(returns * ended) / max(ended.sum(), 1)
        if stage < count - 1 and ended.sum() and mean >= bars[stage]:
            stage += 1
    return Staged(state, rows, np.array(stages), np.array(seconds))
