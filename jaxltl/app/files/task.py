"""Tables common to the task files of all methods of learning from demonstrations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from jaxltl.app.files.schema import (
    Count,
    Discount,
    File,
    Legend,
    Propositions,
    TomlTable,
    Text,
    Meta,
    key,
    Unit,
    table,
    read_toml,
)
from jaxltl.app.wording import Record

_STEPS_FACTOR = 2.0  # multiple of the least expected steps that leaves room for the demonstrations

Probability = Annotated[float, Meta("a probability in (0, 1]", lambda v: 0 < v <= 1)]


def _is_guarantee(value: str | float | dict[str, float]) -> bool:
    if not isinstance(value, dict):
        return True
    complete = value.keys() == {"probability", "steps"}
    return complete and 0 < value["probability"] <= 1 and value["steps"] > 0


GuaranteeKey = Annotated[
    Literal["best", "none"] | Probability | dict[str, float],
    Meta(
        '"best", "none", a probability in (0, 1], or a probability and a number of steps, '
        "{ probability = 0.9, steps = 60 }",
        _is_guarantee,
    ),
]
StepsFactor = Annotated[
    Literal["none"] | float,
    Meta('a number of at least 1, or "none"', lambda v: v == "none" or v >= 1, "1.5"),
]


def _is_optimizer(name: str) -> bool:
    if name in ("lbfgs", "adam", "sgd"):
        return True
    from jaxltl.algos.common.optimizers import NAMES  # optax takes a second to import

    return name in NAMES


Optimizer = Annotated[
    str,
    Meta(
        '"lbfgs", or the name of an optimizer of optax that needs a learning rate alone, '
        'such as "adamw"',
        _is_optimizer,
    ),
]


@table
class GridTable(TomlTable):
    """Keys of ``[world]`` about text maps."""

    legend: Legend | None = key("Propositions of each kind of cell; default the kind itself.")
    wall: Text | None = key("Kind of cell that cannot be entered; default #.", '"x"')
    slip: Unit | None = key("Probability of slipping to either side; default 0.")
    absorbing: Propositions | None = key("Propositions of absorbing cells; default none.")
    initial: Text | None = key("Formula of initial cells; default all cells.", '"s"')


@table
class FormulaTable(TomlTable):
    """``[task]``: the formula."""

    formula: Text = key("Formula of linear temporal logic.", '"!r U (g & F y)"')


@table
class GuaranteeTable(FormulaTable):
    """``[task]``: the formula, and the guarantee."""

    label_on: Literal["entry", "exit"] | None = key(
        "Label read by a step: of the state entered (default with mlirl) or left (with todirl); "
        "default by the method."
    )
    guarantee: GuaranteeKey | None = key(
        "Satisfaction probability to certify; default best, and none if the learner does not see "
        "the formula.",
        "0.9",
    )
    steps_factor: StepsFactor | None = key(
        "Bound on the expected steps to satisfaction, as a multiple of the quickest optimal "
        "policy's; default 2, and none where guarantee has steps or is none."
    )
    over: Literal["mean", "worst"] | None = key(
        "Initial states of a given probability: their mean, or the worst; default mean.", '"worst"'
    )


@table
class SyntheticTable(TomlTable):
    """Keys of ``[demonstrations]`` about simulated demonstrations."""

    synthetic: Count | None = key("Number of simulated demonstrations; default none.")
    discount: Discount | None = key(
        "Discount of a simulated demonstrator's reward; default the quickest optimal policy."
    )
    length: Count | None = key("Longest simulated demonstration; default 200.")

    def entry(self, number: object, pairs: object) -> Record:
        """The demonstrations in ``result.json``."""
        return {"number": number, "pairs": pairs, "synthetic": self.synthetic is not None}


@table
class LearnerTable(TomlTable):
    """``[learner]`` of any method."""

    method: str = key("Learning algorithm.")
    steps: Count = key("Steps of the learner.")


@table
class OptimizerTable(LearnerTable):
    """Keys of ``[learner]`` of all methods of learning from demonstrations."""

    @property
    def hides_formula(self) -> str | None:
        """The key that hides the formula from the learner, if there is one."""
        return None

    def hyperparameters(self) -> Record:
        """The keys that have a value, but the method."""
        return {key: value for key, value in self.specified().items() if key != "method"}


@table
class FormulaFile(File):
    """A task file of any method."""

    task: FormulaTable = key("The formula.")
    learner: LearnerTable = key("The learner.")

    @property
    def formula(self) -> str:
        """Formula of linear temporal logic."""
        return self.task.formula


@table
class TaskFile(FormulaFile):
    """A task file of learning from demonstrations."""

    LABEL_ON: ClassVar[str] = "entry"  # default of label_on
    task: GuaranteeTable = key("The formula, and the guarantee.")
    learner: OptimizerTable = key("The learner and its hyperparameters.")

    @property
    def label_on(self) -> str:
        """The label that a step of the product reads, of its "entry" or "exit"."""
        return self.task.label_on or self.LABEL_ON

    @property
    def guarantee(self) -> str | float:
        """Either "best", "none" or a probability to certify."""
        requested = self.task.guarantee or ("none" if self.learner.hides_formula else "best")
        return requested["probability"] if isinstance(requested, dict) else requested

    @property
    def over(self) -> str:
        """Initial states of a probability to certify, "mean" or "worst"."""
        return self.task.over or "mean"

    @property
    def steps(self) -> float | None:
        """Bound on the expected steps to satisfaction, if it is a number."""
        requested = self.task.guarantee
        return requested["steps"] if isinstance(requested, dict) else None

    @property
    def steps_factor(self) -> float | None:
        """The same bound as a multiple of the quickest optimal policy's steps."""
        factor = self.task.steps_factor
        return None if factor == "none" or self.steps else float(factor or _STEPS_FACTOR)

    def __attrs_post_init__(self) -> None:
        guarantee, factor = self.guarantee, self.task.steps_factor
        self.require(
            guarantee == "none" or not self.learner.hides_formula,
            f"[task] guarantee = {guarantee!r} needs a learner that sees the formula and has "
            f"no horizon: leave out {self.learner.hides_formula}.",
        )
        self.require(
            self.task.over is None or not isinstance(guarantee, str),
            "[task] over belongs to a guarantee that is a probability.",
        )
        if factor not in (None, "none") and (self.steps is not None or guarantee == "none"):
            other = 'none, with guarantee = "none"' if self.steps is None else "steps in guarantee"
            raise ValueError(f"[task] steps_factor = {factor:g} bounds steps; there is {other}.")


def kind_of(path: Path) -> Literal["environment", "grounding", "controller", "todirl", "mlirl"]:
    """The kind of a task file, unchecked: by its world, its tables or its method."""
    data = read_toml(path, TaskFile.KIND)[0]
    world, learner = (x if isinstance(x := data.get(k), dict) else {} for k in ("world", "learner"))
    method, simulated = learner.get("method"), world.keys() & {"environment", "dynamics"}
    if simulated or method in ("ppo", "cce", "cpo"):
        return "environment"
    if "grounding" in data:
        return "grounding"
    if "observations" in world or method == "controller":
        return "controller"
    return "todirl" if method == "todirl" else "mlirl"
