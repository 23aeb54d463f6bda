"""Synthesis in continuous worlds: policies on cells with certified satisfaction probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.array_types import Array, Booleans, Floats, Integers
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.continuous.abstraction import RefinementLimits, Report
from jaxltl.core.continuous.certificate import Certificate, prove
from jaxltl.core.continuous.dynamics import Dynamics, make_dynamics, to_environment  # noqa: F401 - of the examples
from jaxltl.core.continuous.task_product import TaskProduct
from jaxltl.core.environments.environment import Environment, Finite, Timestep, make_environment
from jaxltl.core.games.shielded_environment import ShieldedWorld, of_world
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.types import require_shape
from jaxltl.core.pretty_print import brief


@brief
@dataclass(frozen=True, eq=False)
class CellPolicy:
    """A policy that looks up the action of a cell and a memory state; with its certificate.

    Attributes:
      certificate: bounds under this policy; its upper bounds are those of all policies.
      actions: ``float[A, m]``.
      action: ``int[Q, C]``, of each memory state and cell.
      allowed: ``bool[Q, C, A]``, actions after which the policy satisfies the formula surely or with
        probability 1 from every successor: a permissive strategy, for learners inside of it see
        :func:`~jaxltl.core.continuous.synthesis.shield_dynamics`. All False where there is none.
      dynamics: the world.
      automaton: of the formula.
      automaton_state: ``int[Q]``, of each memory state.
      memory: ``int[Q', L]``, memory state after reading letter l in automaton state q'.

    Example:
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u, domain=([-1.0], [1.0]), actions=[[-0.2], [0.2]],
      ...     labels={"left": ([-1.0], [-0.5])}, initial=([0.0], [0.5]))
      >>> policy = synthesize_policy(world, "F left", cells=[40])
      >>> at = jnp.array([0.3])
      >>> float(policy.act(policy.start(at), at)[0]) < 0, policy.certificate.initial_bounds
      (True, (1.0, 1.0))
    """

    certificate: Certificate
    actions: Floats
    action: Integers
    allowed: Booleans
    dynamics: Dynamics
    automaton: Automaton
    automaton_state: Integers
    memory: Integers

    def start(self, state: Array) -> Array:
        """Memory state ``int[]`` in an initial state ``float[n]``; JAX or NumPy."""
        return self._read(jnp.asarray(self.automaton.initial), state)

    def update(self, memory: Array, state: Array) -> Array:
        """Memory state after entering a state."""
        return self._read(jnp.asarray(self.automaton_state)[memory], state)

    def act(self, memory: Array, state: Array) -> Array:
        """Action ``float[m]`` in a state of the domain."""
        cell = self.cell(state)
        return jnp.asarray(self.actions, state.dtype)[jnp.asarray(self.action)[memory, cell]]

    def allowed_actions(self, memory: Array, state: Array) -> Array:
        """``bool[A]``: the permissive strategy in a state."""
        return jnp.asarray(self.allowed)[memory, self.cell(state)]

    def nearest_allowed(self, memory: Array, state: Array, action: Array) -> Array:
        """The allowed action ``float[m]`` that is nearest to an action; that of :meth:`act` if none."""
        allowed = self.allowed_actions(memory, state)
        actions = jnp.asarray(self.actions, state.dtype)
        distance = jnp.where(allowed, ((actions - action) ** 2).sum(-1), jnp.inf)
        return jnp.where(allowed.any(), actions[jnp.argmin(distance)], self.act(memory, state))

    def cell(self, state: Array) -> Array:
        """The cell ``int[]`` of a state; the nearest one outside the domain."""
        index = []
        for axis, edges in enumerate(self.certificate.grid.edges):
            # Edges rounded to the state's dtype: states within rounding of an edge may be in either
            # of its cells.
            inner = jnp.asarray(edges[1:-1], state.dtype)
            index.append(jnp.searchsorted(inner, state[axis], side="right"))
        return jnp.ravel_multi_index(tuple(index), self.certificate.grid.shape, mode="clip")

    def _read(self, automaton_state: Array, state: Array) -> Array:
        """The memory state after reading the label of a state."""
        names = list(self.dynamics.propositions)
        columns = np.array([names.index(p) for p in self.automaton.propositions], int)
        label = self.dynamics.label(jnp.asarray(state))[columns]
        letter = jnp.argmax((jnp.asarray(self.automaton.letters) == label).all(-1))
        return jnp.asarray(self.memory)[automaton_state, letter]


def synthesize_policy(
    dynamics: Dynamics,
    formula: str | Formula,
    actions: ArrayLike | None = None,
    *,
    cells: Sequence[int] | None = None,
    tolerance: float = 1e-3,
    threshold: float | None = None,
    max_cells: int = 2**20,
    max_sweeps: int = 1000,
    upper: bool = True,
    report: Report | None = None,
) -> CellPolicy:
    """A policy on cells with certified bounds of its satisfaction probability.

    Lower bounds are least satisfaction probabilities under the policy, over all states of the cells and
    all disturbances; upper bounds are those of every policy over the grid of actions. Winning sets and
    interval iteration are those of :func:`certify_policy`, with a maximum over actions.

    Args:
      dynamics: the world, of :func:`make_dynamics`.
      formula: any LTL formula over the labels.
      actions: ``float[A, m]``; default: the grid of the dynamics.
      cells, tolerance, threshold, max_cells, max_sweeps, upper, report: see :func:`certify_policy`.

    Returns:
      :class:`CellPolicy`.

    Raises:
      ValueError: as :func:`certify_policy`; no grid of actions; more pairs of cells and actions than
        fit, with the bytes.

    Example:
      >>> from jaxltl.core.continuous import gaussian, make_dynamics
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u + w, domain=([-2.0], [2.0]), noise=gaussian(0.1),
      ...     actions=[[-0.3], [0.0], [0.3]], labels={"goal": ([1.0], [1.5])}, initial=([-0.5], [0.5]))
      >>> found = synthesize_policy(world, "F goal", cells=[80], upper=False)
      >>> found.certificate.initial_bounds[0] > 0.999
      True
    """
    validation.instance("dynamics", dynamics, Dynamics, "those of make_dynamics")
    grid = _actions(dynamics, actions)
    limits = RefinementLimits(tolerance, threshold, max_cells, max_sweeps, upper, report)
    certificate, abstraction, bounds = prove(dynamics, formula, dynamics.step, grid, cells, limits)
    task, allowed = bounds.task, abstraction.safe_actions(bounds)
    states = np.array([q for q, _ in task.states])
    table = _memory_table(task)
    return CellPolicy(
        certificate, grid, bounds.action, allowed, dynamics, task.automaton, states, table
    )


def _memory_table(task: TaskProduct) -> Integers:
    """``int[Q', L]``: memory states by automaton state and letter; 0 where none is reachable."""
    number = {pair: i for i, pair in enumerate(task.states)}
    delta, priority = task.automaton.delta, task.automaton.priority
    table = np.zeros(delta.shape, np.int32)
    for q, letter in np.ndindex(*delta.shape):
        to = int(delta[q, letter])
        # Decided states have one memory state, for all priorities that lead there.
        same = next((i for (state, _), i in number.items() if state == to), 0)
        table[q, letter] = number.get((to, int(priority[q, letter])), same)
    return table


def _actions(dynamics: Dynamics, actions: ArrayLike | None) -> Floats:
    """The grid of actions."""
    value = dynamics.actions if actions is None else actions
    if value is None:
        return np.zeros((1, 0))
    if isinstance(value, tuple):
        raise ValueError(
            "the dynamics have a box of actions; give actions=, an array float[A, m] of those that the "
            "policy may choose."
        )
    grid = validation.float_array("actions", value)
    if grid.ndim != 2 or grid.shape[1] != dynamics.num_actions or not len(grid):
        raise ValueError(
            f"actions has shape {list(grid.shape)}; give float[A, {dynamics.num_actions}]."
        )
    return grid


def simulate_cells(
    key: chex.PRNGKey, policy: CellPolicy, state: Array, num_steps: int
) -> tuple[Array, Array, Array]:
    """A simulated run under a policy on cells.

    Args:
      key: random key.
      policy: of :func:`synthesize_policy`.
      state: ``float[n]``, the initial state.
      num_steps: T, static.

    Returns:
      ``(states float[T, n], memory int[T], actions float[T, m])``.

    Example:
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u, domain=([-1.0], [1.0]), actions=[[-0.2], [0.2]],
      ...     labels={"left": ([-1.0], [-0.5])}, initial=([0.0], [0.5]))
      >>> policy = synthesize_policy(world, "F left", cells=[40])
      >>> states, _, _ = simulate_cells(jax.random.key(0), policy, jnp.array([0.1]), 4)
      >>> bool(jnp.allclose(states[:, 0], jnp.array([0.1, -0.1, -0.3, -0.5]), atol=1e-6))
      True
    """
    validation.instance("policy", policy, CellPolicy, "that of synthesize_policy")
    num_steps = validation.integer("num_steps", num_steps, limit=2**31 - 1)
    require_shape("state", state, (policy.dynamics.num_states,))

    def step(
        carry: tuple[jax.Array, Array], key: jax.Array
    ) -> tuple[tuple[jax.Array, Array], tuple[jax.Array, Array, Array]]:
        state, memory = carry
        action = jnp.asarray(policy.act(memory, state))
        after = policy.dynamics.next_state(key, state, action)
        return (after, policy.update(memory, after)), (state, memory, action)

    state = jnp.asarray(state)
    _, trajectory = jax.lax.scan(
        step, (state, policy.start(state)), jax.random.split(key, num_steps)
    )
    states, memory, actions = trajectory
    return states, memory, actions


def shield_dynamics(policy: CellPolicy) -> Environment:
    """The environment of dynamics in which learners keep the guarantee of a synthesized policy.

    Its worlds are :class:`~jaxltl.core.games.shielded_environment.ShieldedWorld`, the state of the
    dynamics and the memory of the policy. In dynamics with a grid of actions the mask ``allowed`` is the
    permissive strategy; in those with a box of actions, an action is replaced by the nearest one of the
    permissive strategy. Where nothing is allowed, the action is that of the policy.

    The formula of the policy can be kept after each step, so that a safety formula is never violated;
    other formulas have to be satisfied by the learner. Noise that is a bounded disturbance may be chosen
    by an adversary.

    Args:
      policy: of :func:`~jaxltl.core.continuous.synthesis.synthesize_policy`.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`; a task is added by
      :func:`~jaxltl.task_environment`.

    Raises:
      ValueError: a policy over other actions than the dynamics' grid.

    Example:
      >>> from jaxltl.core.continuous import make_dynamics, synthesize_policy
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u, domain=([0.0], [1.0]), actions=[[-0.1], [0.1]],
      ...     labels={"pit": ([0.8], [1.0])}, initial=([0.7], [0.75]))
      >>> safe = shield_dynamics(synthesize_policy(world, "G !pit", cells=[40]))
      >>> safe.allowed(safe.reset(jax.random.key(0))).tolist()
      [True, False]
    """
    validation.instance("policy", policy, CellPolicy, "that of synthesize_policy")
    inner, own = to_environment(policy.dynamics), policy.dynamics.actions
    finite = isinstance(inner.actions, Finite)
    if finite and own is not None and not np.array_equal(np.asarray(own), policy.actions):
        raise ValueError(
            f"the policy chooses among {len(policy.actions)} actions that are not the grid of the "
            "dynamics; leave out actions= of synthesize_policy."
        )

    def allowed(shielded: ShieldedWorld) -> jax.Array:
        """The permissive strategy's actions ``bool[A]``, or the policy's one if there are none."""
        memory, cell = shielded.state, policy.cell(shielded.world)
        mask = jnp.asarray(policy.allowed)[memory, cell]
        only = jnp.arange(len(policy.actions)) == jnp.asarray(policy.action)[memory, cell]
        return jnp.where(mask.any(), mask, only)

    nearest = None if finite else Partial(policy.nearest_allowed)
    return make_environment(
        Partial(_reset, inner.reset, Partial(policy.start)),
        Partial(_step, inner.step, Partial(policy.update), nearest),
        Partial(of_world, inner.observe),
        actions=inner.actions,
        labels=Partial(of_world, inner.labels),
        propositions=inner.propositions,
        allowed=allowed if finite else None,
        observations=inner.observations,
        ending=inner.ending,
    )


def _reset(reset: Partial, start: Partial, key: chex.PRNGKey) -> ShieldedWorld:
    state = reset(key)
    return ShieldedWorld(state, start(state))


def _step(
    step: Partial,
    update: Partial,
    nearest: Partial | None,
    shielded: ShieldedWorld,
    action: jax.Array,
    key: chex.PRNGKey,
) -> Timestep:
    if nearest is not None:
        action = nearest(shielded.state, shielded.world, action)
    timestep = Timestep(*step(shielded.world, action, key))
    return timestep._replace(
        world=ShieldedWorld(timestep.world, update(shielded.state, timestep.world))
    )
