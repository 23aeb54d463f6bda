"""Schemas of task files of learning from demonstrations: mlirl, todirl, and symbol grounding.

Examples: ``two_goals.toml``, ``in_order.toml`` and ``unlabelled_delivery.toml``. Names of files are
relative to the task file.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from jaxltl.app.files.hyperparameters import hparams_table
from jaxltl.app.files.schema import (
    Confidence,
    Count,
    Discount,
    LeastProbability,
    Map,
    Meta,
    NonNegative,
    Number,
    Propositions,
    StateNames,
    Text,
    TomlTable,
    Unit,
    WholeNumber,
    Widths,
    key,
    read_map,
    table,
)
from jaxltl.app.files.task import (
    FormulaFile,
    FormulaTable,
    GridTable,
    LearnerTable,
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
class ModelTable(GridTable):
    """``[world]``: a map, a model file, or a log of transitions."""

    map: Map | None = key("Rows of a text map, or the file that has them; default none.")
    model: Text | None = key("Model file; default none.", '"model.umb"')
    constants: Text | None = key("Constants of a program (.prism); default none.", '"N=64,MAX=4"')
    transitions: Text | None = key("Log of transitions; default none.", '"log.csv"')
    initial: Initial | None = key(  # type: ignore[assignment]
        "Formula of the initial states, or their names in a log; default all, or the model's.",
        '"s"',
    )
    confidence: Confidence | None = key("Confidence of a log, which requires it; default none.")
    labels: Text | None = key("Table of a log's labels; default none.", '"labels.csv"')
    terminal: StateNames | None = key("States of a log where episodes end; default none.")
    graph: Literal["seen", "complete"] | None = key(
        "Possible transitions of a log: those in the log, or all; default none."
    )
    least_probability: LeastProbability | None = key(
        "Assumed lower bound of a log's probabilities; default none.", "0.01"
    )
    method: Literal["anytime", "clopper-pearson", "hoeffding", "weissman"] | None = key(
        "Confidence sets of a log; default anytime."
    )

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
class FileOrSyntheticTable(SyntheticTable):
    """``[demonstrations]``: a file, or simulated ones."""

    file: Text | None = key("JSON file of demonstrations; default none.", '"shown.json"')

    def __attrs_post_init__(self) -> None:
        self.require_one(("file", "synthetic"), 'file = "..." or synthetic = N')
        if self.file is not None:
            self.refuse(("discount", "length"), "synthetic = N")


@table
class MlirlTable(hparams_table("mlirl", base=OptimizerTable)):  # type: ignore[misc]
    """``[learner]``: hyperparameters; see ``jaxltl.algos.mlirl.Hparams`` for other defaults."""

    method: Annotated[Literal["mlirl"], Meta('"mlirl" or "todirl"')] = key(
        "Learning algorithm.", '"mlirl"'
    )
    in_: Literal["product", "world"] = key(
        "State space of the reward: the product, or the world alone.", default="product"
    )
    discount: Discount = key("Discount of the learned reward.")
    steps: Count = key("Largest number of steps of the optimizer.", default=500)
    optimizer: Optimizer = key("Optimizer of the likelihood.", default="lbfgs")
    tolerance: NonNegative = key("Gradient norm at which learning has converged.", default=1e-6)
    guess: Start | None = key("Initial weights; default zeros.")
    satisfaction_over: Literal["initial", "all"] = key(
        "States over which mu weighs the satisfaction probability.", default="initial"
    )
    avoid: Propositions | None = key("Propositions that add the feature avoid; default none.")
    goal: Propositions | None = key('Goal cells, for in = "world"; default none.', '["y"]')
    progress: Progress | None = key(
        "Propositions or automaton states of the feature progress; default mlirl.progress_states.",
        "[1, 2]",
    )

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
    def hides_formula(self) -> str | None:
        return 'in = "world"' if self.in_world else None

    @property
    def in_world(self) -> bool:
        """True if the reward is one of world states, without the automaton."""
        return self.in_ == "world"


@table
class MlirlFile(TaskFile):
    """A task file of ``mlirl``."""

    world: ModelTable = key("Where demonstrations were made.")
    demonstrations: FileOrSyntheticTable = key("What was demonstrated.")
    learner: MlirlTable = key("The learner and its hyperparameters.")

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
        single = (world.model, world.transitions, world.labels, demonstrations.file)
        named += filter(None, single)
        if world.model is not None:  # PRISM keeps labels in another file
            from jaxltl.io.prism.explicit import files_beside  # imports JAX

            named += [str(x.absolute()) for x in files_beside(self.path.parent / world.model)]
        return named


# --- todirl ---------------------------------------------------------------------------------------


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
class ScenesTable(GridTable):
    """``[world]``: the training worlds."""

    maps: Maps = key("Maps of the training worlds.")
    objects: ColorCounts | None = key("Kinds of goal cells, by colours; default o1, o2, o3.")
    obstacles: ColorCounts | None = key("Kinds of obstacles, by colours; default ob.")
    margin: Count | None = key("Rings of cells that are seen, not entered; default 1.", "2")
    transitions: Annotated[
        None,
        Meta(
            'left out: a log has no cells for a network to look around in; "mlirl" learns from logs'
        ),
    ] = key("Belongs to mlirl.", default=None)

    def __attrs_post_init__(self) -> None:
        if self.legend is None:
            self.refuse(("wall", "absorbing", "initial"), "maps with a legend")
        else:
            of_colors = ("objects", "obstacles", "margin")
            self.refuse(of_colors, "coloured worlds, which have no legend")


@table
class ExpertTable(SyntheticTable):
    """``[demonstrations]``: files, or simulated ones."""

    files: Files | None = key("Files of demonstrations, one per world; default none.")
    progress: Number | None = key("Expert's reward of progress of the automaton; default 10.")
    failure: Number | None = key("Expert's reward of violating the formula; default -10.")
    step: Number | None = key("Expert's reward of each step; default -1.")
    won: Number | None = key("Expert's reward in satisfied states; default 3.")
    lost: Number | None = key("Expert's reward in violated states; default -3.")

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
class TodirlTable(hparams_table("todirl", "mu", "tolerance", "method", base=OptimizerTable)):  # type: ignore[misc]
    """``[learner]``: hyperparameters; see ``jaxltl.algos.todirl.Hparams`` for other defaults."""

    method: Literal["todirl"] = key("Learning algorithm.")
    discount: Unit = key("Discount of the learned reward; 1 needs a horizon.", "0.95")
    memory: Text | None = key("Formula of the memory; default the task's.", '"F o1"')
    radius: WholeNumber = key("Cells that are observed around the own one.", default=1)
    hidden: Widths = key("Widths of the reward network's hidden layers.", factory=lambda: [80, 80])
    steps: Count = key("Largest number of steps of the optimizer.", default=300)
    patience: Count | None = key(
        "Steps without a better held-out likelihood after which learning ends."
    )
    held_out: Discount = key("Share of the demonstrations that is held out.", "0.1", default=0.2)
    optimizer: Optimizer | None = key("Optimizer of the likelihood.")

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
class TestScenesTable(TomlTable):
    """``[test]``: worlds for the evaluation, which have no part in learning."""

    maps: Maps | None = key("Test worlds; default none.")
    generate: Count | None = key("Number of random test worlds; default none.")
    obstacles: WholeNumber | None = key("Random obstacles; default as in training.")
    min_distance: Count | None = key("Least distance of random objects; default 3.", "4")
    shape: Shape | None = key("Rows and columns of a random world; default as in training.")
    seed: WholeNumber | None = key("First seed of the random worlds; default 0.")
    leave_out: Names = key("Names of test worlds that do not count in means.", factory=list)

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
    world: ScenesTable = key("The training worlds.")
    demonstrations: ExpertTable = key("What was demonstrated.")
    learner: TodirlTable = key("The learner and its hyperparameters.")
    test: TestScenesTable | None = key("The test worlds.")

    def __attrs_post_init__(self) -> None:
        require_one_each("[demonstrations] files", self.demonstrations.files, self.world.maps)
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


def require_one_each(name: str, files: Sequence[str] | None, maps: Sequence[object]) -> None:
    """Raises ValueError unless there is a file for each map, or none."""
    if files and len(files) != len(maps):
        text = f"{name} has {len(files)} files for {len(maps)} maps; give one for each, in order."
        raise ValueError(text)


def read_entry(path: Path, entry: str | dict[str, str]) -> str:
    """The text of a map of ``maps`` in a task file."""
    name = map_file(entry)
    return read_map(path, entry if name is None else {"file": name})


# --- grounding ------------------------------------------------------------------------------------


ObservationTables = Annotated[
    Literal["cells"] | list[str],
    Meta('"cells", or a list of tables, one per map, such as ["seen.csv"]', bool),
]
Meanings = Annotated[
    dict[str, str], Meta('a table of symbols and propositions, such as { goal = "a" }', bool)
]


@table
class MapsTable(GridTable):
    """``[world]``: maps; what their legend states is observed and has no other meaning."""

    maps: Maps = key("Maps with demonstrations.")


@table
class GroundingTable(TomlTable):
    """``[grounding]``: observations, and how their meaning is learned."""

    observations: ObservationTables = key(
        "Observations: the propositions of the legend, or tables (CSV) of [world] maps and then of "
        "[test] maps, with a line of names and a line of numbers for each cell."
    )
    clusters: Count | None = key(
        "Number of clusters of noisy observations; default none, all are 0 or 1.", "6"
    )
    level: Confidence = key("Posterior weight of the credible set of groundings.", default=0.95)


@table
class DemonstratorTable(SyntheticTable):
    """``[demonstrations]``: files, or simulated ones by a soft optimal policy."""

    discount: Discount = key("Discount of the demonstrator.", default=0.95)
    files: Files | None = key("Files of demonstrations, one per map; default none.")
    meaning: Meanings | None = key("Hidden meanings, for simulations; default none.")
    scale: NonNegative = key("Reward of an event, for simulations.", default=40.0)

    def __attrs_post_init__(self) -> None:
        self.require_one(("files", "synthetic"), "files = [...] or synthetic = N")
        self.require_one(("files", "meaning"), "files = [...] or meaning = {...}, with synthetic")


@table
class TestMapsTable(TomlTable):
    """``[test]``: further maps in which policies are certified."""

    maps: Maps = key("Maps without demonstrations.")


@table
class GroundingFile(FormulaFile):
    """A task file with a table ``[grounding]``."""

    learner: LearnerTable = LearnerTable(method="grounding", steps=1)  # no table of the file
    world: MapsTable = key("The worlds with demonstrations.")
    task: FormulaTable = key("The formula over symbols.")
    grounding: GroundingTable = key("Observations, and how their meaning is learned.")
    demonstrations: DemonstratorTable = key("What was demonstrated.")
    test: TestMapsTable | None = key("Further worlds.")

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
        require_one_each("[grounding] observations", self.tables, self.maps)
        require_one_each("[demonstrations] files", self.demonstrations.files, self.world.maps)

    def named_files(self) -> Sequence[str]:
        named = [*filter(None, map(map_file, self.maps)), *self.tables]
        return named + (self.demonstrations.files or [])
