"""What a job of todirl is made of: its worlds, what was learned in them, and how well it does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxltl.app.files.task_todirl import Scene, Task
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.models.product import Product
from jaxltl.core.models.trajectories import Trajectories
from jaxltl.core.values.undiscounted.optimal_actions import OptimalActions
from jaxltl.core.values.undiscounted.performance import Performance

LENGTH = 100  # of a demonstration of a soft-optimal expert, at most


class Worlds(NamedTuple):
    """Worlds beside the learner's memory, and beside what judges the learner.

    Attributes:
      scenes: W worlds.
      model: their products with the learner's memory, stacked; with a guarantee, narrowed to the
        actions that lose nothing of the task.
      judged: their products with memory and task side by side, stacked.
      observation: ``float[W, S, O]``.
    """

    scenes: list[Scene]
    model: Product
    judged: Product
    observation: jax.Array

    @property
    def names(self) -> list[str]:
        """Of the worlds."""
        return [scene.name for scene in self.scenes]

    def part(self, chosen: slice) -> Worlds:
        """Some of the worlds."""
        arrays = part_of((self.model, self.judged, self.observation), chosen)
        return Worlds(self.scenes[chosen], *arrays)


def part_of(tree: Any, chosen: Any) -> Any:
    """A part of arrays along their first axis; as NumPy's, which has nothing to compile for it."""
    return jax.tree.map(lambda x: np.asarray(x)[chosen], tree)


@dataclass(frozen=True)
class Setup:
    """A task file's contents as the library's objects; see :func:`prepare`.

    Attributes:
      task: the file.
      judge, memory: the automata of the task and of the learner's memory.
      worlds: those to learn in, and then those to test in.
      num_training: how many there are to learn in.
      expert: ``float[W, S, Q, A]``, the policy of an expert in the judged products.
      soft: whether the expert is soft-optimal for a reward, not the quickest of the best policies.
      demonstrations: in each of the training worlds.
      dropped: how many synthetic ones did not do the task.
      asked: the guarantee; a probability of 1 is the best.
      sure: in each world what loses nothing of the task; None without a guarantee.
      left_out: how many demonstrated steps are not among the allowed actions.
      trivial: what is to be said of a formula that is always true.
    """

    task: Task
    judge: Automaton
    memory: Automaton
    worlds: Worlds
    num_training: int
    expert: jax.Array
    soft: bool
    demonstrations: list[Trajectories]
    dropped: int
    asked: str | float
    sure: list[OptimalActions] | None = None
    left_out: int = 0
    trivial: str | None = None

    @property
    def loss(self) -> float:
        """What moves that lose nothing are certified to lose at most, in any world."""
        return max((float(one.loss) for one in self.sure or ()), default=0.0)

    @property
    def is_probability(self) -> bool:
        """Whether a probability is asked for."""
        return not isinstance(self.asked, str)

    @property
    def training(self) -> Worlds:
        """The worlds to learn in."""
        return self.worlds.part(slice(self.num_training))

    @property
    def test(self) -> Worlds | None:
        """The worlds to test in."""
        if len(self.worlds.scenes) == self.num_training:
            return None
        return self.worlds.part(slice(self.num_training, None))


@dataclass(frozen=True)
class Learned:
    """What was learned, with N seeds side by side.

    Attributes:
      parameters: of the network, leading axis N.
      held_out: ``float[N]``, negative log-likelihood of the average held-out pair.
      best_step: ``int[N]``, after which the parameters were reached.
      stopped: ``bool[N]``, whether learning ended by patience.
      num_steps: ``int``, made until all had ended.
      history: metrics ``[T, N]`` and ``step [T]``.
      weight: of the task's probability, where one is asked for.
    """

    parameters: Any
    held_out: np.ndarray
    best_step: np.ndarray
    stopped: np.ndarray
    num_steps: int
    history: Mapping[str, np.ndarray]
    weight: float | None = None


class Judged(NamedTuple):
    """Policies in some worlds, and how well they do.

    Attributes:
      policy: ``float[W, S, Q, A]`` with the learner's memory, of the kept seed.
      status: ``int32[W]``, of the solver that found it.
      performance: by the name of who acts: learned, expert, random; leading axis W.
      seeds: ``float[N, W]``, L_phi of each seed's policy.
      share, attained: ``float[W]``, where a probability is asked for: of moves that lose nothing,
        and what is certified.
    """

    policy: np.ndarray
    status: np.ndarray
    performance: dict[str, Performance]
    seeds: np.ndarray
    share: np.ndarray | None = None
    attained: np.ndarray | None = None

    def part(self, chosen: slice) -> Judged:
        """In some of the worlds."""
        each = part_of(self.performance, chosen)
        held = part_of((self.share, self.attained), chosen)
        return Judged(self.policy[chosen], self.status[chosen], each, self.seeds[:, chosen], *held)


@dataclass(frozen=True)
class Outcome:
    """A finished job: what was asked, learned and found out about it.

    Attributes:
      setup, learned: the parts.
      chosen: the seed's position that is kept: the best held-out likelihood, or the least loss.
      training, test: how the policies of the learned reward do; test is None without worlds.
      seed: the first of the seeds.
      seconds: spent.
    """

    setup: Setup
    learned: Learned
    chosen: int
    training: Judged
    test: Judged | None
    seed: int
    seconds: float


def counted_worlds(setup: Setup) -> np.ndarray:
    """Which test worlds count."""
    names = setup.worlds.names[setup.num_training :]
    return np.array([name not in setup.task.test.get("leave_out", ()) for name in names])
