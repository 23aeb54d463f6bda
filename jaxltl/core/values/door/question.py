"""Questions about a model, in the same form for every kind of model."""

from __future__ import annotations

from typing import NamedTuple

from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import Reward
from jaxltl.core.sparse.solvers.shortest_path_problem import RelativeTolerance, as_width


class Reach(NamedTuple):
    """The probability of reaching a set of states."""

    target: Array | str


class Until(NamedTuple):
    """The probability of reaching a set of states through the states of another one."""

    target: Array | str
    stay: Array | str


class TotalReward(NamedTuple):
    """The expected total reward until a set of states is reached, or for ever."""

    reward: Reward
    target: Array | str | None = None
    # of a run that never reaches the set: "infinite", "sum" of its rewards, or "zero"
    unreached: str = "infinite"


class DiscountedReward(NamedTuple):
    """The expected discounted reward."""

    reward: Reward
    discount: Array | float


class AverageReward(NamedTuple):
    """The expected long-run average of a reward."""

    reward: Reward


class Acceptance(NamedTuple):
    """The probability that the automaton of a product accepts."""


class NextStep(NamedTuple):
    """The probability that the next state is in a set."""

    target: Array | str


class ReachWithin(NamedTuple):
    """The probability of reaching a set within a number of steps."""

    target: Array | str
    num_steps: int
    stay: Array | str | None = None


class RewardOfSteps(NamedTuple):
    """The expected reward of a number of steps."""

    reward: Reward
    num_steps: int


class RewardAfterSteps(NamedTuple):
    """The expected reward of the state after a number of steps."""

    reward: Reward
    num_steps: int


class ReachAtCost(NamedTuple):
    """The probability of reaching a set before more than a bound of reward is earned."""

    target: Array | str
    reward: Reward
    bound: float
    stay: Array | str | None = None


Path = (
    Reach
    | Until
    | TotalReward
    | DiscountedReward
    | AverageReward
    | Acceptance
    | NextStep
    | ReachWithin
    | RewardOfSteps
    | RewardAfterSteps
    | ReachAtCost
)


def require_infinite(path: TotalReward) -> None:
    """Raises ValueError unless runs that avoid the target of a total reward are worth infinity."""
    if path.target is None:
        raise ValueError(
            "total rewards of games with intervals need a target, as those inside jit and over a mesh do; "
            "give one."
        )
    if path.unreached != "infinite":
        raise ValueError(
            f"unreached={path.unreached!r} is for models of known probabilities on the host, without "
            "intervals, outside jit and over no mesh; leave it out."
        )


class Question(NamedTuple):
    """A quantity of paths, with the directions of the players or a policy."""

    path: Path
    objective: str = "max"  # or "min": of the system
    nature: str | None = None  # "adversarial" or "cooperative", where probabilities are intervals
    environment: str | None = None  # the same of a second player
    policy: Array | None = None  # of the system, to evaluate; None: optimise


class Accuracy(NamedTuple):
    """The requested width of the enclosure; None for the default of the engine."""

    tolerance: Array | float | None = None
    relative: bool = False  # whether it is a share of the value

    def width(self, default: float) -> float:
        """The width for engines on the host; relative ones are a :class:`RelativeTolerance`."""
        wanted = default if self.tolerance is None else as_width(self.tolerance)
        return RelativeTolerance(wanted) if self.relative else wanted
