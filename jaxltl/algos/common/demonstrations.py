"""Simulated demonstrations of a temporal-logic task: satisfying rollouts of an optimal policy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.models import (
    Product,
    Trajectories,
    make_trajectories,
    project_trajectories,
    rollout,
)
from jaxltl.core.models.ops.operators import expectation
from jaxltl.core.types import Solution
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction

_STEP_BYTES = 128  # of a simulated step, measured while demonstrations are made and checked
_LARGEST_BYTES = 4e9


def sample_demonstrations(
    key: jax.Array,
    model: Product,
    num_trajectories: int,
    *,
    length: int = 200,
    discount: float | None = None,
    best: Solution | None = None,
) -> tuple[Trajectories, int]:
    """Satisfying rollouts of the quickest optimal policy of a product, in the world.

    Rollouts of a co-safe formula end where it is satisfied, and are dropped if they need no step or
    more than `length`; others have `length` steps, and are dropped if they violate the formula.

    Args:
      key: random key.
      model: the product of the world with the formula's automaton.
      num_trajectories: number of rollouts.
      length: largest number of steps.
      discount: of the reward 1 for satisfying a co-safe formula, which the policy maximises then;
        default: the quickest policy of those with maximal satisfaction probability.
      best: :func:`~jaxltl.optimal_satisfaction` of the model, if it is known.

    Returns:
      The trajectories, and the number of dropped rollouts.

    Raises:
      ValueError: too many steps for 4 GB, no satisfying rollout, or a discount for a formula that is
        not co-safe.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.gridworld("home . . goal", initial="home")
      >>> runs, dropped = sample_demonstrations(jax.random.key(0), jl.product(world, "F goal"), 2)
      >>> runs.length.tolist(), dropped
      ([3, 3], 0)
    """
    if (size := num_trajectories * (length + 1) * _STEP_BYTES) > _LARGEST_BYTES:
        raise ValueError(
            f"{num_trajectories} rollouts of up to {length} steps would take about {size / 1e9:.3g} "
            f"GB; ask for fewer or shorter ones, at most {_LARGEST_BYTES / 1e9:g} GB."
        )
    best = optimal_satisfaction(model) if best is None else best
    policy, ends = best.policy, model.automaton.is_cosafe
    if discount is not None:
        require_cosafe(model.automaton)
        arriving = expectation(model, model.final.astype(model.dtype))
        reward = jnp.where(model.final[..., None], 0, arriving)
        policy = optimal_value(model, reward, discount).policy
    # One more step than the length separates arrival at the last step from no arrival.
    runs = rollout(
        model,
        policy,
        key,
        num_trajectories=num_trajectories,
        num_steps=length + 1,
        stop=model.final if ends else jnp.asarray(np.asarray(best.upper) <= 0),
    )
    runs = project_trajectories(model, runs)
    states, actions, lengths = (np.asarray(x) for x in (runs.state, runs.action, runs.length))
    satisfying = [
        list(zip(x[: min(n, length)].tolist(), u[: min(n, length)].tolist(), strict=True))
        for x, u, n in zip(states, actions, lengths, strict=True)
        if (0 < n <= length if ends else n > length)
    ]
    if not satisfying:
        raise ValueError(
            f"none of {num_trajectories} synthetic rollouts satisfies the formula within {length} "
            "steps; raise length or discount, or check that it can be satisfied."
        )
    return make_trajectories(model.mdp, satisfying), num_trajectories - len(satisfying)


def require_cosafe(automaton: Automaton) -> None:
    """Raises ValueError unless the formula of an `automaton` has a discounted reward.

    Raises:
      ValueError: the formula is not co-safe.

    Example:
      >>> import jaxltl as jl
      >>> require_cosafe(jl.to_automaton("F goal"))
    """
    if not automaton.is_cosafe:
        raise ValueError(
            "discount is that of the reward for satisfying the formula, which takes a co-safe "
            "formula; leave it out for rollouts of the quickest optimal policy."
        )
