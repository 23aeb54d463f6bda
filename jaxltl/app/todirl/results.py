"""Setup and results of a todirl job: worlds, learned networks, and evaluations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import EllipsisType
from typing import TypeVar

import jax
import numpy as np

from jaxltl.app.files.scenes import Scene
from jaxltl.app.practical import StepBound
from jaxltl.app.files.task_todirl import TodirlTask
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.models import Product, Trajectories
from jaxltl.core.values import OptimalActions, Performance
from jaxltl.core.models.protocols import PyTree

TreeT = TypeVar("TreeT")

LENGTH = 100  # limit of a demonstration of a soft-optimal expert


@dataclass(frozen=True)
class Worlds:
    """Worlds, and their products with the learner's memory and with the formula."""

    scenes: list[Scene]  # W worlds
    # their products with the learner's memory, stacked; with a guarantee, restricted to optimal
    # actions
    model: Product
    judged: Product  # their products with memory and formula, stacked
    observation: jax.Array  # float[W, S, O]

    @property
    def names(self) -> list[str]:
        return [scene.name for scene in self.scenes]

    def part(self, chosen: slice) -> Worlds:
        """Some of the worlds."""
        arrays = part_of((self.model, self.judged, self.observation), chosen)
        return Worlds(self.scenes[chosen], *arrays)


def part_of(tree: TreeT, chosen: int | slice | EllipsisType) -> TreeT:
    """Part of arrays along their first axis, as NumPy arrays, which need no compilation."""
    return jax.tree.map(lambda x: np.asarray(x)[chosen], tree)


@dataclass(frozen=True)
class Setup:
    """A task, ready for learning."""

    task: TodirlTask  # the file
    judge: Automaton  # judge, memory: the automata of the formula and of the learner's memory
    memory: Automaton
    worlds: Worlds  # training worlds, then test worlds
    num_training: int  # number of training worlds
    expert: jax.Array  # float[W, S, Q, A], the expert's policy in the judged products
    soft: bool  # whether the expert is soft-optimal for a reward, not the quickest optimal policy
    demonstrations: list[Trajectories]  # in each of the training worlds
    dropped: int  # number of simulated demonstrations that do not satisfy the formula
    asked: str | float  # the guarantee; a probability of 1 is "best"
    # optimal actions in each world; None without a guarantee
    sure: list[OptimalActions] | None = None
    # bounds on the expected steps in each world; None without a guarantee and for safety formulas
    bounds: list[StepBound] | None = None
    left_out: int = 0  # number of demonstrated steps that are not optimal
    unused: int = 0  # number of those after the formula or the best probability is lost
    trivial: str | None = None  # remark on a formula that is always true

    @property
    def loss(self) -> float:
        """Certified loss of optimal actions, the largest over worlds."""
        return max((float(one.loss) for one in self.sure or ()), default=0.0)

    @property
    def is_probability(self) -> bool:
        return not isinstance(self.asked, str)

    @property
    def training(self) -> Worlds:
        return self.worlds.part(slice(self.num_training))

    @property
    def test(self) -> Worlds | None:
        """The test worlds, or None."""
        if len(self.worlds.scenes) == self.num_training:
            return None
        return self.worlds.part(slice(self.num_training, None))


@dataclass(frozen=True)
class Learned:
    """Reward networks of N seeds."""

    parameters: PyTree  # of the network, leading axis N
    held_out: np.ndarray  # float[N], negative log-likelihood of the average held-out pair
    best_step: np.ndarray  # int[N], after which the parameters were reached
    stopped: np.ndarray  # bool[N], whether learning ended by patience
    num_steps: int  # until all seeds ended
    history: Mapping[str, np.ndarray]  # metrics [T, N] and step [T]
    weight: float | None = None  # mu, if a probability is asked


@dataclass(frozen=True)
class Judged:
    """Policies in some worlds, and their satisfaction probabilities."""

    policy: np.ndarray  # float[W, S, Q, A] with the learner's memory, of the kept seed
    status: np.ndarray  # int32[W], of its solver
    # of the learned, expert and random policies; leading axis W
    performance: dict[str, Performance]
    seeds: np.ndarray  # float[N, W], mean satisfaction probability of each seed
    # share, attained: float[W], share of optimal actions and certified probability, if one is asked
    share: np.ndarray | None = None
    attained: np.ndarray | None = None
    # float[W, 3], expected steps with bounds, and float[W], the share of the quickest policy
    steps: np.ndarray | None = None
    quick_share: np.ndarray | None = None

    def part(self, chosen: slice) -> Judged:
        """The part for some of the worlds."""
        each = part_of(self.performance, chosen)
        held = part_of((self.share, self.attained, self.steps, self.quick_share), chosen)
        return Judged(self.policy[chosen], self.status[chosen], each, self.seeds[:, chosen], *held)


@dataclass
class Outcome:
    """Learned rewards of all seeds and their evaluations."""

    setup: Setup  # setup, learned: the task, and the results of learning
    learned: Learned
    chosen: int  # index of the kept seed, by held-out likelihood or loss
    training: Judged  # training, test: evaluations (test: None without test worlds)
    test: Judged | None
    seed: int  # the first seed
    seconds: float = 0.0  # wall time


def counted_worlds(setup: Setup) -> np.ndarray:
    """``bool[W]``: the test worlds that count."""
    names = setup.worlds.names[setup.num_training :]
    return np.array([name not in setup.task.left_out for name in names])
