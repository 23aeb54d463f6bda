"""Task files of simulated worlds, for ``method = "ppo"``, ``"cce"`` or ``"cpo"``.

Tables ``[world]``, with ``[world.arguments]``, ``[task]``, ``[learner]``, one of the method's name
for its hyperparameters, and ``[evaluation]``; ``examples/flat_world.toml`` shows them.
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal
from typing import Annotated as Key

import attrs

from jaxltl.algos import cce, ppo, trust_region

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
    Widths,
    Meta,
    table,
)
from jaxltl.app.wording import Record

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
    arguments: Key[Record, "Arguments of that function."] = attrs.field(factory=dict)
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


def hparams_table(hparams: type[Any], *omit: str) -> Any:
    """A base class with the declared hyperparameters of a learner; default the learner's."""
    texts = re.findall(r"^ {6}(\w+): ([^;.]+)", hparams.__doc__ or "", re.MULTILINE)
    fields = {}
    for field in dataclasses.fields(hparams):
        if "valid" in field.metadata and field.name not in omit:
            kind: Any = Key[_type_of(field) | None, dict(texts).get(field.name, "")]
            fields[field.name] = attrs.field(default=None, type=kind)
    return attrs.make_class(
        "HparamsTable", fields, bases=(Table,), frozen=True, kw_only=True, slots=False
    )


def _type_of(field: dataclasses.Field[Any]) -> Any:
    """The type of a hyperparameter in a file, from its declared valid values."""
    valid = field.metadata["valid"]
    values = valid.values
    if values is bool:
        return bool
    if isinstance(values, tuple):
        return Literal[values]
    if values.integer:
        whole = Annotated[int, Meta(str(values), values.contains)]
        return Widths if "tuple" in str(field.type) else whole
    number = Annotated[float, Meta(f"a number, {values}", values.contains)]
    if not valid.may_be_schedule:
        return number
    title = f"a number, {values}; or [first, last], linear over all steps"
    return Annotated[number | tuple[number, number], Meta(title)]


@table
class PpoTable(hparams_table(ppo.Hparams)):  # type: ignore[misc]
    """``[ppo]``: hyperparameters, and the networks."""

    discount: Key[Unit, "Discount of rewards."] = 1.0
    hidden: Key[Widths | None, "Widths of the networks' hidden layers."] = None
    activation: Key[Literal["tanh", "relu", "gelu", "silu"] | None, "Activation."] = None
    initial_deviation: Key[NonNegative | None, "Initial deviation of Gaussian actions."] = None


@table
class CceTable(hparams_table(cce.Hparams, "sample_share", "num_samples")):  # type: ignore[misc]
    """``[cce]``: hyperparameters, the policy network, and the scores of samples."""

    rate: Key[Schedule, "Smoothing of the distribution's parameters."] = 0.5
    margin: Key[Number | None, "Margin of the constraint."] = None
    noise: Key[Schedule | None, "Noise added to the variance."] = None
    hidden: Key[Widths, "Widths of the policy network's hidden layers."] = attrs.field(
        factory=lambda: [16]
    )
    activation: Key[Literal["tanh", "relu"], "Activation of the network."] = "tanh"
    deviation: Key[NonNegative, "Initial deviation of the network's parameters."] = 1.0
    objective: Key[Score, "Score that is maximised."] = "reward"
    cost: Key[Score | None, "Score that is constrained."] = None
    limit: Key[Number | None, "Upper bound of the cost."] = None
    episodes: Key[Count, "Episodes by which a sample is scored."] = 10

    def __attrs_post_init__(self) -> None:
        if self.limit is not None and self.cost is None:
            raise ValueError(
                'limit is that of a cost: give cost = "failure", "violation" or another score.'
            )
        if self.cost is not None and self.limit is None:
            raise ValueError("cost needs a limit, its upper bound.")


@table
class CpoTable(hparams_table(trust_region.Hparams, "method", "penalty")):  # type: ignore[misc]
    """``[cpo]``: hyperparameters, and the cost."""

    discount: Key[Unit, "Discount of rewards."] = 1.0
    limit: Key[Number | None, "Upper bound of the expected cost of an episode; required."] = None
    cost: Key[
        Literal["world", "violation"], "Cost: the world's, or 1 where the formula is violated."
    ] = "world"


_TABLES = {"ppo": PpoTable, "cce": CceTable, "cpo": CpoTable}


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
    path: Path  # the file; `name` is its stem, unless the file gives one
    name: str
    world: WorldTable  # world, task, learner, evaluation: the tables
    task: TaskTable
    learner: LearnerTable
    settings: PpoTable | CceTable | CpoTable  # the table of the method's name
    evaluation: EvaluationTable
    given: Record  # the keys of `settings` that the file has
    digest: str  # SHA-256 of the file and of every file that it names
    text: str  # of the file when it was read

    @property
    def formula(self) -> str:
        return self.task.formula


def read_task(path: str | Path, raw: bytes | None = None) -> EnvironmentTask:
    path = Path(path)
    data, found = schema.read_toml(path, EnvironmentFile.KIND, raw)
    file = schema.convert(path, EnvironmentFile, data)
    method = file.learner.method
    tables = {name: getattr(file, name) for name in _TABLES}
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
