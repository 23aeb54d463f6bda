"""Task files of simulated worlds, for ``method = "ppo"``, ``"cce"`` or ``"cpo"``.

Tables ``[world]``, with ``[world.arguments]``, ``[task]``, ``[learner]``, one of the method's name
for its hyperparameters, and ``[evaluation]``; ``examples/flat_world.toml`` shows them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal
from typing import Annotated as Key

import attrs

from jaxltl.app.files import schema
from jaxltl.app.files.schema import (
    Confidence,
    Count,
    File,
    NonNegative,
    Number,
    Table,
    Text,
    Unit,
    WholeNumber,
    Widths,
    Meta,
    table,
)

Schedule = Annotated[
    NonNegative | tuple[NonNegative, NonNegative],
    Meta("a number of at least 0, or [first, last], linear over all steps"),
]
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
class WorldTable(Table):
    """``[world]``: the environment."""

    environment: Key[Text, "Name of an environment, or of the function that makes one."]
    arguments: Key[dict[str, Any], "Arguments of that function."] = attrs.field(factory=dict)
    labels: Key[Text | None, "Function of the labels of an observation."] = None
    propositions: Key[Labels | None, "Names of the labels."] = None
    horizon: Key[Count | None, "Steps after which an episode is truncated."] = None

    def __attrs_post_init__(self) -> None:
        if (self.labels is None) != (self.propositions is None):
            raise ValueError(
                "labels and propositions belong together: a function and the names of what it "
                "returns."
            )

    def named_files(self) -> list[str]:
        """The Python files that the table names, each once."""
        named = [name.rpartition(":")[0] for name in (self.environment, self.labels) if name]
        return [name for name in dict.fromkeys(named) if name.endswith(".py")]


@table
class TaskTable(Table):
    """``[task]``: the formula and its reward; see ``jaxltl.task_environment``."""

    formula: Key[Text, "Formula of linear temporal logic."]
    reward: Key[
        Literal["auto", "reach", "keep", "eventual", "two-discount", "parity"] | None,
        "Reward of the formula.",
    ] = None
    discount: Key[Unit | None, "Discount of the reward."] = None
    ratio: Key[Unit | None, "Ratio of the rewards of successive priorities."] = None
    shaping: Key[Literal["distance"] | None, "Potential-based shaping of the reward."] = None
    ending: Key[
        Literal["repeat", "violated", "undecided"] | None, "Verdict where the world ends."
    ] = None


@table
class LearnerTable(Table):
    """``[learner]``: the method."""

    method: Key[Literal["ppo", "cce", "cpo"], "Learning algorithm."]
    steps: Key[Count, "Steps of the learner."]


@table
class PpoTable(Table):
    """``[ppo]``: see ``jaxltl.algos.ppo.Hparams`` for defaults."""

    discount: Key[Unit, "Discount of rewards."] = 1.0
    gae_lambda: Key[Unit | None, "Lambda of generalised advantages."] = None
    learning_rate: Key[Schedule | None, "Step size of Adam."] = None
    clip: Key[Schedule | None, "Clipping of probability ratios."] = None
    value_clip: Key[Schedule | None, "Clipping of values."] = None
    value_weight: Key[NonNegative | None, "Weight of the value loss."] = None
    entropy_weight: Key[NonNegative | None, "Weight of the entropy."] = None
    max_gradient_norm: Key[NonNegative | None, "Clipping of gradients."] = None
    target_kl: Key[NonNegative | None, "Divergence at which a step's updates end."] = None
    adam_epsilon: Key[NonNegative | None, "Epsilon of Adam."] = None
    num_envs: Key[Count | None, "Environments in parallel."] = None
    num_steps: Key[Count | None, "Steps of each environment in a step of the learner."] = None
    num_epochs: Key[Count | None, "Passes over the collected steps."] = None
    num_minibatches: Key[Count | None, "Minibatches of a pass."] = None
    normalize_advantage: Key[bool | None, "Standardise advantages in each minibatch."] = None
    normalize_observation: Key[bool | None, "Standardise observations."] = None
    normalize_reward: Key[bool | None, "Scale rewards by the deviation of returns."] = None
    squash: Key[Literal["clip", "tanh"] | None, "Map of Gaussian actions into a box."] = None
    num_resets: Key[WholeNumber | None, "Initial worlds drawn before each step."] = None
    hidden: Key[Widths | None, "Widths of the networks' hidden layers."] = None
    activation: Key[Literal["tanh", "relu", "gelu", "silu"] | None, "Activation."] = None
    initial_deviation: Key[NonNegative | None, "Initial deviation of Gaussian actions."] = None


@table
class CceTable(Table):
    """``[cce]``: see ``jaxltl.algos.cce.Hparams`` for other defaults."""

    rate: Key[Schedule, "Smoothing of the distribution's parameters."] = 0.5
    temperature: Key[NonNegative | None, "Temperature of the weights."] = None
    margin: Key[Number | None, "Margin of the constraint."] = None
    population: Key[Count | None, "Samples of a step."] = None
    rho: Key[Confidence | None, "Share of elites."] = None
    weighting: Key[Literal["until_feasible", "literal", "uniform"] | None, "Weights of elites."] = (
        None
    )
    elite_reuse: Key[bool | None, "Keep elites for the next step."] = None
    antithetic: Key[bool | None, "Draw samples in antithetic pairs."] = None
    variance_floor: Key[NonNegative | None, "Least variance."] = None
    noise: Key[Schedule | None, "Noise added to the variance."] = None
    restart_below: Key[NonNegative | None, "Deviation at which the search restarts."] = None
    hidden: Key[Widths, "Widths of the policy network's hidden layers."] = attrs.field(
        factory=lambda: [16]
    )
    activation: Key[Literal["tanh", "relu"], "Activation of the network."] = "tanh"
    deviation: Key[NonNegative, "Initial deviation of the network's parameters."] = 1.0
    objective: Key[Score, "Score that is maximised."] = "reward"
    cost: Key[Score | None, "Score that is constrained."] = None
    limit: Key[Number | None, "Upper limit of the cost."] = None
    episodes: Key[Count, "Episodes by which a sample is scored."] = 10

    def __attrs_post_init__(self) -> None:
        if self.limit is not None and self.cost is None:
            raise ValueError(
                'limit is that of a cost: give cost = "failure", "violation" or another score.'
            )
        if self.cost is not None and self.limit is None:
            raise ValueError("cost needs a limit, its upper bound.")


@table
class CpoTable(Table):
    """``[cpo]``: see ``jaxltl.algos.trust_region.Hparams`` for other defaults."""

    discount: Key[Unit, "Discount of rewards."] = 1.0
    cost_discount: Key[Unit | None, "Discount of costs."] = None
    gae_lambda: Key[Unit | None, "Lambda of generalised advantages."] = None
    cost_gae_lambda: Key[Unit | None, "Lambda of the costs' generalised advantages."] = None
    delta: Key[NonNegative | None, "Divergence of a step, at most."] = None
    damping: Key[NonNegative | None, "Damping of the Fisher matrix."] = None
    initial_deviation: Key[NonNegative | None, "Initial deviation of Gaussian actions."] = None
    backtrack: Key[Unit | None, "Factor of the line search."] = None
    value_rate: Key[NonNegative | None, "Step size of the value networks."] = None
    num_trajectories: Key[Count | None, "Trajectories of a step."] = None
    hidden: Key[Widths | None, "Widths of the policy network's hidden layers."] = None
    value_hidden: Key[Widths | None, "Widths of the value networks' hidden layers."] = None
    normalize: Key[bool | None, "Standardise observations."] = None
    cg_steps: Key[Count | None, "Steps of conjugate gradients."] = None
    search_steps: Key[Count | None, "Steps of the line search."] = None
    fisher_stride: Key[Count | None, "Every n-th state is used in the Fisher matrix."] = None
    value_epochs: Key[Count | None, "Passes of the value fit."] = None
    value_batches: Key[Count | None, "Minibatches of a pass of the value fit."] = None
    limit: Key[Number | None, "Upper bound of the expected cost of an episode; required."] = None
    cost: Key[
        Literal["world", "violation"], "Cost: the world's, or 1 where the formula is violated."
    ] = "world"


_TABLES = {"ppo": PpoTable, "cce": CceTable, "cpo": CpoTable}
METHODS = tuple(_TABLES)


@table
class EvaluationTable(Table):
    """``[evaluation]``: fresh episodes."""

    episodes: Key[Count, "Number of episodes."] = 1000
    steps: Key[Count | None, "Steps after which an episode is cut off."] = None
    confidence: Key[Confidence, "Confidence of each interval."] = 0.95
    threshold: Key[Confidence | None, "Success probability to test for."] = None
    discount: Key[Confidence | None, "Discount of the estimated discounted sums."] = None
    policy: Key[
        Literal["drawn", "likeliest"] | None, "Actions: drawn (default), or the likeliest ones."
    ] = None


@table
class EnvironmentFile(File):
    """Schema of the file."""

    KIND: ClassVar[str] = "the task file"
    world: Key[WorldTable, "The environment."]
    task: Key[TaskTable, "The formula and its reward."]
    learner: Key[LearnerTable, "The method."]
    ppo: Key[PpoTable | None, "Hyperparameters of ppo."] = None
    cce: Key[CceTable | None, "Hyperparameters of cce."] = None
    cpo: Key[CpoTable | None, "Hyperparameters of cpo."] = None
    evaluation: Key[EvaluationTable, "Episodes of the evaluation."] = EvaluationTable()


@dataclass(frozen=True)
class EnvironmentTask:
    """A checked task file of a simulated world.

    Attributes:
      path: the file; `name` is its stem, unless the file gives one.
      world, task, learner, evaluation: the tables.
      settings: the table of the method's name.
      given: the keys of `settings` that the file has.
      digest: SHA-256 of the file and of every file that it names.
      text: of the file when it was read.
    """

    path: Path
    name: str
    world: WorldTable
    task: TaskTable
    learner: LearnerTable
    settings: PpoTable | CceTable | CpoTable
    evaluation: EvaluationTable
    given: dict[str, Any]
    digest: str
    text: str

    @property
    def formula(self) -> str:
        """The formula of the task."""
        return self.task.formula


def is_environment_task(path: str | Path) -> bool:
    """Whether a task file is of a simulated world, by its world or by its method."""
    data = schema.read_toml(Path(path), EnvironmentFile.KIND)[0]
    world, learner = (data.get(name) for name in ("world", "learner"))
    simulated = isinstance(world, dict) and "environment" in world
    return simulated or (isinstance(learner, dict) and learner.get("method") in METHODS)


def read_task(path: str | Path, raw: bytes | None = None) -> EnvironmentTask:
    """Reads a task file of a simulated world."""
    path = Path(path)
    data, found = schema.read_toml(path, EnvironmentFile.KIND, raw)
    file = schema.convert(path, EnvironmentFile, data)
    method = file.learner.method
    tables = {name: getattr(file, name) for name in METHODS}
    for other, given in tables.items():
        if other != method and given is not None:
            raise ValueError(
                f'{path}: [{other}] is for method = "{other}", and [learner] says "{method}": '
                "leave one of them out."
            )
    if method == "cpo" and (file.cpo is None or file.cpo.limit is None):
        raise ValueError(
            f"{path}: [cpo] lacks limit, the upper bound of the expected cost of an episode."
        )
    if method == "cce" and file.evaluation.policy is not None:
        raise ValueError(
            f"{path}: [evaluation] policy is for methods whose policies draw their actions; that "
            'of "cce" draws none.'
        )
    digest = schema.digest(path, found, file.world.named_files()) if raw is None else ""
    return EnvironmentTask(
        path=path,
        name=file.name or path.stem,
        world=file.world,
        task=file.task,
        learner=file.learner,
        settings=tables[method] or _TABLES[method](),
        evaluation=file.evaluation,
        given=data.get(method, {}),
        digest=digest,
        text=found.decode(),
    )
