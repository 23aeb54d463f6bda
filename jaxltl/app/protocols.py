"""Protocols of learning jobs, which ``jaxltl learn`` runs from a task file to a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

from jaxltl.app.wording import Record

if TYPE_CHECKING:
    import numpy as np

    from jaxltl.algos.common.seeds import Training
    from jaxltl.app.files.task import FormulaFile
    from jaxltl.app.reports.drawing import Picture
    from jaxltl.app.reports.explorer import Curves, Explorer
    from jaxltl.app.reports.page import Report

T = TypeVar("T", bound="FormulaFile")
S = TypeVar("S")
O = TypeVar("O")  # noqa: E741


class Job(Protocol[T, S, O]):
    """A kind of learning job, with its task, setup and outcome; implemented by modules."""

    @property
    def DOUBLE(self) -> bool: ...  # True if figures are computed in double precision
    @property
    def FILE(self) -> type[T]: ...  # the schema of task files
    @property
    def report(self) -> Report: ...
    def prepare(self, task: T, seed: int) -> S: ...  # the objects that a task file describes
    def describe(self, setup: S) -> str: ...  # sizes of a setup, in one line
    def learn(self, setup: S, training: Training) -> O: ...  # with several seeds, keeping one
    def postfix(self, metrics: Mapping[str, np.ndarray]) -> dict[str, str]: ...  # newest metrics
    def summary(self, outcome: O) -> Record: ...  # the contents of ``result.json``
    def save(self, out: Path, outcome: O) -> None: ...  # writes the policy into a directory
    def task_pictures(self, setup: S) -> list[Picture]: ...  # those that need no outcome
    def pictures(self, outcome: O) -> list[Picture]: ...
    def live(self, outcome: O) -> Sequence[Explorer | Curves]: ...  # of the report


SomeJob: TypeAlias = Job[Any, Any, Any]  # of a kind that a task file decides
