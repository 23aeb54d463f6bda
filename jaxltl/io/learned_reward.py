"""Files of learned reward networks, and planning with them in new environments.

Example:
  >>> import tempfile, jax, numpy as np, jaxltl as jl
  >>> from jaxltl.io.learned_reward import LearnedReward, load_reward, plan_in, save_reward
  >>> linear = {"kernel": np.zeros((5, 1)), "bias": np.zeros(1)}  # of seen, memory and action
  >>> learned = LearnedReward(
  ...     parameters={"params": linear}, hidden=(), memory=jl.to_automaton("F g"),
  ...     label_on="exit", discount=0.9, horizon=None, radius=0, formula="F g",
  ...     kinds=("plain", "goal"))
  >>> path = tempfile.mkdtemp() + "/reward.npz"
  >>> save_reward(path, learned)
  >>> again = load_reward(path)
  >>> world = jl.from_dense([[[0.5, 0.5]], [[0, 1.0]]], label=[[0], [1]], propositions=["g"])
  >>> jax.eval_shape(lambda seen: plan_in(again, world, seen)[1], np.eye(2)).policy.shape
  (2, 2, 1)
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from numpy.typing import ArrayLike

from jaxltl.algos import todirl
from jaxltl.core.files import atomic_write, read_arrays
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.text import from_dict, to_dict
from jaxltl.core.models import MDP, Product, product
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.types import Solution, worst
from jaxltl.core.values.undiscounted.mixture import practical_policy, reaching, require_attainable
from jaxltl.core.values.undiscounted.optimal_actions import optimal_actions


@dataclass(frozen=True)
class LearnedReward:
    """Reward network over observation, memory state and action, with its planning settings.

    Attributes:
      parameters: of ``RewardNetwork(hidden)``, ``{"params": ...}``.
      hidden: widths of the hidden layers.
      memory: automaton; its state is an input of the network.
      label_on: label that a product step reads.
      discount, horizon: of the learner; the horizon may be None.
      radius: radius of the observed neighbourhood.
      formula: task formula.
      kinds: names of the one-hot components of an observed cell.
      guarantee: ``"best"`` restricts plans to optimal actions for the formula; a probability mixes
        in the least sufficient share of them; ``"none"``.
      over: initial states that a probability refers to, ``"mean"`` or ``"worst"``.
      steps_factor: bound on the expected steps to satisfaction, a multiple of the quickest optimal
        policy's; None for no bound.
    """

    parameters: PyTree
    hidden: tuple[int, ...]
    memory: Automaton
    label_on: str
    discount: float
    horizon: int | None
    radius: int
    formula: str
    kinds: tuple[str, ...]
    guarantee: str | float = "none"
    over: str = "mean"
    steps_factor: float | None = None

    @property
    def network(self) -> todirl.RewardNetwork:
        """Flax module of the parameters."""
        return todirl.RewardNetwork(self.hidden)

    @property
    def hparams(self) -> todirl.Hparams:
        """Hyperparameters of the planner."""
        return todirl.Hparams(discount=self.discount, horizon=self.horizon)


def plan_in(learned: LearnedReward, world: MDP, observation: ArrayLike) -> tuple[Product, Solution]:
    """Soft-optimal policy of a learned reward in a world, with the product model.

    Differentiable as :func:`~jaxltl.algos.todirl.plan` is, without a guarantee.

    Args:
      learned: the reward.
      world: a model with labels for all propositions of the memory automaton.
      observation: ``float[S, O]``, such as the result of
        ``temporal_gridworld.observations(world, learned.radius)``.

    Returns:
      The product, and the solution with the policy ``float[S, Q, A]``; its value is that of the
      learned reward before the guarantee is applied.

    Raises:
      ValueError: for labels unknown to the automaton, a wrong observation shape, or an unattainable
        probability.
    """
    model = product(world, learned.memory, label_on=learned.label_on)
    seen = jnp.asarray(observation, model.dtype)
    width = learned.parameters["params"]["kernel"].shape[0] - model.num_memory - model.num_actions
    if seen.shape != (world.num_states, width):
        raise ValueError(
            f"observation has shape {seen.shape}; the network reads {width} numbers in each of the "
            f"world's states: {(world.num_states, width)}."
        )
    plan = partial(todirl.plan, learned.network, learned.parameters, model, seen, learned.hparams)
    requested = learned.guarantee
    if requested == "none":
        return model, plan()
    sure = optimal_actions(model)
    inside = plan(allowed=sure.allowed)
    factor, least, solution = learned.steps_factor or np.inf, 0.0, inside
    if not isinstance(requested, str):
        require_attainable(model, sure.best, requested, learned.over, "state {}".format)
        soft, least = plan(), requested
        mixed = reaching(model, soft.policy, inside.policy, sure.best, requested, over=learned.over)
        policy = jnp.asarray(mixed.policy, model.dtype)
        solution = replace(soft, policy=policy, status=worst(soft.status, inside.status))
    if np.isinf(factor):
        return model, solution
    lifted = practical_policy(
        model, solution.policy, factor, actions=sure, probability=least, over=learned.over
    )
    return model, replace(solution, policy=jnp.asarray(lifted.policy, model.dtype))


# --- files ----------------------------------------------------------------------------------


def save_reward(path: str | Path, learned: LearnedReward) -> None:
    """Writes a learned reward as ``.npz``, atomically.

    Args:
      path: the file; its arrays are the parameters by path, such as ``params/kernel``, and
        ``about``, JSON text.
      learned: the reward.

    Raises:
      ValueError: the file cannot be written.
    """
    about = {**vars(learned), "memory": to_dict(learned.memory)}
    arrays = flatten_dict(about.pop("parameters"), sep="/")
    text = json.dumps(about)
    with atomic_write(path) as file:
        np.savez(file, allow_pickle=False, about=np.array(text), **arrays)


def load_reward(path: str | Path) -> LearnedReward:
    """Reads a learned reward from a file of :func:`save_reward`.

    Args:
      path: the file.

    Returns:
      :class:`LearnedReward`.

    Raises:
      ValueError: the file cannot be read or is malformed.
    """
    try:
        with open(path, "rb") as file:
            arrays = read_arrays(file)
        about = json.loads(str(arrays.pop("about")))
        memory = from_dict(about.pop("memory"))
        for key in ("hidden", "kinds"):
            about[key] = tuple(about[key])
        parameters = unflatten_dict({k: jnp.asarray(x) for k, x in arrays.items()}, sep="/")
        learned = LearnedReward(parameters=parameters, memory=memory, **about)
        learned.parameters["params"]["kernel"]  # what any reward network has
    except OSError as error:
        raise ValueError(f"the network cannot be read: {str(path)!r}: {error.strerror}.") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{str(path)!r} is no learned reward, as save_reward writes it: {error}"
        ) from None
    return learned
