"""Schema of task files of PPO, constrained cross-entropy or CPO in environments.

Tables ``[world]``, with ``[world.arguments]``, ``[task]``, ``[learner]``, one of the method's name
for its hyperparameters, and ``[evaluation]``; ``examples/flat_world.toml`` shows them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal
from typing import Annotated as TomlKey

import attrs

from jaxltl.app.files.hyperparameters import hparams_table
from jaxltl.app.files.schema import (
    Confidence,
    Count,
    NonNegative,
    Number,
    TomlTable,
    Text,
    Unit,
    Widths,
    Meta,
    table,
)
from jaxltl.app.files.task import FormulaFile, FormulaTable, LearnerTable as AnyLearnerTable
from jaxltl.app.wording import Record

Schedule = Annotated[
    NonNegative | tuple[NonNegative, NonNegative],
    Meta("a number of at least 0, or [first, last], linear over all steps", example="[0.5, 0.1]"),
]
Cells = Annotated[list[Count], Meta("a list of numbers of cells, such as [200, 200]", bool)]
Labels = Annotated[list[str], Meta('a list of names, such as ["goal"]')]
Score = Literal[
    "reward",
    "discounted_reward",
    "cost",
    "length",
    "success",
    "failure",
    "violation",
    "undecided",
    "visits",
    "discounted_visits",
]


@table
class WorldTable(TomlTable):
    """``[world]``: the environment."""

    environment: TomlKey[
        Text | None, "Environment, or function that makes one; default the dynamics.", '"brax:ant"'
    ] = None
    dynamics: TomlKey[
        Text | None,
        "Function that makes dynamics, in which the policy is proven; default the environment.",
        '"shuttle.py:make"',
    ] = None
    arguments: TomlKey[Record, "Arguments of the function.", "{ horizon = 120 }"] = attrs.field(
        factory=dict
    )
    labels: TomlKey[
        Text | None, "Function of labels; default the environment's.", '"cart.py:labels"'
    ] = None
    propositions: TomlKey[Labels | None, "Names of the labels; default the environment's."] = None
    horizon: TomlKey[Count | None, "Longest episode in steps; default the environment's."] = None

    @property
    def function(self) -> str:
        """The environment, or the function of dynamics."""
        return self.environment or self.dynamics or ""

    def __attrs_post_init__(self) -> None:
        self.require_one(
            ("environment", "dynamics"),
            'environment = "NAME", or dynamics = "file.py:function" of a function that returns '
            "dynamics of make_dynamics",
        )
        if self.dynamics is not None:
            self.refuse(("labels", "propositions"), "an environment; dynamics have labels")
        self.require(
            (self.labels is None) == (self.propositions is None),
            "labels and propositions belong together: a function and the names of what it returns.",
        )

    def named_files(self) -> list[str]:
        """The Python files that the table names, each once."""
        named = [name.rpartition(":")[0] for name in (self.function, self.labels) if name]
        return [name for name in dict.fromkeys(named) if name.endswith(".py")]


@table
class TaskTable(FormulaTable):
    """``[task]``: the formula and its reward; see ``jaxltl.task_environment``."""

    reward: TomlKey[
        Literal["auto", "reach", "keep", "eventual", "two-discount", "parity"] | None,
        "Reward of the formula; default auto.",
        '"reach"',
    ] = None
    discount: TomlKey[
        Unit | None,
        "Discount of steps; default 1 for reach and keep without shaping, else 0.99.",
        "0.98",
    ] = None
    ratio: TomlKey[Unit | None, "Ratio of successive rewards; default 1 minus the discount."] = None
    shaping: TomlKey[
        Literal["auto", "distance", "none"] | None,
        "Potential-based shaping of the reward, auto for distance with ppo where all steps are "
        "discounted, so that it changes no optimal policy; default auto.",
        '"distance"',
    ] = None
    ending: TomlKey[
        Literal["repeat", "violated", "undecided", "rejected"] | None,
        "Verdict where the world ends; default repeat, of its last label, or what the dynamics "
        "define.",
        '"violated"',
    ] = None


@table
class LearnerTable(AnyLearnerTable):
    """``[learner]``: the method."""

    method: TomlKey[Literal["ppo", "cce", "cpo"], "Learning algorithm."]
    steps: TomlKey[Count, "Steps of the learner."]


@table
class PpoTable(hparams_table("ppo")):  # type: ignore[misc]
    """``[ppo]``: hyperparameters, and the networks."""

    discount: TomlKey[Unit, "Discount of rewards.", "0.99"] = 1.0
    hidden: TomlKey[Widths | None, "Widths of the networks' hidden layers; default [64, 64]."] = (
        None
    )
    activation: TomlKey[
        Literal["tanh", "relu", "gelu", "silu"] | None, "Activation; default tanh."
    ] = None
    initial_deviation: TomlKey[NonNegative | None, "Deviation of Gaussian actions; default 1."] = (
        None
    )


@table
class CceTable(hparams_table("cce", "sample_share", "num_samples")):  # type: ignore[misc]
    """``[cce]``: hyperparameters, the policy network, and the scores of samples."""

    rate: TomlKey[Schedule, "Smoothing of the distribution's parameters."] = 0.5
    margin: TomlKey[Number | None, "Margin of the constraint."] = None
    noise: TomlKey[Schedule | None, "Noise added to the variance."] = None
    hidden: TomlKey[Widths, "Widths of the policy network's hidden layers."] = attrs.field(
        factory=lambda: [16]
    )
    activation: TomlKey[Literal["tanh", "relu"], "Activation of the network."] = "tanh"
    deviation: TomlKey[NonNegative, "Initial deviation of the network's parameters."] = 1.0
    objective: TomlKey[Score, "Score that is maximised."] = "reward"
    cost: TomlKey[Score | None, "Score that limit bounds; default none.", '"failure"'] = None
    limit: TomlKey[Number | None, "Upper bound of the cost; default none.", "0.1"] = None
    episodes: TomlKey[Count, "Episodes by which a sample is scored."] = 10

    def __attrs_post_init__(self) -> None:
        self.require(
            self.limit is None or self.cost is not None,
            'limit is that of a cost: give cost = "failure", "violation" or another score.',
        )
        self.require(
            self.cost is None or self.limit is not None, "cost needs a limit, its upper bound."
        )


@table
class CpoTable(hparams_table("trust_region", "method", "penalty")):  # type: ignore[misc]
    """``[cpo]``: hyperparameters, and the cost."""

    discount: TomlKey[Unit, "Discount of rewards.", "0.99"] = 1.0
    limit: TomlKey[Number | None, "Upper bound of the expected cost; default required.", "0.1"] = (
        None
    )
    cost: TomlKey[
        Literal["world", "violation"], "Cost: the world's, or 1 where the formula is violated."
    ] = "world"


_TABLES = {"ppo": PpoTable, "cce": CceTable, "cpo": CpoTable}


@table
class EvaluationTable(TomlTable):
    """``[evaluation]``: fresh episodes."""

    episodes: TomlKey[Count, "Number of episodes."] = 1000
    steps: TomlKey[
        Count | None, "Steps after which an episode is cut off; default the horizon."
    ] = None
    confidence: TomlKey[Confidence, "Confidence of each interval."] = 0.95
    threshold: TomlKey[Confidence | None, "Success probability to test for; default none."] = None
    discount: TomlKey[Confidence | None, "Discount of the discounted scores; default none."] = None
    policy: TomlKey[
        Literal["drawn", "likeliest"] | None,
        "Actions: drawn, or the likeliest ones; default drawn.",
        '"likeliest"',
    ] = None


@table
class ProofTable(TomlTable):
    """``[proof]``: bounds of the learned policy's satisfaction probability, in worlds of dynamics."""

    cells: TomlKey[
        Cells | None,
        "Cells along each axis at first; default about 20,000 in all, at most 1,000 along an axis.",
        "[200, 200]",
    ] = None
    tolerance: TomlKey[Confidence | None, "Width of the bounds; default 0.001.", "0.01"] = None
    threshold: TomlKey[
        Confidence | None, "Stop when this bound is decided; default none.", "0.999"
    ] = None
    max_cells: TomlKey[Count | None, "Cells of the finest grid; default 1048576."] = None


@table
class EnvironmentFile(FormulaFile):
    """A task file of a simulated world."""

    world: TomlKey[WorldTable, "The environment."]
    task: TomlKey[TaskTable, "The formula and its reward."]
    learner: TomlKey[LearnerTable, "The method."]
    ppo: TomlKey[PpoTable | None, "Hyperparameters of ppo."] = None
    cce: TomlKey[CceTable | None, "Hyperparameters of cce."] = None
    cpo: TomlKey[CpoTable | None, "Hyperparameters of cpo."] = None
    evaluation: TomlKey[EvaluationTable, "Episodes of the evaluation."] = EvaluationTable()
    proof: TomlKey[ProofTable, "Proof of the learned policy."] = ProofTable()

    @property
    def settings(self) -> PpoTable | CceTable | CpoTable:
        """The table of the method's name."""
        method = self.learner.method
        return getattr(self, method) or _TABLES[method]()

    def __attrs_post_init__(self) -> None:
        method = self.learner.method
        for other in _TABLES:
            self.require(
                other == method or getattr(self, other) is None,
                f'[{other}] is for method = "{other}", and [learner] says "{method}": leave '
                "one of them out.",
            )
        self.require(
            self.world.dynamics is not None or not self.proof.specified(),
            f"[proof] is for dynamics, and [world] environment = {self.world.environment!r} "
            "is simulated: leave [proof] out.",
        )
        self.require(
            method != "cpo" or self.settings.limit is not None,
            "[cpo] lacks limit, the upper bound of the expected cost of an episode.",
        )
        self.require(
            method != "cce" or self.evaluation.policy is None,
            "[evaluation] policy is for methods whose policies draw their actions; that of "
            '"cce" draws none.',
        )

    def named_files(self) -> Sequence[str]:
        return self.world.named_files()
