"""A learned reward network in a file, and planning with it in worlds never seen.

Example:
  >>> import pathlib, tempfile
  >>> import jax, numpy as np
  >>> import jaxltl as jl
  >>> from jaxltl.io.learned_reward import LearnedReward, load_reward, plan_in, save_reward
  >>> linear = {"kernel": np.zeros((5, 1)), "bias": np.zeros(1)}  # of seen, memory and action
  >>> learned = LearnedReward(
  ...     parameters={"params": linear}, hidden=(),
  ...     memory=jl.to_automaton("F g"), label_on="exit", discount=0.9, horizon=None, radius=0,
  ...     formula="F g", kinds=("plain", "goal"))
  >>> learned.network.hidden, learned.hparams.discount
  ((), 0.9)
  >>> path = pathlib.Path(tempfile.mkdtemp()) / "reward.npz"
  >>> save_reward(path, learned)
  >>> again = load_reward(path)
  >>> again.kinds, again.parameters["params"]["kernel"].shape
  (('plain', 'goal'), (5, 1))
  >>> world = jl.from_dense([[[0.5, 0.5]], [[0, 1.0]]], label=[[0], [1]], propositions=["g"])
  >>> jax.eval_shape(lambda seen: plan_in(again, world, seen)[1], np.eye(2)).policy.shape
  (2, 2, 1)
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos import todirl
from jaxltl.algos.common.checkpoint import atomic_write, read_arrays
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.text import from_dict, to_dict
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.product import Product, product
from jaxltl.core.types import Solution, worst
from jaxltl.core.values.undiscounted.mixture import reaching, require_attainable
from jaxltl.core.values.undiscounted.optimal_actions import optimal_actions


@dataclass(frozen=True)
class LearnedReward:
    """A reward over what is seen, the memory and the action, with all that planning needs.

    Attributes:
      parameters: of ``RewardNetwork(hidden)``, ``{"params": ...}``.
      hidden: widths of the hidden layers.
      memory: the automaton whose state the network sees.
      label_on: which label a step of the product reads.
      discount: with which it was learned.
      horizon: the number of steps of a run, or None.
      radius: how far around its cell it sees.
      formula: the task.
      kinds: names of what a cell of the observation can be, in the order of its one-hot parts.
      guarantee: ``"best"``: plans take the actions alone that lose nothing of the memory's task;
        a probability of it, for which as many of them are mixed in as it takes; or ``"none"``.
      over: of which initial states a probability is, their ``"mean"`` or the ``"worst"``.
    """

    parameters: Any
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

    @property
    def network(self) -> todirl.RewardNetwork:
        """The flax module of the parameters."""
        return todirl.RewardNetwork(self.hidden)

    @property
    def hparams(self) -> todirl.Hparams:
        """What planning takes from the learner's hyperparameters."""
        return todirl.Hparams(discount=self.discount, horizon=self.horizon)


def plan_in(learned: LearnedReward, world: MDP, observation: Any) -> tuple[Product, Solution]:
    """The soft-optimal policy of a learned reward in a world, and the product that it is for.

    Args:
      learned: the reward.
      world: its labels have the propositions of the memory's automaton.
      observation: ``float[S, O]``, what is seen in each of its states, such as
        ``temporal_gridworld.observations(world, learned.radius)``.

    Returns:
      The product, and the solution with the policy ``float[S, Q, A]``; its value is that of the
      reward, before moves that lose nothing are mixed in for a probability.

    Raises:
      ValueError: the world shows what the automaton does not know, the observation does not
        have the shape that the network reads, or no policy has the probability there.

    Differentiable as :func:`~jaxltl.algos.todirl.plan` is, where nothing is guaranteed.
    """
    model = product(world, learned.memory, label_on=learned.label_on)
    seen = jnp.asarray(observation, model.dtype)
    kernel = learned.parameters["params"]["kernel"]
    width = kernel.shape[0] - model.num_memory - model.num_actions
    if seen.shape != (world.num_states, width):
        raise ValueError(
            f"observation has shape {seen.shape}; the network reads {width} numbers in each of the "
            f"world's states: {(world.num_states, width)}."
        )
    plan = partial(todirl.plan, learned.network, learned.parameters, model, seen, learned.hparams)
    asked = learned.guarantee
    if asked == "none":
        return model, plan()
    sure = optimal_actions(model)
    inside = plan(allowed=sure.allowed)
    if isinstance(asked, str):
        return model, inside
    require_attainable(model, sure.best, asked, learned.over, "state {}".format)
    found = plan()
    mixed = reaching(model, found.policy, inside.policy, sure.best, asked, over=learned.over)
    policy = jnp.asarray(mixed.policy, model.dtype)
    return model, replace(found, policy=policy, status=worst(found.status, inside.status))


# --- files ----------------------------------------------------------------------------------


_ABOUT = (
    "hidden",
    "label_on",
    "discount",
    "horizon",
    "radius",
    "formula",
    "kinds",
    "guarantee",
    "over",
)


def save_reward(path: str | Path, learned: LearnedReward) -> None:
    """Writes a learned reward as an ``.npz``, atomically; :func:`load_reward` reads it.

    Its arrays: the parameters by their names, such as ``params/kernel``, and ``about``, a text of
    JSON with all else.

    Args:
      path: the file.
      learned: what is written.

    Raises:
      ValueError: the place cannot be written to.
    """
    about = {key: getattr(learned, key) for key in _ABOUT}
    text = json.dumps({**about, "memory": to_dict(learned.memory)})
    arrays = {name: np.asarray(x) for name, x in _flat(learned.parameters).items()}
    with atomic_write(path) as file:
        np.savez(file, allow_pickle=False, about=np.array(text), **arrays)


def load_reward(path: str | Path) -> LearnedReward:
    """The learned reward that :func:`save_reward` wrote.

    Args:
      path: the file.

    Returns:
      :class:`LearnedReward`.

    Raises:
      ValueError: the file cannot be read, or is no such file.
    """
    try:
        with open(path, "rb") as file:
            arrays = read_arrays(file)
        about = json.loads(str(arrays.pop("about")))
        memory = from_dict(about.pop("memory"))
        for key in ("hidden", "kinds"):
            about[key] = tuple(about[key])
        found = LearnedReward(parameters=_nested(arrays), memory=memory, **about)
        found.parameters["params"]["kernel"]  # what any reward network has
    except OSError as error:
        raise ValueError(f"the network cannot be read: {str(path)!r}: {error.strerror}.") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{str(path)!r} is no learned reward, as save_reward writes it: {error}"
        ) from None
    return found


def _flat(parameters: Any) -> dict[str, jax.Array]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(parameters)
    return {"/".join(str(part.key) for part in path): leaf for path, leaf in leaves}


def _nested(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, array in arrays.items():
        *rooms, last = name.split("/")
        place = tree
        for room in rooms:
            place = place.setdefault(room, {})
        place[last] = jnp.asarray(array)
    return tree
