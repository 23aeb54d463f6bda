"""Environments of dynamics inside the permissive strategy of a synthesized policy."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.core import validation
from jaxltl.core.continuous.dynamics import to_environment
from jaxltl.core.continuous.synthesis import CellPolicy
from jaxltl.core.environments.environment import Environment, Finite, Timestep, make_environment
from jaxltl.core.games.shielded_environment import ShieldedWorld


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
        Partial(_of_world, inner.observe),
        actions=inner.actions,
        labels=Partial(_of_world, inner.labels),
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


def _of_world(function: Partial, shielded: ShieldedWorld) -> jax.Array:
    result: jax.Array = function(shielded.world)
    return result
