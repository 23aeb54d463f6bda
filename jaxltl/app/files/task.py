"""Tables common to the task files of all methods of learning from demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal
from typing import Annotated as Key


from jaxltl.app.files.schema import (
    Count,
    Discount,
    File,
    Legend,
    NonNegative,
    Propositions,
    Table,
    Text,
    Meta,
    Unit,
    table,
    read_toml,
)
from jaxltl.app.wording import Record

Probability = Annotated[float, Meta("a probability in (0, 1]", lambda v: 0 < v <= 1)]
GuaranteeKey = Annotated[
    Literal["best", "none"] | Probability,
    Meta('"best", "none" or a probability in (0, 1]'),
]


@table
class GridTable(Table):
    """Keys of ``[world]`` about text maps."""

    legend: Key[Legend | None, "Propositions of each kind of cell; default the kind itself."] = None
    wall: Key[Text | None, "Kind of cell that cannot be entered; default #."] = None
    slip: Key[Unit | None, "Probability of slipping to either side; default 0."] = None
    absorbing: Key[Propositions | None, "No move leaves a cell where one of them holds."] = None


@table
class TaskTable(Table):
    """``[task]``: the formula, and the guarantee."""

    formula: Key[Text, "Formula of linear temporal logic."]
    label_on: Key[
        Literal["entry", "exit"] | None,
        "Label read by a step: of the state entered, or of the state left.",
    ] = None
    guarantee: Key[
        GuaranteeKey | None,
        "Satisfaction probability to certify: the best one, a given one, or none.",
    ] = None
    over: Key[
        Literal["mean", "worst"] | None,
        "Initial states of a given probability: their mean (default), or the worst.",
    ] = None


@table
class SyntheticTable(Table):
    """Keys of ``[demonstrations]`` about simulated demonstrations."""

    synthetic: Key[Count | None, "Number of simulated demonstrations."] = None
    discount: Key[
        Discount | None,
        "Discount of a simulated demonstrator's reward; default the quickest optimal policy.",
    ] = None
    length: Key[Count | None, "Longest simulated demonstration."] = None


@table
class OptimizerTable(Table):
    """Keys of ``[learner]`` of every method."""

    l2: Key[NonNegative | None, "Precision of the Gaussian prior on the parameters."] = None
    learning_rate: Key[NonNegative | None, "Step size of the optimizer."] = None

    def hyperparameters(self) -> Record:
        """The keys that have a value, but the method."""
        return {key: value for key, value in self.given().items() if key != "method"}


@table
class TaskFile(File):
    KIND: ClassVar[str] = "the task file"
    task: Key[TaskTable, "The formula, and the guarantee."]


@dataclass(frozen=True, kw_only=True)
class Task:
    """A checked task file of learning from demonstrations."""

    path: Path  # the file; `name` is its stem, unless the file gives one
    name: str
    formula: str  # of linear temporal logic
    label_on: str  # which label a step of the product reads, "entry" or "exit"
    guarantee: str | float  # "best", "none" or a probability to certify
    over: str  # initial states of a probability to certify, "mean" or "worst"
    digest: str  # SHA-256 of the file and of every file that it names


def common_fields(
    path: Path, file: TaskFile, hidden: str | None, digest: str, label_on: str
) -> Record:
    task = file.task
    guarantee = task.guarantee or ("none" if hidden else "best")
    where = f"{path}: [task]"
    if hidden and guarantee != "none":
        raise ValueError(
            f"{where} guarantee = {guarantee!r} needs a learner that sees the formula and has "
            f"no horizon: leave out {hidden}."
        )
    if task.over is not None and isinstance(guarantee, str):
        raise ValueError(f"{where} over belongs to a guarantee that is a probability.")
    return {
        "path": path,
        "name": file.name or path.stem,
        "formula": task.formula,
        "label_on": task.label_on or label_on,
        "guarantee": guarantee,
        "over": task.over or "mean",
        "digest": digest,
    }


def method_of(path: str | Path) -> object:
    """``[learner] method`` of a task file, unchecked; None without one."""
    learner = read_toml(Path(path), TaskFile.KIND)[0].get("learner")
    return learner.get("method") if isinstance(learner, dict) else None


ENVIRONMENT_METHODS = ("ppo", "cce", "cpo")


def is_environment_task(path: str | Path) -> bool:
    """True if a task file is of a simulated world, by its world or by its method."""
    data = read_toml(Path(path), TaskFile.KIND)[0]
    world, learner = (data.get(name) for name in ("world", "learner"))
    simulated = isinstance(world, dict) and "environment" in world
    return simulated or (isinstance(learner, dict) and learner.get("method") in ENVIRONMENT_METHODS)
