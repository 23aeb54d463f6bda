"""Schema of task files of worlds that are seen in part: maps with a key ``observations``.

Tables ``[world]``, ``[task]``, ``[learner]``, ``[controller]`` for hyperparameters, and ``[bounds]``;
``examples/two_rooms.toml`` shows them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal
from typing import Annotated as TomlKey

from jaxltl.app.files.schema import (
    Confidence,
    Count,
    Map,
    Meta,
    NonNegative,
    Propositions,
    Text,
    Unit,
    TomlTable,
    table,
)
from jaxltl.app.files.task import FormulaFile, FormulaTable, GridTable, LearnerTable as AnyTable
from jaxltl.app.files.hyperparameters import hparams_table

Observations = Annotated[
    Count | list[str],
    Meta(
        'the odd side of a window in cells, such as 3, or a list of what is sensed, such as ["wall"]',
        bool,
    ),
]


@table
class WorldTable(GridTable):
    """``[world]``: a map, and what the robot sees of it."""

    map: TomlKey[Map, "Rows of a text map, or the file that has them."]
    observations: TomlKey[
        Observations,
        "Side of the window of cells that is seen, or a list of what is sensed: wall, in the four "
        "directions, and propositions of the robot's own cell.",
        "3",
    ]
    hidden: TomlKey[
        Propositions | None, "Kinds of cells that look like plain floor in a window; default none."
    ] = None
    initial: TomlKey[Text | None, "Formula of initial cells; default all cells.", '"s"'] = None

    def __attrs_post_init__(self) -> None:
        if not isinstance(self.observations, int):
            self.refuse(("hidden",), "a window, such as observations = 3")


@table
class LearnerTable(AnyTable):
    """``[learner]``: the method, its steps and starts."""

    method: TomlKey[Literal["controller"], "Learning algorithm."]
    steps: TomlKey[Count, "Gradient steps of each start."] = 200
    discount: TomlKey[
        Unit,
        "Discount of steps, below 1 for quick controllers; probabilities are certified without.",
    ] = 1.0
    starts: TomlKey[Count, "Starts of the gradient, in parallel, for each seed."] = 16


@table
class ControllerTable(hparams_table("finite_state_controllers")):  # type: ignore[misc]
    """``[controller]``: hyperparameters, among them the memory states."""


@table
class BoundsTable(TomlTable):
    """``[bounds]``: exploration of beliefs for bounds of all controllers."""

    tolerance: TomlKey[Confidence, "Width at which the exploration ends."] = 1e-3
    beliefs: TomlKey[Count, "Largest number of explored beliefs."] = 2000
    seconds: TomlKey[NonNegative | None, "Limit of the exploration; default none.", "60"] = None


@table
class ControllerFile(FormulaFile):
    """A task file of a world that is seen in part."""

    world: TomlKey[WorldTable, "The map, and what is seen of it."]
    task: TomlKey[FormulaTable, "The formula."]
    learner: TomlKey[LearnerTable, "The learner."]
    controller: TomlKey[ControllerTable, "Hyperparameters."] = ControllerTable()
    bounds: TomlKey[BoundsTable, "Bounds of all controllers."] = BoundsTable()

    def __attrs_post_init__(self) -> None:
        self.require(
            self.bounds.seconds is None or self.bounds.seconds > 0,
            "[bounds] seconds = 0; give a positive number of seconds, or leave it out.",
        )

    def named_files(self) -> Sequence[str]:
        return [self.world.map["file"]] if isinstance(self.world.map, dict) else []
