"""Schema of task files of task-oriented inverse reinforcement learning (``"todirl"``).

Table ``[test]`` has the worlds in which the learned reward is evaluated; see
``examples/in_order.toml``. Worlds are coloured grids (:func:`jaxltl.io.colored_world.read_world`)
or text maps with a legend.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal
from typing import Annotated as TomlKey

import attrs

from jaxltl.app.files.hyperparameters import hparams_table
from jaxltl.app.files.schema import (
    Count,
    Discount,
    Map,
    Number,
    TomlTable,
    Text,
    Unit,
    WholeNumber,
    Widths,
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

ColorCounts = Annotated[
    dict[str, dict[str, int]],
    Meta("a table of kinds and their colours, such as { o1 = { red = 5, black = 4 } }"),
]
Maps = Annotated[
    list[Map],
    Meta(
        'a list of files and of maps with line breaks, such as ["map.txt"], with at least '
        "one of them",
        bool,
    ),
]
Files = Annotated[list[str], Meta("a list of files, one per world", bool, '["shown.json"]')]
Shape = Annotated[tuple[Count, Count], Meta("[rows, columns]", example="[10, 12]")]
Names = Annotated[list[str], Meta("a list of names", example='["seed 3"]')]
REWARDS = ("progress", "failure", "step", "won", "lost")


@table
class WorldTable(GridTable):
    """``[world]``: the training worlds."""

    maps: TomlKey[Maps, "Maps of the training worlds."]
    objects: TomlKey[ColorCounts | None, "Kinds of goal cells, by colours; default o1, o2, o3."] = (
        None
    )
    obstacles: TomlKey[ColorCounts | None, "Kinds of obstacles, by colours; default ob."] = None
    margin: TomlKey[Count | None, "Rings of cells that are seen, not entered; default 1.", "2"] = (
        None
    )
    initial: TomlKey[Text | None, "Formula of initial cells; default all cells.", '"s"'] = None
    transitions: TomlKey[
        None,
        "Belongs to mlirl.",
        Meta(
            'left out: a log has no cells for a network to look around in; "mlirl" learns from logs'
        ),
    ] = None

    def __attrs_post_init__(self) -> None:
        if self.legend is None:
            self.refuse(("wall", "absorbing", "initial"), "maps with a legend")
        else:
            of_colors = ("objects", "obstacles", "margin")
            self.refuse(of_colors, "coloured worlds, which have no legend")


@table
class DemonstrationsTable(SyntheticTable):
    """``[demonstrations]``: files, or simulated ones."""

    files: TomlKey[Files | None, "Files of demonstrations, one per world; default none."] = None
    progress: TomlKey[
        Number | None, "Expert's reward of progress of the automaton; default 10."
    ] = None
    failure: TomlKey[Number | None, "Expert's reward of violating the formula; default -10."] = None
    step: TomlKey[Number | None, "Expert's reward of each step; default -1."] = None
    won: TomlKey[Number | None, "Expert's reward in satisfied states; default 3."] = None
    lost: TomlKey[Number | None, "Expert's reward in violated states; default -3."] = None

    def __attrs_post_init__(self) -> None:
        self.require_one(("files", "synthetic"), "files = [...] or synthetic = N")
        if self.files is not None:
            self.refuse(("discount", "length", *REWARDS), "synthetic = N")
        if self.discount is None:
            self.refuse(
                REWARDS,
                "a demonstrator who maximises a reward; give its discount too, for example 0.95, "
                "or leave it out for rollouts of the quickest optimal policy",
            )

    def rewards(self) -> dict[str, float]:
        """The rewards of the simulated expert that the file gives."""
        return {key: value for key, value in self.specified().items() if key in REWARDS}


@table
class LearnerTable(hparams_table("todirl", "mu", "tolerance", "method", base=OptimizerTable)):  # type: ignore[misc]
    """``[learner]``: hyperparameters; see ``jaxltl.algos.todirl.Hparams`` for other defaults."""

    method: TomlKey[Literal["todirl"], "Learning algorithm."]
    discount: TomlKey[Unit, "Discount of the learned reward; 1 needs a horizon.", "0.95"]
    memory: TomlKey[Text | None, "Formula of the memory; default the task's.", '"F o1"'] = None
    radius: TomlKey[WholeNumber, "Cells that are observed around the own one."] = 1
    hidden: TomlKey[Widths, "Widths of the reward network's hidden layers."] = attrs.field(
        factory=lambda: [80, 80]
    )
    steps: TomlKey[Count, "Largest number of steps of the optimizer."] = 300
    patience: TomlKey[
        Count | None, "Steps without a better held-out likelihood after which learning ends."
    ] = None
    held_out: TomlKey[Discount, "Share of the demonstrations that is held out.", "0.1"] = 0.2
    optimizer: TomlKey[Optimizer | None, "Optimizer of the likelihood."] = None

    def __attrs_post_init__(self) -> None:
        self.require(
            self.discount != 1 or self.horizon is not None,
            "discount = 1 needs a horizon, the number of steps of an episode; or choose a "
            "discount below 1, such as 0.95.",
        )
        self.require(
            self.optimizer != "lbfgs" or self.learning_rate is None,
            'learning_rate does not belong to optimizer = "lbfgs", which searches for its own.',
        )
        self.require(
            self.held_out != 0 or self.patience is None,
            "patience waits for a better held-out likelihood; it needs a held_out above 0.",
        )

    @property
    def hides_formula(self) -> str | None:
        return next((k for k in ("memory", "horizon") if getattr(self, k) is not None), None)


@table
class TestTable(TomlTable):
    """``[test]``: worlds for the evaluation, which have no part in learning."""

    maps: TomlKey[Maps | None, "Test worlds; default none."] = None
    generate: TomlKey[Count | None, "Number of random test worlds; default none."] = None
    obstacles: TomlKey[WholeNumber | None, "Random obstacles; default as in training."] = None
    min_distance: TomlKey[Count | None, "Least distance of random objects; default 3.", "4"] = None
    shape: TomlKey[Shape | None, "Rows and columns of a random world; default as in training."] = (
        None
    )
    seed: TomlKey[WholeNumber | None, "First seed of the random worlds; default 0."] = None
    leave_out: TomlKey[Names, "Names of test worlds that do not count in means."] = attrs.field(
        factory=list
    )

    def __attrs_post_init__(self) -> None:
        self.require(
            self.maps is not None or self.generate is not None,
            "must have maps = [...] or generate = N, or both.",
        )
        if self.generate is None:
            self.refuse(("obstacles", "min_distance", "shape", "seed"), "generate = N")


@table
class TodirlFile(TaskFile):
    """A task file of ``todirl``."""

    LABEL_ON: ClassVar[str] = "exit"
    world: TomlKey[WorldTable, "The training worlds."]
    demonstrations: TomlKey[DemonstrationsTable, "What was demonstrated."]
    learner: TomlKey[LearnerTable, "The learner and its hyperparameters."]
    test: TomlKey[TestTable | None, "The test worlds."] = None

    def __attrs_post_init__(self) -> None:
        files, count = self.demonstrations.files, len(self.world.maps)
        if files is not None and len(files) != count:
            raise ValueError(
                f"[demonstrations] names {len(files)} files for {count} worlds; give one for each "
                "of [world] maps, in their order."
            )
        self.require(
            self.is_colored or self.test is None or self.test.generate is None,
            "[test] generate makes coloured worlds; where [world] has a legend, give maps = [...].",
        )
        super().__attrs_post_init__()

    def named_files(self) -> Sequence[str]:
        maps = [*self.world.maps, *((self.test and self.test.maps) or ())]
        return [*filter(None, map(map_file, maps)), *(self.demonstrations.files or ())]

    @property
    def memory(self) -> str:
        """Formula of the learner's memory automaton."""
        return self.learner.memory or self.formula

    @property
    def is_colored(self) -> bool:
        """True if worlds are coloured grids, not text maps with a legend."""
        return self.world.legend is None

    @property
    def left_out(self) -> list[str]:
        """Names of test worlds that do not count in means."""
        return [] if self.test is None else self.test.leave_out


def map_file(entry: str | dict[str, str]) -> str | None:
    """The file that an entry of ``maps`` names; None for the text of a map."""
    if isinstance(entry, dict):
        return entry["file"]
    return None if "\n" in entry else entry
