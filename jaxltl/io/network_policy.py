"""Networks as policies to deploy: programs exported by ``jax.export``."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
from jax import export
from numpy.typing import NDArray

from jaxltl.core.array_types import Array, PyTree
from jaxltl.core.automata.automaton import Automaton, letter_index
from jaxltl.core.environments.environment import Environment, allowed_in
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.environments.model_environment import allows_all
from jaxltl.core.environments.task_environment import TaskObservation, task_tables
from jaxltl.core.policies.finite_memory import Controller, Key, Progress
from jaxltl.core.policies.policy_file import Arrays, automaton_of, automaton_text, write_policy_file
from jaxltl.core.pretty_print import brief

_PLATFORMS = ("cpu", "cuda", "tpu")


@brief
@dataclass(frozen=True)
class NetworkPolicy:
    """A policy by a network, as a serialised StableHLO program.

    Attributes:
      stablehlo: ``uint8[N]``, the program, of ``jax.export.deserialize``.
      automaton: of the task, or None without a task.

    Example:
      >>> NetworkPolicy(np.zeros(3, np.uint8)).automaton is None
      True
    """

    stablehlo: NDArray[np.uint8]
    automaton: Automaton | None = None

    @cached_property
    def exported(self) -> export.Exported:
        """The program."""
        return export.deserialize(bytearray(self.stablehlo.tobytes()))

    def start(self, state: PyTree, label: Collection[str] | None = None) -> Progress:
        """The position at the first observation `state`, after reading its label."""
        initial = 0 if self.automaton is None else self.automaton.initial
        return self.update(Progress((), np.asarray(initial), np.asarray(-1)), state, label)

    @property
    def reads_mask(self) -> bool:
        """True if the network was learned with masks of available actions, which ``act`` needs then."""
        _, _, _, allowed = self._inputs
        return allowed is not None

    @property
    def _inputs(self) -> tuple[PyTree, ...]:
        """Shapes of key, memory, observation and mask."""
        arguments, _ = jax.tree.unflatten(self.exported.in_tree, self.exported.in_avals)
        return tuple(arguments)

    def act(self, key: Key, at: Progress, allowed: Array | None = None) -> Array:
        """An action; `allowed` is the mask ``bool[A]`` of available actions, where the network reads one.

        Raises:
          ValueError: an observation of other shapes, or a mask that is missing or is not read.
        """
        if isinstance(key, np.random.Generator):
            data = key.integers(2**32, size=2, dtype=np.uint32)
        else:
            data = np.asarray(jax.random.key_data(jax.random.key(0) if key is None else key))
        _, _, *kinds = jax.tree.leaves(self._inputs)
        if self.reads_mask != (allowed is not None):
            raise ValueError(
                "allowed is None, and the network chooses among the available actions; give their mask, "
                f"bool{list(kinds[-1].shape)}, as in controller.act(allowed=mask)."
                if self.reads_mask
                else "allowed is given, and the network was saved of an environment without masks, so that "
                "it cannot obey one; leave it out, or learn in the masked environment."
            )
        leaves = [*jax.tree.leaves(at.state), *([] if allowed is None else [allowed])]
        shapes, expected = ([np.shape(x) for x in y] for y in (leaves, kinds))
        if shapes != expected:
            raise ValueError(
                f"the observation has arrays of the shapes {shapes}; the network reads {expected}."
            )
        inputs = zip([data, at.memory, *leaves], self.exported.in_avals, strict=True)
        arrays = [jax.numpy.asarray(x, y.dtype) for x, y in inputs]
        arguments, _ = jax.tree.unflatten(self.exported.in_tree, arrays)
        action: Array = self.exported.call(*arguments)
        return action

    def update(self, at: Progress, state: PyTree, label: Collection[str] | None = None) -> Progress:
        """The position at the next observation `state`, after reading its label."""
        if self.automaton is None:
            return Progress(state, at.memory, at.step + 1)
        if label is None:
            raise ValueError(
                "label is None, and the policy is of a task: give the propositions that hold, such "
                f"as {{{self.automaton.propositions[0]!r}}} or set()."
            )
        memory = self.automaton.delta[at.memory, letter_index(self.automaton, label)]
        return Progress(state, np.asarray(memory), at.step + 1)

    def controller(self, seed: int = 0) -> Controller:
        """A :class:`~jaxltl.core.policies.finite_memory.Controller` of this policy."""
        return Controller(self, seed)


def network_policy(arrays: Arrays) -> NetworkPolicy:
    """The network of a policy file."""
    if "stablehlo" not in arrays or arrays["stablehlo"].dtype != np.uint8:
        raise ValueError("the array stablehlo is missing; write the file by save_network.")
    return NetworkPolicy(arrays["stablehlo"].astype(np.uint8), automaton_of(arrays))


def save_network(
    path: str | os.PathLike[str],
    agent: Agent,
    environment: Environment,
    *,
    automaton: Automaton | None = None,
    more: Mapping[str, PyTree] | None = None,
) -> None:
    """Writes the policy of an agent without memory, such as ``ppo.policy(...)``, as a program.

    The program is exported by ``jax.export`` for CPU, CUDA and TPU. Of an environment with masks of
    actions, such as one inside a shield, it reads the mask: ``controller.act(allowed=mask)``.

    Args:
      path: the file, ``.npz``.
      agent: the agent.
      environment, automaton: the environment, and the automaton of its task if it has one.
      more: further arrays by name.

    Raises:
      ValueError: an agent with memory, or a task environment without its automaton.

    Example:
      >>> import tempfile, jaxltl as jl
      >>> world = jl.environments.model_environment(jl.gridworld("a .", initial="a"))
      >>> agent = jl.environments.make_agent(lambda seen, key: 3)  # or ppo.policy(...)
      >>> save_network(path := tempfile.mkdtemp() + "/policy.npz", agent, world)
      >>> robot = jl.io.load_policy(path).controller()
      >>> robot.start(world.observe(world.reset(jax.random.key(0))))
      >>> robot.act()
      3
    """
    arrays = {"stablehlo": np.frombuffer(_program(agent, environment, automaton), np.uint8)}
    if automaton is not None:
        arrays["automaton"] = np.asarray(automaton_text(automaton))
    write_policy_file(path, "network", arrays, more)


def _program(agent: Agent, environment: Environment, automaton: Automaton | None) -> bytes:
    if not isinstance(agent, Agent):
        raise ValueError(
            f"agent is a {type(agent).__name__}; give an Agent, as learner.policy(state, problem, hparams)."
        )
    if jax.tree.leaves(agent.memory):
        raise ValueError("the agent has memory; only agents without memory are exported.")

    def seen(key: Array) -> PyTree:
        world = environment.reset(key)
        return environment.observe(world), allowed_in(environment, world)

    observation, allowed = jax.eval_shape(seen, jax.random.key(0))
    if allows_all(environment):
        allowed = None
    rows = None
    if isinstance(observation, TaskObservation):
        tables = task_tables(environment)
        if automaton is None or len(automaton.delta) != len(tables.delta):
            raise ValueError(
                f"the environment has a task with {len(tables.delta)} memory states; give its "
                "automaton, automaton=jl.to_automaton(formula)."
            )
        rows = np.eye(len(tables.delta)) if tables.embedding is None else tables.embedding
        rows, observation = rows.astype(observation.memory.dtype), observation.world
    leaves, structure = jax.tree.flatten(observation)

    def act(data: jax.Array, memory: jax.Array, leaves: PyTree, allowed: PyTree) -> PyTree:
        key, observation = jax.random.wrap_key_data(data), jax.tree.unflatten(structure, leaves)
        if rows is not None:
            observation = TaskObservation(observation, jax.numpy.asarray(rows)[memory])
        return agent.act((), observation, allowed, key)[0]

    kinds = jax.ShapeDtypeStruct((2,), np.uint32), jax.ShapeDtypeStruct((), np.int32)
    exported = export.export(jax.jit(act), platforms=_PLATFORMS)(*kinds, leaves, allowed)
    return bytes(exported.serialize())
