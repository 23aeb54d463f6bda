"""Schema of task files with a table ``[grounding]``: formulas over symbols of unknown meaning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal
from typing import Annotated as TomlKey

from jaxltl.app.files.schema import (
    Confidence,
    Count,
    Discount,
    Meta,
    NonNegative,
    TomlTable,
    Text,
    table,
)
from jaxltl.app.files.task import (
    FormulaFile,
    FormulaTable,
    GridTable,
    LearnerTable,
    SyntheticTable,
)
from jaxltl.app.files.task_todirl import Files, Maps, map_file

Observations = Annotated[
    Literal["cells"] | list[str],
    Meta('"cells", or a list of tables, one per map, such as ["seen.csv"]', bool),
]
Meanings = Annotated[
    dict[str, str], Meta('a table of symbols and propositions, such as { goal = "a" }', bool)
]


@table
class WorldTable(GridTable):
    """``[world]``: maps; what their legend states is observed and has no other meaning."""

    maps: TomlKey[Maps, "Maps with demonstrations."]
    initial: TomlKey[Text | None, "Formula of initial cells; default all cells.", '"a"'] = None


@table
class GroundingTable(TomlTable):
    """``[grounding]``: observations, and how their meaning is learned."""

    observations: TomlKey[
        Observations,
        "Observations: the propositions of the legend, or tables (CSV) of [world] maps and then of "
        "[test] maps, with a line of names and a line of numbers for each cell.",
    ]
    clusters: TomlKey[
        Count | None, "Number of clusters of noisy observations; default none, all are 0 or 1.", "6"
    ] = None
    level: TomlKey[Confidence, "Posterior weight of the credible set of groundings."] = 0.95


@table
class DemonstrationsTable(SyntheticTable):
    """``[demonstrations]``: files, or simulated ones by a soft optimal policy."""

    discount: TomlKey[Discount, "Discount of the demonstrator."] = 0.95
    files: TomlKey[Files | None, "Files of demonstrations, one per map; default none."] = None
    meaning: TomlKey[Meanings | None, "Hidden meanings, for simulations; default none."] = None
    scale: TomlKey[NonNegative, "Reward of an event, for simulations."] = 40.0

    def __attrs_post_init__(self) -> None:
        self.require_one(("files", "synthetic"), "files = [...] or synthetic = N")
        self.require_one(("files", "meaning"), "files = [...] or meaning = {...}, with synthetic")


@table
class TestTable(TomlTable):
    """``[test]``: further maps in which policies are certified."""

    maps: TomlKey[Maps, "Maps without demonstrations."]


@table
class GroundingFile(FormulaFile):
    """A task file with a table ``[grounding]``."""

    learner: LearnerTable = LearnerTable(method="grounding", steps=1)  # no table of the file
    world: TomlKey[WorldTable, "The worlds with demonstrations."]
    task: TomlKey[FormulaTable, "The formula over symbols."]
    grounding: TomlKey[GroundingTable, "Observations, and how their meaning is learned."]
    demonstrations: TomlKey[DemonstrationsTable, "What was demonstrated."]
    test: TomlKey[TestTable | None, "Further worlds."] = None

    @property
    def maps(self) -> list[str | dict[str, str]]:
        """The maps with demonstrations, then those of [test]."""
        return [*self.world.maps, *(self.test.maps if self.test else ())]

    @property
    def tables(self) -> list[str]:
        """The files of observations."""
        seen = self.grounding.observations
        return [] if isinstance(seen, str) else seen

    def __attrs_post_init__(self) -> None:
        for key, files, count in (
            ("[grounding] observations", self.tables, len(self.maps)),
            ("[demonstrations] files", self.demonstrations.files, len(self.world.maps)),
        ):
            if files and len(files) != count:
                raise ValueError(f"{key} has {len(files)} files for {count} maps.")

    def named_files(self) -> Sequence[str]:
        named = [*filter(None, map(map_file, self.maps)), *self.tables]
        return named + (self.demonstrations.files or [])
