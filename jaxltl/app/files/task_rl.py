"""Schemas of task files without demonstrations: simulated environments, and partial observability.

Examples: ``flat_world.toml`` for PPO, constrained cross-entropy and CPO, and ``two_rooms.toml`` for
finite-state controllers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from jaxltl.app.files.hyperparameters import hparams_table
from jaxltl.app.files.schema import (
    Confidence,
    Count,
    Map,
    Meta,
    NonNegative,
    Number,
    Positive,
    Propositions,
    Text,
    TomlTable,
    Unit,
    Widths,
    key,
    table,
)
from jaxltl.app.files.task import FormulaFile, FormulaTable, GridTable, LearnerTable
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
class SimulatorTable(TomlTable):
    """``[world]``: the environment."""

    environment: Text | None = key(
        "Environment, or function that makes one; default the dynamics.", '"brax:ant"'
    )
    dynamics: Text | None = key(
        "Function that makes dynamics, in which the policy is proven; default the environment.",
        '"shuttle.py:make"',
    )
    arguments: Record = key("Arguments of the function.", "{ horizon = 120 }", factory=dict)
    labels: Text | None = key("Function of labels; default the environment's.", '"cart.py:labels"')
    propositions: Labels | None = key("Names of the labels; default the environment's.")
    horizon: Count | None = key("Longest episode in steps; default the environment's.")

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
class RewardTable(FormulaTable):
    """``[task]``: the formula and its reward; see ``jaxltl.task_environment``."""

    reward: Literal["auto", "reach", "keep", "eventual", "two-discount", "parity"] | None = key(
        "Reward of the formula; default auto.", '"reach"'
    )
    discount: Unit | None = key(
        "Discount of steps; default 1 for reach and keep without shaping, else 0.99.", "0.98"
    )
    ratio: Unit | None = key("Ratio of successive rewards; default 1 minus the discount.")
    shaping: Literal["auto", "distance", "none"] | None = key(
        "Potential-based shaping of the reward, auto for distance with ppo where all steps are "
        "discounted, so that it changes no optimal policy; default auto.",
        '"distance"',
    )
    ending: Literal["repeat", "violated", "undecided", "rejected"] | None = key(
        "Verdict where the world ends; default repeat, of its last label, or what the dynamics "
        "define.",
        '"violated"',
    )


@table
class SimulationTable(LearnerTable):
    """``[learner]``: the method."""

    method: Literal["ppo", "cce", "cpo"] = key("Learning algorithm.")
    steps: Count = key("Steps of the learner.")


@table
class PpoTable(hparams_table("ppo")):  # type: ignore[misc]
    """``[ppo]``: hyperparameters, and the networks."""

    discount: Unit = key("Discount of rewards.", "0.99", default=1.0)
    hidden: Widths | None = key("Widths of the networks' hidden layers; default [64, 64].")
    activation: Literal["tanh", "relu", "gelu", "silu"] | None = key("Activation; default tanh.")
    initial_deviation: NonNegative | None = key("Deviation of Gaussian actions; default 1.")


@table
class CceTable(hparams_table("cce", "sample_share", "num_samples")):  # type: ignore[misc]
    """``[cce]``: hyperparameters, the policy network, and the scores of samples."""

    rate: Schedule = key("Smoothing of the distribution's parameters.", default=0.5)
    margin: Number | None = key("Margin of the constraint.")
    noise: Schedule | None = key("Noise added to the variance.")
    hidden: Widths = key("Widths of the policy network's hidden layers.", factory=lambda: [16])
    activation: Literal["tanh", "relu"] = key("Activation of the network.", default="tanh")
    deviation: NonNegative = key("Initial deviation of the network's parameters.", default=1.0)
    objective: Score = key("Score that is maximised.", default="reward")
    cost: Score | None = key("Score that limit bounds; default none.", '"failure"')
    limit: Number | None = key("Upper bound of the cost; default none.", "0.1")
    episodes: Count = key("Episodes by which a sample is scored.", default=10)

    def __attrs_post_init__(self) -> None:
        self.require(
            self.limit is None or self.cost is not None,
            'limit is that of a cost: give cost = "failure", "violation" or another score.',
        )
        limited = self.cost is None or self.limit is not None
        self.require(limited, "cost needs a limit, its upper bound.")


@table
class CpoTable(hparams_table("trust_region", "method", "penalty")):  # type: ignore[misc]
    """``[cpo]``: hyperparameters, and the cost."""

    discount: Unit = key("Discount of rewards.", "0.99", default=1.0)
    limit: Number | None = key("Upper bound of the expected cost; default required.", "0.1")
    cost: Literal["world", "violation"] = key(
        "Cost: the world's, or 1 where the formula is violated.", default="world"
    )


_TABLES = {"ppo": PpoTable, "cce": CceTable, "cpo": CpoTable}


@table
class EvaluationTable(TomlTable):
    """``[evaluation]``: fresh episodes."""

    episodes: Count = key("Number of episodes.", default=1000)
    steps: Count | None = key("Steps after which an episode is cut off; default the horizon.")
    confidence: Confidence = key("Confidence of each interval.", default=0.95)
    threshold: Confidence | None = key("Success probability to test for; default none.")
    discount: Confidence | None = key("Discount of the discounted scores; default none.")
    policy: Literal["drawn", "likeliest"] | None = key(
        "Actions: drawn, or the likeliest ones; default drawn.", '"likeliest"'
    )


@table
class ProofTable(TomlTable):
    """``[proof]``: bounds of the learned policy's satisfaction probability, in worlds of dynamics."""

    cells: Cells | None = key(
        "Cells along each axis at first; default about 20,000 in all, at most 1,000 along an axis.",
        "[200, 200]",
    )
    tolerance: Confidence | None = key("Width of the bounds; default 0.001.", "0.01")
    threshold: Confidence | None = key("Stop when this bound is decided; default none.", "0.999")
    max_cells: Count | None = key("Cells of the finest grid; default 1048576.")


@table
class EnvironmentFile(FormulaFile):
    """A task file of a simulated world."""

    world: SimulatorTable = key("The environment.")
    task: RewardTable = key("The formula and its reward.")
    learner: SimulationTable = key("The method.")
    ppo: PpoTable | None = key("Hyperparameters of ppo.")
    cce: CceTable | None = key("Hyperparameters of cce.")
    cpo: CpoTable | None = key("Hyperparameters of cpo.")
    evaluation: EvaluationTable = key("Episodes of the evaluation.")
    proof: ProofTable = key("Proof of the learned policy.")

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


# --- worlds that are seen in part -----------------------------------------------------------------


Observations = Annotated[
    Count | list[str],
    Meta(
        'the odd side of a window in cells, such as 3, or a list of what is sensed, such as ["wall"]',
        bool,
    ),
]


@table
class PartialMapTable(GridTable):
    """``[world]``: a map, and what the robot sees of it."""

    map: Map = key("Rows of a text map, or the file that has them.")
    observations: Observations = key(
        "Side of the window of cells that is seen, or a list of what is sensed: wall, in the four "
        "directions, and propositions of the robot's own cell.",
        "3",
    )
    hidden: Propositions | None = key(
        "Kinds of cells that look like plain floor in a window; default none."
    )

    def __attrs_post_init__(self) -> None:
        if not isinstance(self.observations, int):
            self.refuse(("hidden",), "a window, such as observations = 3")


@table
class StartsTable(LearnerTable):
    """``[learner]``: the method, its steps and starts."""

    method: Literal["controller"] = key("Learning algorithm.")
    steps: Count = key("Gradient steps of each start.", default=200)
    discount: Unit = key(
        "Discount of steps, below 1 for quick controllers; probabilities are certified without.",
        default=1.0,
    )
    starts: Count = key("Starts of the gradient, in parallel, for each seed.", default=16)


@table
class ControllerTable(hparams_table("finite_state_controllers")):  # type: ignore[misc]
    """``[controller]``: hyperparameters, among them the memory states."""


@table
class BoundsTable(TomlTable):
    """``[bounds]``: exploration of beliefs for bounds of all controllers."""

    tolerance: Confidence = key("Width at which the exploration ends.", default=1e-3)
    beliefs: Count = key("Largest number of explored beliefs.", default=2000)
    seconds: Positive | None = key("Limit of the exploration; default none.")


@table
class ControllerFile(FormulaFile):
    """A task file of a world that is seen in part."""

    world: PartialMapTable = key("The map, and what is seen of it.")
    task: FormulaTable = key("The formula.")
    learner: StartsTable = key("The learner.")
    controller: ControllerTable = key("Hyperparameters.")
    bounds: BoundsTable = key("Bounds of all controllers.")

    def named_files(self) -> Sequence[str]:
        return [self.world.map["file"]] if isinstance(self.world.map, dict) else []
