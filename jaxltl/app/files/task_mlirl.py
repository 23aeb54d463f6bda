"""Schema of task files of maximum-likelihood inverse reinforcement learning (``"mlirl"``).

A task file is TOML with the tables ``[world]``, ``[task]``, ``[demonstrations]`` and
``[learner]``; ``examples/two_goals.toml`` shows every key. Names of files are relative to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal
from typing import Annotated as TomlKey

from jaxltl.app.files.hyperparameters import hparams_table
from jaxltl.app.files.schema import (
    Confidence,
    Count,
    Discount,
    LeastProbability,
    Map,
    NonNegative,
    Number,
    Propositions,
    StateNames,
    Text,
    Meta,
    table,
)
from jaxltl.app.files.task import (
    GridTable,
    Optimizer,
    OptimizerTable,
    SyntheticTable,
    TaskFile,
)

Initial = Annotated[
    Text | StateNames, Meta("a text; of a log, the name of a state or a list of names")
]
Progress = Annotated[
    list[str | int],
    Meta("a list of propositions (in the world) or of automaton states (in the product)"),
]
Start = Annotated[list[Number], Meta("a list of finite numbers, one per feature", example="[0.5]")]


@table
class WorldTable(GridTable):
    """``[world]``: a map, a model file, or a log of transitions."""

    map: TomlKey[Map | None, "Rows of a text map, or the file that has them; default none."] = None
    model: TomlKey[Text | None, "Model file; default none.", '"model.umb"'] = None
    constants: TomlKey[
        Text | None, "Constants of a program (.prism); default none.", '"N=64,MAX=4"'
    ] = None
    transitions: TomlKey[Text | None, "Log of transitions; default none.", '"log.csv"'] = None
    initial: TomlKey[
        Initial | None,
        "Formula of the initial states, or their names in a log; default all, or the model's.",
        '"s"',
    ] = None
    confidence: TomlKey[
        Confidence | None, "Confidence of a log, which requires it; default none."
    ] = None
    labels: TomlKey[Text | None, "Table of a log's labels; default none.", '"labels.csv"'] = None
    terminal: TomlKey[StateNames | None, "States of a log where episodes end; default none."] = None
    graph: TomlKey[
        Literal["seen", "complete"] | None,
        "Possible transitions of a log: those in the log, or all; default none.",
    ] = None
    least_probability: TomlKey[
        LeastProbability | None,
        "Assumed lower bound of a log's probabilities; default none.",
        "0.01",
    ] = None
    method: TomlKey[
        Literal["anytime", "clopper-pearson", "hoeffding", "weissman"] | None,
        "Confidence sets of a log; default anytime.",
    ] = None

    def __attrs_post_init__(self) -> None:
        sources = ("map", "model", "transitions")
        self.require_one(sources, "a map, a model (a file) or transitions (a log)")
        of_map = ("legend", "wall", "slip", "absorbing")
        if self.model is None:
            self.refuse(("constants",), "a model, a program in the PRISM language")
        if self.transitions is None:
            of_log = ("confidence", "labels", "terminal", "graph", "least_probability", "method")
            self.refuse(of_log, "transitions, a log")
            self.require(
                not isinstance(self.initial, list),
                "initial is a list of names of states, which a log has; here it must be a text.",
            )
            if self.model is not None:
                self.refuse(of_map, "a map; a model has it in its arrays")
            return
        self.refuse(of_map, "a map; of a log, labels name states in a file")
        self.require(
            self.confidence is not None,
            "lacks confidence of the guarantee from the log, such as 0.95.",
        )
        self.require(
            self.initial is not None,
            "lacks initial, the name of the initial state, or a list of names.",
        )
        self.require_one(
            ("graph", "least_probability"),
            'graph = "seen" (only transitions that the log contains are possible), '
            'graph = "complete" (all are), or least_probability, of the possible ones',
        )


@table
class DemonstrationsTable(SyntheticTable):
    """``[demonstrations]``: a file, or simulated ones."""

    file: TomlKey[Text | None, "JSON file of demonstrations; default none.", '"shown.json"'] = None

    def __attrs_post_init__(self) -> None:
        self.require_one(("file", "synthetic"), 'file = "..." or synthetic = N')
        if self.file is not None:
            self.refuse(("discount", "length"), "synthetic = N")


@table
class LearnerTable(hparams_table("mlirl", base=OptimizerTable)):  # type: ignore[misc]
    """``[learner]``: hyperparameters; see ``jaxltl.algos.mlirl.Hparams`` for other defaults."""

    # Files of todirl are read by task_todirl.
    method: TomlKey[
        Annotated[Literal["mlirl"], Meta('"mlirl" or "todirl"')], "Learning algorithm.", '"mlirl"'
    ]
    in_: TomlKey[
        Literal["product", "world"], "State space of the reward: the product, or the world alone."
    ] = "product"
    discount: TomlKey[Discount, "Discount of the learned reward."]
    steps: TomlKey[Count, "Largest number of steps of the optimizer."] = 500
    optimizer: TomlKey[Optimizer, "Optimizer of the likelihood."] = "lbfgs"
    tolerance: TomlKey[NonNegative, "Gradient norm at which learning has converged."] = 1e-6
    guess: TomlKey[Start | None, "Initial weights; default zeros."] = None
    satisfaction_over: TomlKey[
        Literal["initial", "all"], "States over which mu weighs the satisfaction probability."
    ] = "initial"
    avoid: TomlKey[
        Propositions | None, "Propositions that add the feature avoid; default none."
    ] = None
    goal: TomlKey[Propositions | None, 'Goal cells, for in = "world"; default none.', '["y"]'] = (
        None
    )
    progress: TomlKey[
        Progress | None,
        "Propositions or automaton states of the feature progress; default mlirl.progress_states.",
        "[1, 2]",
    ] = None

    def __attrs_post_init__(self) -> None:
        self.require(
            not self.in_world or self.goal is not None,
            'lacks goal, the propositions of the goal cells, which in = "world" needs since '
            "the learner does not see the formula.",
        )
        self.require(
            not self.in_world or self.mu is None,
            'mu weighs the satisfaction probability; it needs in = "product".',
        )
        if not self.in_world:
            self.refuse(("goal",), 'in = "world"')
        self.require(
            self.learning_rate is None or self.optimizer != "lbfgs",
            'learning_rate belongs to another optimizer, such as "adam"; "lbfgs", the default, '
            "searches for its own.",
        )
        kind = str if self.in_world else int
        if any(not isinstance(x, kind) for x in self.progress or ()):
            expected = "propositions" if self.in_world else "automaton states (or left out)"
            raise ValueError(f"progress = {self.progress!r}; it must be a list of {expected}.")

    @property
    def progress_labels(self) -> list[str]:
        """The propositions of progress, in the world."""
        return [x for x in self.progress or () if isinstance(x, str)]

    @property
    def progress_states(self) -> list[int] | None:
        """The automaton states of progress, in the product; None for the default."""
        if self.progress is None:
            return None
        return [x for x in self.progress if isinstance(x, int)]

    @property
    def hides_formula(self) -> str | None:
        return 'in = "world"' if self.in_world else None

    @property
    def in_world(self) -> bool:
        """True if the reward is one of world states, without the automaton."""
        return self.in_ == "world"


@table
class MlirlFile(TaskFile):
    """A task file of ``mlirl``."""

    world: TomlKey[WorldTable, "Where demonstrations were made."]
    demonstrations: TomlKey[DemonstrationsTable, "What was demonstrated."]
    learner: TomlKey[LearnerTable, "The learner and its hyperparameters."]

    def __attrs_post_init__(self) -> None:
        super().__attrs_post_init__()
        self.require(
            self.learner.mu is None or isinstance(self.guarantee, str),
            f"[task] guarantee = {self.guarantee} finds the weight mu that reaches it: leave "
            "mu out of [learner].",
        )

    def named_files(self) -> Sequence[str]:
        world, demonstrations = self.world, self.demonstrations
        named = [world.map["file"]] if isinstance(world.map, dict) else []
        named += [
            x for x in (world.model, world.transitions, world.labels, demonstrations.file) if x
        ]
        if world.model is not None:  # PRISM keeps labels in another file
            from jaxltl.io.prism.explicit import files_beside  # imports JAX

            beside = files_beside(self.path.parent / world.model)
            named += [str(x.absolute()) for x in beside]
        return named
