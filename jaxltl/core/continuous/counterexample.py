"""Runs of a policy in a continuous world that violate a formula."""

from __future__ import annotations

from dataclasses import replace

import chex
import jax
import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Floats
from jaxltl.core.continuous.certificate import Certificate
from jaxltl.core.continuous.dynamics import Dynamics, to_environment
from jaxltl.core.continuous.learned_policy import Policy, learned_policy
from jaxltl.core.continuous.regions import box
from jaxltl.core.environments.episodes import Episode, make_agent, run_episode
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.logic.ltl import Formula

_RUNS = 1000  # simulated at a time


def counterexample(
    dynamics: Dynamics,
    policy: Policy,
    formula: str | Formula,
    key: chex.PRNGKey,
    certificate: Certificate | None = None,
    num_steps: int = 200,
) -> Floats | None:
    """A simulated run that violates a formula, from the initial cell with the least upper bound.

    A run violates a formula as soon as no continuation satisfies it: every violated safety formula has
    such a run, and a formula such as ``!unsafe U goal`` where a run enters ``unsafe``. No finite run
    violates ``F goal``. Disturbances are uniform, so that a worst case may be missed.

    Args:
      dynamics, policy, formula: as of :func:`certify_policy`.
      key: random key.
      certificate: bounds of the same policy, by which the initial cell is chosen; default: initial
        states are sampled.
      num_steps: longest run; static. One thousand runs are simulated.

    Returns:
      ``float64[T + 1, n]``, the shortest violating run found, its first state initial; None if no run
      violates the formula, which proves nothing.

    Raises:
      ValueError: a policy of another shape, or a proposition that is no label.

    Example:
      >>> from jaxltl.core.continuous import make_dynamics
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u, domain=([0.0], [1.0]), actions=([-1.0], [1.0]),
      ...     labels={"pit": ([0.8], [1.0])}, initial=([0.0], [0.1]))
      >>> run = counterexample(world, lambda x: x * 0 + 0.25, "G !pit", jax.random.key(0))
      >>> len(run), bool(run[-1, 0] >= 0.8)
      (4, True)
    """
    validation.instance("dynamics", dynamics, Dynamics, "those of make_dynamics")
    if certificate is not None:
        cells = np.flatnonzero(certificate.initial)
        low, high = certificate.grid.boxes(cells[[np.argmin(certificate.upper[cells])]])
        first = np.maximum(low, dynamics.initial.low), np.minimum(high, dynamics.initial.high)
        met = (first[0] < first[1]).all(axis=1)
        dynamics = replace(dynamics, initial=box(first[0][met], first[1][met]))
    act = learned_policy(policy, dynamics, formula)
    task = task_environment(to_environment(dynamics), formula)
    agent = make_agent(lambda seen, key: act(seen.world))

    @jax.jit
    def simulated(key: chex.PRNGKey) -> Episode:
        return run_episode(key, task, agent, num_steps=num_steps)

    runs = jax.device_get(jax.vmap(simulated)(jax.random.split(key, _RUNS)))
    violated = np.asarray(runs.world.verdict) == Verdict.VIOLATED
    if not violated.any():
        return None
    steps = np.where(violated.any(axis=1), violated.argmax(axis=1), num_steps + 1)
    run: Floats = np.asarray(runs.world.world[steps.argmin(), : steps.min() + 1], np.float64)
    return run
