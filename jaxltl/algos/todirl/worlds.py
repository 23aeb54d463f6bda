"""Training worlds and test worlds of a reward, and the guarantee of its policies in each of them.

With ``"best"`` all policies are restricted to optimal actions. A required satisfaction probability is
attained in each world by a mixture; see :mod:`~jaxltl.algos.todirl.transfer`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import EllipsisType
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxltl.algos.common.guarantees import (
    StepBound,
    mistakes,
    step_bound,
    used_steps,
)
from jaxltl.core.automata import Automaton, synchronize
from jaxltl.core.models import (
    MDP,
    Product,
    Trajectories,
    product,
    stack_products,
    with_allowed,
)
from jaxltl.core.models.construct.batch import restrict_stacked_actions
from jaxltl.core.models.construct.lifting import allowed_steps
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.validation import errors_in
from jaxltl.core.values import (
    OptimalActions,
    optimal_actions,
    optimal_satisfaction,
)
from jaxltl.core.values.undiscounted.mixture import (
    require_attainable,
)

TreeT = TypeVar("TreeT")


def part_of(tree: TreeT, chosen: int | slice | EllipsisType) -> TreeT:
    """Part `chosen` of arrays of `tree` along their first axis, as NumPy arrays, without compilation.

    Returns:
      The tree with the part of each array.
    """
    return jax.tree.map(lambda x: np.asarray(x)[chosen], tree)


# --- worlds ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Worlds:
    """Training worlds, then test worlds, with their stacked products.

    Attributes:
      mdps: W worlds.
      names: of the worlds.
      places: for each world the text of a state in errors.
      num_training: number of training worlds.
      automaton: of the formula.
      memory: automaton of the learner's memory.
      model: products with the learner's memory, stacked; with ``"best"`` restricted to optimal actions.
      task_model: products with memory and formula, stacked.
      observation: ``float[W, S, O]``.
    """

    mdps: Sequence[MDP]
    names: Sequence[str]
    places: Sequence[Callable[[int], str]]
    num_training: int
    automaton: Automaton
    memory: Automaton
    model: Product
    task_model: Product
    observation: jax.Array

    def own_product(self, w: int) -> Product:
        """The product of a world with the formula, without padding."""
        return product(self.mdps[w], self.automaton, label_on=self.model.label_on)

    @property
    def kinds(self) -> list[str]:
        """For each world ``"training"`` or ``"test"``."""
        return ["training" if w < self.num_training else "test" for w in range(len(self.mdps))]


def make_worlds(
    mdps: Sequence[MDP],
    observations: Sequence[ArrayLike],
    automaton: Automaton,
    memory: Automaton | None = None,
    *,
    label_on: str = "exit",
    names: Sequence[str] | None = None,
    places: Sequence[Callable[[int], str]] | None = None,
    num_training: int | None = None,
) -> Worlds:
    """Worlds with products that are stacked, so that one program serves them.

    Args:
      mdps: training worlds, then test worlds.
      observations: of each world ``float[S, O]``.
      automaton: of the formula.
      memory: automaton of the learner's memory; default the formula's.
      label_on: the label that a step of the product reads, of its ``"entry"`` or ``"exit"``.
      names: of the worlds; default numbers from 1.
      places: for each world the text of a state in errors.
      num_training: number of training worlds; default all.

    Returns:
      :class:`Worlds`.
    """
    memory = automaton if memory is None else memory
    both = automaton if memory is automaton else synchronize(memory, automaton)
    model = stack_products(mdps, memory, label_on=label_on)
    return Worlds(
        mdps,
        [f"world {w + 1}" for w in range(len(mdps))] if names is None else names,
        ["state {}".format] * len(mdps) if places is None else places,
        len(mdps) if num_training is None else num_training,
        automaton,
        memory,
        model,
        stack_products(mdps, both, label_on=label_on),
        _padded(observations, model),
    )


def _padded(observations: Sequence[ArrayLike], model: Product) -> jax.Array:
    size, arrays = model.mdp.num_states, [np.asarray(x) for x in observations]
    return jnp.asarray(np.stack([np.pad(x, ((0, size - len(x)), (0, 0))) for x in arrays]))


@dataclass(frozen=True)
class WorldDemands:
    """Demonstrations, and the guarantee in each world.

    Attributes:
      worlds: with ``"best"`` restricted to optimal actions.
      demonstrations: in each training world, until the formula is lost or, for ``"best"``, a mistake
        has left the best probability.
      requested: ``"best"``, ``"none"`` or a probability.
      over: initial states of a probability, their ``"mean"`` or the ``"worst"``.
      optimal: the optimal actions in each world; None without a guarantee.
      bounds: on the expected steps in each world; None without a guarantee and for safety formulas.
      left_out: number of demonstrated steps that are not optimal.
      unused: number of demonstrated steps after the formula or the best probability is lost.
    """

    worlds: Worlds
    demonstrations: Sequence[Trajectories]
    requested: str | float
    over: str = "mean"
    optimal: Sequence[OptimalActions] | None = None
    bounds: Sequence[StepBound] | None = None
    left_out: int = 0
    unused: int = 0

    @property
    def loss(self) -> float:
        """Certified loss of optimal actions, the largest over worlds."""
        return max((float(one.loss) for one in self.optimal or ()), default=0.0)

    @property
    def is_probability(self) -> bool:
        """True if a satisfaction probability is required."""
        return not isinstance(self.requested, str)


def make_demands(
    worlds: Worlds,
    demonstrations: Sequence[Trajectories],
    requested: str | float = "best",
    *,
    over: str = "mean",
    steps: float | None = None,
    steps_factor: float | None = None,
    exempt: Sequence[str] = (),
) -> WorldDemands:
    """The guarantee of policies in all worlds.

    Args:
      worlds: of :func:`make_worlds`.
      demonstrations: in each training world.
      requested: ``"best"`` for the maximal satisfaction probability, a probability, or ``"none"``.
      over: initial states of a probability, their ``"mean"`` or the ``"worst"``.
      steps: a bound on the expected steps to satisfaction, or None.
      steps_factor: the bound as a multiple of the quickest optimal policy's steps, or None.
      exempt: names of test worlds in which a probability need not be attainable.

    Returns:
      :class:`WorldDemands`.

    Raises:
      ValueError: a probability or a number of steps that no policy attains in some world.
    """
    requested = "best" if requested == 1 else requested
    demands = WorldDemands(worlds, demonstrations, requested, over)
    if requested == "none":
        return _until_mistakes(demands)
    lanes = [part_of(worlds.model, w) for w in range(len(worlds.mdps))]
    demands = replace(demands, optimal=[optimal_actions(lane) for lane in lanes])
    if demands.is_probability:
        _require_attainable(demands, exempt)
    bounds = []
    for name, lane, actions in zip(worlds.names, lanes, demands.optimal or (), strict=True):
        with errors_in(f"in the world {name}: "):
            bound = step_bound(
                lane, actions, requested, over=over, steps=steps, factor=steps_factor
            )
        if bound is not None:
            bounds.append(bound)
    demands = _until_mistakes(replace(demands, bounds=bounds or None))
    return demands if demands.is_probability else _narrowed(demands)


def _require_attainable(demands: WorldDemands, exempt: Sequence[str]) -> None:
    """Raises ValueError for a probability that no policy attains in a world that counts."""
    worlds = demands.worlds
    for w, optimal in enumerate(demands.optimal or ()):
        kind, name = worlds.kinds[w], worlds.names[w]
        if kind == "test" and name in exempt:
            continue
        model, probability = part_of(worlds.model, w), float(demands.requested)
        try:
            require_attainable(model, optimal.best, probability, demands.over, worlds.places[w])
        except ValueError as error:
            fix = "" if kind == "training" else " Or name it in [test] leave_out."
            raise ValueError(f"in the {kind} world {name}: {error}{fix}") from None


def _until_mistakes(demands: WorldDemands) -> WorldDemands:
    """Demonstrations until the formula is lost or, for "best", a mistake has left the best probability."""
    shortened, unused = list[Trajectories](), 0
    for w, each in enumerate(demands.demonstrations):
        model = demands.worlds.own_product(w)
        mistake = np.zeros(each.state.shape, bool)
        if demands.requested == "best" and demands.optimal is not None:
            allowed = np.asarray(demands.optimal[w].allowed)
            mistake = mistakes(model, allowed[: model.mdp.num_states], each)
        used = used_steps(model, optimal_satisfaction(model), mistake, each)
        unused += int(np.sum(each.length)) - int(used.sum())
        shortened.append(replace(each, length=to_jax(used.astype(np.int32))))
    return replace(demands, demonstrations=shortened, unused=unused)


def _narrowed(demands: WorldDemands) -> WorldDemands:
    """Restricts all worlds to optimal actions, and counts the demonstrated steps that are not."""
    worlds, count = demands.worlds, 0
    allowed = [np.asarray(one.allowed) for one in demands.optimal or ()]
    for w, trajectories in enumerate(demands.demonstrations):
        with errors_in(f"demonstrations in {worlds.names[w]}: "):
            model = worlds.own_product(w)
            mask = allowed_steps(
                with_allowed(model, allowed[w][: model.mdp.num_states]), trajectories
            )
        count += int(np.asarray(trajectories.mask).sum() - mask.sum())
    worlds = replace(worlds, model=restrict_stacked_actions(worlds.model, allowed))
    return replace(demands, worlds=worlds, left_out=count)
