"""Zero-shot agents for temporal-logic formulas, conditioned on reach-avoid sequences.

A network reads the world and the remaining reach-avoid sequence. Trained on random sequences
(:func:`~jaxltl.core.environments.sequence_task.sequence_environment`), by PPO or another learner,
it generalises to any formula over the same labels: each state of the formula's automaton has
sequences that lead to acceptance, of which the agent follows the one with the highest value
(Jackermeier and Abate 2025, "DeepLTL"). Automata are translated on the host; their tables are arrays,
so that episodes of different formulas are lanes of one ``vmap``.

Example: the training stages of a network of the letter world, and agents of two formulas. (Only
shapes are shown; nothing is trained.)

  >>> import jax, numpy as np
  >>> from functools import partial
  >>> import jaxltl as jl
  >>> from jaxltl.algos import many_tasks, ppo
  >>> from jaxltl.envs.letter_world import events_seen
  >>> world = jl.envs.letter_world(size=4, letters=3, num_copies=1, horizon=30)
  >>> events = jl.environments.make_events(world.propositions)  # nothing, a, b, c
  >>> network = many_tasks.SequenceNetwork(num_actions=4, events_seen=events_seen, hidden=(8,))
  >>> def problem(longest):  # sequences of up to so many steps
  ...     sampler = jl.environments.sequence_sampler(
  ...         np.arange(3) < longest, reach=[1.0], avoid=[0.5, 0.5], sets=events.any(1))
  ...     return ppo.make_problem(jl.environments.sequence_environment(world, events, sampler), network=network)
  >>> stages, hparams = [problem(1), problem(3)], ppo.Hparams(discount=0.94, num_envs=2)
  >>> curriculum = partial(many_tasks.train_in_stages, init=ppo.init, run=ppo.run, num_chunks=3)
  >>> # state = curriculum(key, stages, hparams).state
  >>> state = jax.eval_shape(lambda key: ppo.init(key, stages[0], hparams), jax.random.key(0))
  >>> formulas = ["F(a & F b)", "!a U b"]
  >>> plan, other = (
  ...     many_tasks.make_plan(x, events, world.propositions, depth=3, max_sequences=2) for x in formulas)
  >>> plan.length.tolist()  # of each state's sequences: first a and then b, then b, then nothing
  [[2, 0], [1, 0], [0, 0]]
  >>> many_tasks.stack_plans([plan, other]).reach.shape  # formulas, Q, M, D, E
  (2, 3, 2, 3, 4)
  >>> agent = many_tasks.sequence_agent(many_tasks.trained(network, state.parameters), plan)
  >>> episode = jax.eval_shape(partial(jl.run_episode, num_steps=30), jax.random.key(1),
  ...                          jl.task_environment(world, formulas[0]), agent)
  >>> episode.action.shape
  (30,)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.algos.common import action_distributions
from jaxltl.algos.common.actor_critic import action_parameters, dense
from jaxltl.algos.common.moments import normalized
from jaxltl.algos.common.networks import NetworkLike, as_network
from jaxltl.algos.common.settings import applied
from jaxltl.core import struct, validation
from jaxltl.core.automata import Automaton, sequences, to_automaton
from jaxltl.core.environments import Agent, TaskObservation, sequence_task
from jaxltl.core.environments.environment import (
    Box,
    Finite,
    as_partial,
    flat_observation,
    require_key,
)
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models.protocols import Array, Key, Numeric, PyTree
from jaxltl.core.pretty_print import brief


class SequenceNetwork(nn.Module):
    """An actor and a critic that read a :class:`~sequence_task.SequenceObservation`.

    With `events_seen`, each place is described by whether the current steps of the sequence reach or
    avoid one of its events, so that a trained network generalises to other events. Otherwise the
    network reads the observation, and an embedding of the sequence's rows.

    Attributes:
      num_actions, shape, hidden, activation, initial_deviation: as of
        :class:`~jaxltl.algos.common.actor_critic.ActorCritic`; hidden layers read both parts.
      events_seen: ``observation -> float[..., E]``, the events at each place, or None; hashable.
      by_name: whether the network with `events_seen` also reads the observation and the sequence's
        rows, for a fixed world.
      detailed: number of steps described so; of later ones the network reads the numbers of events.
      embedding: width of the layer that embeds a step's events.
    """

    num_actions: int = 0
    shape: Sequence[int] = ()
    hidden: Sequence[int] = (64, 64)
    activation: str = "relu"
    initial_deviation: float = 1.0
    events_seen: Callable[[PyTree], jax.Array] | None = None
    by_name: bool = False
    detailed: int = 4
    embedding: int = 32

    @nn.compact
    def __call__(self, observation: PyTree) -> tuple[PyTree, jax.Array]:
        world, (reach, avoid, length) = observation
        kind = jnp.result_type(float)
        depth = reach.shape[0]
        sets = jnp.stack([reach, avoid]).astype(kind)
        ahead = (jnp.arange(depth) < length).astype(kind)
        parts = []
        if self.by_name or self.events_seen is None:
            rows = jnp.concatenate([sets[0], sets[1]], -1)
            layer = nn.Dense(self.embedding, param_dtype=kind, name="events")
            parts += [flat_observation(world), jnp.ravel(nn.relu(layer(rows)) * ahead[:, None])]
        if self.events_seen is not None:
            seen = self.events_seen(world)
            seen = seen.reshape(-1, seen.shape[-1]).astype(kind)
            first_sets = sets[:, : self.detailed]
            parts += [
                jnp.ravel(seen @ first_sets.reshape(-1, first_sets.shape[-1]).T),
                jnp.ravel(sets.mean(-1)),
            ]
        x = jnp.concatenate([*parts, ahead])
        for i, width in enumerate(self.hidden):
            x = getattr(nn, self.activation)(dense(width, np.sqrt(2), f"hidden_{i}")(x))
        actor = action_parameters(self, lambda n: dense(n, 0.01, "actor")(x))
        return actor, dense(1, 1.0, "critic")(x)[0]


@struct.dataclass
class SequencePlan:
    """For each automaton state the sequences that lead to acceptance, shortest first.

    `reach` and `avoid` are ``bool[Q, M, D, E]``, and `length` ``int32[Q, M]``, 0 for padding.
    """

    reach: Array
    avoid: Array
    length: Array


def make_plan(
    formula: Formula | str | Automaton,
    events: ArrayLike,
    propositions: Sequence[str],
    *,
    depth: int,
    max_sequences: int = 16,
) -> SequencePlan:
    """The :class:`SequencePlan` of a `formula`: a formula, its text, or an automaton; made on the host.

    `events`, ``bool[E, P]``, are the labels that occur, as in training, with columns `propositions`;
    `depth` is D, as in training, and `max_sequences` is M, the number of sequences for each state. Not
    differentiable. Raises as :func:`~jaxltl.core.automata.sequences.reach_avoid_sequences`.
    """
    table = sequences.reach_avoid_sequences(
        formula if isinstance(formula, Automaton) else to_automaton(formula),
        events,
        validation.distinct_names("propositions", propositions),
        depth=depth,
        max_sequences=max_sequences,
    )
    return SequencePlan(table.reach, table.avoid, table.length)


def stack_plans(plans: Sequence[SequencePlan]) -> SequencePlan:
    """The `plans` of several tasks, padded to one shape, with a leading axis; ``vmap`` over it.

    Raises:
      ValueError: no plan, or plans of different depths or events.
    """
    plans = validation.sequence("plans", plans)
    for plan in plans:
        validation.instance("plans", plan, SequencePlan, "a list of those of make_plan")
    shapes = [np.shape(plan.reach) for plan in plans]
    if not shapes or len({shape[2:] for shape in shapes}) > 1:
        raise ValueError(
            f"plans have the shapes {shapes}; give some, all of one depth and of the same events."
        )
    states, width = (max(shape[i] for shape in shapes) for i in range(2))

    def padded(x: ArrayLike) -> np.ndarray:
        x = np.asarray(x)
        rest = [(0, 0)] * (x.ndim - 2)
        return np.pad(x, [(0, states - x.shape[0]), (0, width - x.shape[1]), *rest])

    return jax.tree.map(lambda *rows: jnp.stack([padded(x) for x in rows]), *plans)


_FORGETS = 1 / 16  # weight of the newest value in the mean of those of a followed sequence


@brief
class SequenceChoice(NamedTuple):
    """The sequence that an agent follows: automaton `state`, index `sequence`, and recent `worth`.

    >>> SequenceChoice(jnp.int32(0), jnp.int32(1), jnp.array(0.5)).sequence.item()
    1
    """

    state: jax.Array
    sequence: jax.Array
    worth: jax.Array


def sequence_agent(
    network: Callable[..., PyTree],
    plan: SequencePlan,
    *,
    actions: Finite | Box | None = None,
    squash: str = "clip",
    sampled: bool = True,
) -> Agent:
    """An agent for one formula, of a network that was trained on sequences.

    At each new automaton state it selects the sequence with the highest value, and follows it until the
    state changes, or until the value of another exceeds the recent mean of this one's values (with a
    memory of some 16 steps).

    Args:
      network: ``observation -> (parameters of the action, value)``, a ``Partial`` such as
        :func:`trained` makes.
      plan: of the formula; a lane of :func:`stack_plans` under ``vmap``.
      actions: ``environment.actions``; required for a box.
      squash: map of a Gaussian action into its box, ``"clip"`` or ``"tanh"``, as in training.
      sampled: whether actions are sampled; else the most likely one is taken.

    Returns:
      An :class:`~jaxltl.core.environments.episodes.Agent` for observations
      :class:`~jaxltl.core.environments.task_environment.TaskObservation` of that formula.

    Raises:
      ValueError: not a plan or a function, or at the first step Gaussian actions without `actions`.
    """
    validation.instance("plan", plan, SequencePlan, "one of make_plan")
    if actions is not None:
        validation.instance(
            "actions", actions, Finite | Box, "the environment's, environment.actions"
        )
    squash = validation.choice("squash", squash, action_distributions.SQUASHES)
    how = struct.Static((squash, validation.boolean("sampled", sampled)))
    begin = SequenceChoice(jnp.int32(-1), jnp.int32(0), jnp.asarray(0.0))
    return Agent(Partial(_act, (how, actions, as_partial(network, "network"), plan)), begin)


def sequence_policy(
    network: Callable[..., PyTree], plan: SequencePlan, observation: PyTree, memory: Numeric
) -> jax.Array:
    """The action probabilities ``float[A]`` of an agent that selects its sequence anew at every step.

    Of the world's `observation` and the automaton's state `memory`, ``int32[]``, so that
    ``Partial(sequence_policy, network, plan)`` is a policy for
    :func:`~jaxltl.core.values.evaluation.optimality_gap.tabulate_policy`. `network` and `plan` are as for
    :func:`sequence_agent`, for finitely many actions; differentiable in the network's parameters.

    >>> plan = make_plan("F a", np.eye(2, 1, -1, bool), ["a"], depth=1, max_sequences=1)
    >>> def network(observation):  # logits of the events to reach
    ...     return jnp.log(1.0 + observation.sequence.reach[0]), jnp.array(0.0)
    >>> jax.eval_shape(lambda x: sequence_policy(network, plan, x, 0), jnp.zeros(1)).shape
    (2,)
    """
    validation.instance("plan", plan, SequencePlan, "one of make_plan")
    if not (isinstance(memory, jax.Array) and jnp.issubdtype(memory.dtype, jnp.integer)):
        memory = validation.integer("memory", memory)
    actions, values = _evaluate(
        validation.function("network", network), plan, observation, jnp.asarray(memory)
    )
    _actions_of(actions)
    return jax.nn.softmax(actions[jnp.argmax(values)])


def trained(
    network: NetworkLike | Callable[..., PyTree], parameters: PyTree, moments: PyTree = None
) -> Partial:
    """A function ``observation -> (parameters of the action, value)``: a network with parameters.

    A pytree of the `network` without memory, its `parameters`, such as ``state.parameters`` of PPO, and
    the `moments` by which observations were normalised in training, ``state.moments``; None: not.
    """
    return Partial(_applied, struct.Static(as_network(network)), parameters, moments)


def _applied(
    network: struct.Static, parameters: PyTree, moments: PyTree, observation: PyTree
) -> PyTree:
    return applied(network.value, parameters, normalized(moments, observation))


def _actions_of(parameters: PyTree) -> Finite:
    """The actions of logits."""
    if isinstance(parameters, tuple):
        raise ValueError(
            "actions=None, but the network returns a Gaussian; give the environment's, "
            "environment.actions."
        )
    return Finite(parameters.shape[-1])


def _evaluate(
    network: Callable[..., PyTree], plan: SequencePlan, seen: PyTree, state: jax.Array
) -> tuple[PyTree, jax.Array]:
    """Action parameters and values of each sequence of an automaton state."""
    rows = sequence_task.Sequence(
        jnp.asarray(plan.reach)[state],
        jnp.asarray(plan.avoid)[state],
        jnp.asarray(plan.length)[state],
    )
    output = jax.vmap(lambda row: network(sequence_task.SequenceObservation(seen, row)))(rows)
    if (
        not isinstance(output, tuple)
        or len(output) != 2
        or jnp.shape(output[1]) != rows.length.shape
    ):
        shapes = jax.tree.map(lambda x: jnp.shape(x)[1:], output)
        raise ValueError(
            f"network returns {shapes} for an observation; return (parameters of the action, "
            "value), the value a scalar."
        )
    actions, values = output
    return actions, jnp.where(rows.length > 0, values, -jnp.inf)


def _act(
    agent: tuple[struct.Static, Finite | Box | None, Callable[..., PyTree], SequencePlan],
    memory: PyTree,
    observation: PyTree,
    allowed: jax.Array | None,
    key: Key,
) -> tuple[PyTree, PyTree]:
    how, space, network, plan = agent
    squash, sampled = how.value
    if not (hasattr(observation, "world") and hasattr(observation, "memory")):
        validation.instance(
            "observation",
            observation,
            TaskObservation,
            "that of an environment of task_environment, with the formula of the plan",
        )
    validation.instance("memory", memory, SequenceChoice, "the agent's own, agent.memory")
    require_key(key)
    seen, state = observation.world, jnp.argmax(observation.memory).astype(jnp.int32)
    actions, values = _evaluate(network, plan, seen, state)
    best = jnp.argmax(values)
    continues = (memory.state == state) & ~(
        (best != memory.sequence) & (values[best] > memory.worth)
    )
    taken = jnp.where(continues, memory.sequence, best).astype(jnp.int32)
    late = (1 - _FORGETS) * memory.worth + _FORGETS * values[taken]
    worth = jnp.where(continues, late, values[best]).astype(memory.worth.dtype)
    said = jax.tree.map(lambda x: x[taken], actions)
    action = action_distributions.chosen(
        key,
        _actions_of(said) if space is None else space,
        said,
        allowed,
        sampled=sampled,
        squash=squash,
    )
    return action, SequenceChoice(state, taken, worth)


@brief
@dataclass(frozen=True)
class Staged:
    """A run through stages.

    Attributes:
      state: of the learner, at the end.
      metrics: of each chunk of steps, in order.
      stages: ``int[C]``, which problem each chunk was of.
      seconds: ``float[C]``, since the start, compilation included.
    """

    state: PyTree
    metrics: list[PyTree]
    stages: np.ndarray
    seconds: np.ndarray


def train_in_stages(
    key: Key,
    problems: Sequence[PyTree],
    hparams: PyTree,
    *,
    init: Callable[..., PyTree],
    run: Callable[..., PyTree],
    num_chunks: int,
    num_steps: int = 10,
    enough: float | Sequence[float] = 0.9,
    report: Callable[[int, int, PyTree], None] | None = None,
) -> Staged:
    """A curriculum: a learner on one problem after the other, each once the previous is mastered.

    Args:
      key: of ``init``.
      problems: from easy to hard, of the same shapes, so that no stage recompiles, such as PPO's of
        environments that draw longer and longer sequences.
      hparams: of the learner.
      init, run: the learner's, ``ppo.init`` and ``ppo.run``.
      num_chunks: number of calls of `run`.
      num_steps: steps of the learner in each.
      enough: mean return of a chunk's episodes at which the next problem begins; a number, or one for
        each problem but the last.
      report: called after each chunk with its number, its stage and its metrics.

    Raises:
      ValueError: no problem, or a number of thresholds that does not fit.
    """
    problems = validation.sequence("problems", problems)
    for name, function in (("init", init), ("run", run), ("report", report)):
        if function is not None or name != "report":
            validation.function(name, function)
    count = len(problems)
    num_chunks = validation.integer("num_chunks", num_chunks, least=1)
    bars = validation.float_array("enough", enough)
    bars = np.full(max(count - 1, 0), bars) if bars.ndim == 0 else bars
    if count == 0 or bars.shape != (count - 1,) or np.isnan(bars).any():
        raise ValueError(
            f"{count} problems, {len(bars)} thresholds, num_chunks={num_chunks}; give "
            "a problem at least, one threshold fewer than problems, and one chunk."
        )
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
