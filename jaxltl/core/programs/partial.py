"""Model checking of programs: by the whole model, or by partial exploration with certified bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.language.expressions import LanguageError, compile_expressions
from jaxltl.core.language.syntax import Program
from jaxltl.core.logic.bounded import Bounded, Conditional, Earned, Recognized
from jaxltl.core.logic.comparisons import Comparison, program_definitions
from jaxltl.core.logic.labels import is_boolean, require_known, satisfying
from jaxltl.core.logic.ltl import FALSE, TRUE, Formula
from jaxltl.core.logic.properties import Property, parse_property
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.programs.build import MAX_STATES, as_chain, build_model, with_loops
from jaxltl.core.programs.explore import BreadthFirstSearch
from jaxltl.core.programs.packed_states import StateReader, initial_columns, make_layout
from jaxltl.core.programs.symmetry import find_orbits
from jaxltl.core.programs.local_choices import Numbers
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.engine.host_solution import complement_event
from jaxltl.core.values.interval.sides import requested_width
from jaxltl.core.values.properties.answers import Answer
from jaxltl.core.values.properties.solve_property import TOLERANCE, as_answer, solve_property

Method = Literal["build", "partial"]
Report = Callable[[int, int, Answer], None]  # of the numbers of states found and expanded

_FIRST = 1000  # states before the first solve
_SMALL = 1000  # states of a model whose thresholds are decided in rational arithmetic
_GROWTH = {"dtmc": 2.0, "mdp": 1.3}  # of their number between two solves
_LIKELY_SHARE = 0.1  # states with this share of the largest weight are expanded together
_SHARE = 50  # of an mdp at least 1 / _SHARE of the known states are, so that batches are large
# A chain's states are expanded from a reach probability on, which falls by a factor when less than
# this share of states is new.
_FALL, _MORE = 3.0, 1.5
_WORK = 30  # entries visited for the weights, as a multiple of the transitions
_STEP = 100  # entries that take as long as the rest of a step
_FINE = 0.1  # share of the tolerance for the errors of the solver
_REST = 1e-9  # share of the weight of states that the guiding policy does not reach


def solve_program(
    program: Program,
    prop: Property | str,
    *,
    method: Method = "build",
    tolerance: float = TOLERANCE,
    max_states: int = MAX_STATES,
    report: Report | None = None,
) -> Answer:
    """The value of a property in the initial states of a program, with certified bounds.

    ``"build"`` builds the model and solves it as
    :func:`~jaxltl.core.values.properties.solve_property.solve_property`. ``"partial"`` explores some
    of its states, for probabilities of ``F``, ``G``, ``U``, ``W`` and ``R`` over state formulas, also
    within a number of steps (Brazdil et al. 2014, "Verification of Markov decision processes using
    learning algorithms"; Ashok et al. 2019). States that are not expanded count as 0 for the
    lower bound and as 1 for the upper bound, and both models are solved exactly as others are, with
    their end components, so that the bounds are certified. The states that a policy which is
    optimal for the bound on the optimistic side reaches most likely are expanded next. States that
    differ by exchanges of equal modules or variables count as one state.

    Args:
      program: of ``jl.io.read_program``. Of an mdp or a dtmc without intervals for ``"partial"``.
      prop: a property or its text, which may use the names of the program.
      method: ``"build"`` or ``"partial"``.
      tolerance: width of the bounds.
      max_states: the number of states after which an exploration ends with its bounds.
      report: is called after each solve of ``"partial"``.

    Returns:
      :class:`~jaxltl.core.values.properties.answers.Answer`, whose `method` has the numbers of
      states. If `max_states` is too small, its status is MAX_STEPS and its bounds are certified.

    Raises:
      ValueError: too many states for ``"build"``, another kind of program or of property for
        ``"partial"``, or an error of the program in an explored state.

    Example:
      >>> from jaxltl.core.language.resolve import read_program
      >>> program = read_program('''dtmc module m x : [0..1000000] init 1;
      ...     [] x>0 -> 0.1 : (x'=min(x+1, 1000000)) + 0.9 : (x'=x-1); [] x=0 -> true; endmodule''')
      >>> found = solve_program(program, "P=? [ F x=30 ]", method="partial")
      >>> bool(found.lower[0] <= (9 - 1) / (9**30 - 1) <= found.upper[0]), found.status.name
      (True, 'CONVERGED')
    """
    if isinstance(prop, str):
        prop = parse_property(prop, program_definitions(program))
    if method == "build":
        model = build_model(program, max_states=max_states)
        return cast(Answer, solve_property(model, prop, tolerance=tolerance))
    validation.choice("method", method, ("build", "partial"))
    tolerance = requested_width(tolerance)
    max_states = validation.integer("max_states", max_states, least=1, limit=2**31 - 2)
    if program.kind in ("pomdp", "smg") or program.has_intervals or program.parameters:
        raise ValueError(
            f"{program.source.name!r}: games, pomdps and programs with intervals or parameters are not "
            "explored in part; build the model."
        )
    try:
        part = _ExpandedPart(program, _event(program, prop), prop, max_states)
        answer = _narrowed(part, prop, tolerance, report)
        if prop.relation is not None and not part.frontier.any() and part.num_states <= _SMALL:
            # All states are known: thresholds that are met with equality need fractions.
            whole = solve_program(program, prop, tolerance=tolerance, max_states=max_states)
            return whole._replace(method=f"{answer.method}; {whole.method}")
        return answer
    except LanguageError as error:
        raise program.source.located(error) from None


class _Event(NamedTuple):
    """The event ``stay U goal``, or its complement, within some steps, and the optimum."""

    stay: Formula
    goal: Formula
    complement: bool
    steps: int | None
    objective: Literal["max", "min"]


def _narrowed(
    part: _ExpandedPart, prop: Property, tolerance: float, report: Report | None
) -> Answer:
    """Expands states until the bounds are within the tolerance or decide the threshold."""
    lower, upper = np.zeros(part.num_initial), np.ones(part.num_initial)
    size = _FIRST
    while True:
        part.expand_to(size)
        low, high = part.solve(tolerance * _FINE)
        lower, upper = np.maximum(lower, low), np.minimum(upper, high)
        answer = _answer(part, prop, lower, upper, tolerance)
        if report is not None:
            report(part.num_states, part.num_expanded, answer)
        if answer.status == Status.CONVERGED or not part.frontier.any() or part.room <= 0:
            return answer
        size = max(_FIRST, int(_GROWTH[part.program.kind] * part.num_expanded) + 1)


def _answer(
    part: _ExpandedPart, prop: Property, lower: Floats, upper: Floats, tolerance: float
) -> Answer:
    narrow = bool((upper - lower <= tolerance).all())
    status = Status.MAX_STEPS if part.frontier.any() else Status.PRECISION
    arrays: dict[str, Any] = {
        "value": (lower + upper) / 2,
        "policy": np.zeros(0, np.int32),
        "lower": lower,
        "upper": upper,
        "residual": np.float64(0),
        "num_steps": np.int32(part.num_expanded),
        "status": np.int32(Status.CONVERGED if narrow else status),
    }
    solution = Solution(**arrays)
    if part.event.complement:
        solution = complement_event(solution)
    method = f"partial exploration of {part.num_states} states, {part.num_expanded} expanded"
    answer = as_answer(prop, np.arange(lower.size), solution, tolerance, method)
    return answer if answer.status == Status.CONVERGED else answer._replace(status=status)


def _event(program: Program, prop: Property) -> _Event:
    """The event of a property; ValueError for properties of another kind."""
    path, steps = prop.path, None
    if (
        prop.operator != "P"
        or prop.aggregate is not None
        or isinstance(path, Earned | Conditional | Recognized)
    ):
        raise _unsupported(prop)
    if prop.direction is None and program.kind == "mdp":
        raise ValueError(f"{prop.text}: ask for Pmax=? or Pmin=? of an mdp.")
    if isinstance(path, Bounded):
        if path.reward is not None or path.lower or path.upper is None:
            raise _unsupported(prop)
        steps, left, right = path.upper, path.left, path.right
    else:
        if path.operator not in tuple("FGUWR") or not all(map(is_boolean, path.operands)):
            raise _unsupported(prop)
        left, right = path.operands[0], path.operands[-1]
    objective = prop.direction or "max"
    stay, goal = {
        "F": (TRUE, right),
        "U": (left, right),
        "G": (TRUE, ~right),
        "W": (~right, ~left & ~right),
        "R": (TRUE if left == FALSE else ~left, ~right),
    }[path.operator]
    if path.operator in ("F", "U"):
        return _Event(stay, goal, False, steps, objective)
    return _Event(stay, goal, True, steps, "min" if objective == "max" else "max")


def _unsupported(prop: Property) -> ValueError:
    return ValueError(
        f"{prop.text}: partial exploration is for probabilities of F, G, U, W and R over state "
        "formulas, also within steps (F<=k); build the model for others."
    )


# --- the explored part ----------------------------------------------------------------------------


class _StateConditions:
    """State formulas on states that need not be expanded."""

    def __init__(self, program: Program, formulas: Sequence[Formula], prop: Property) -> None:
        self.formulas, self.text = formulas, prop.text
        self.names = tuple(dict.fromkeys(name for f in formulas for name in f.propositions))
        self.variables = tuple(v.name for v in program.variables)
        self.comparisons: dict[str, Comparison] = {}
        for name, definition in prop.definitions:
            if isinstance(definition, Property):
                raise _unsupported(prop)
            self.comparisons[name] = definition
        labels = [n for n in self.names if n not in self.comparisons and n != "init"]
        if "deadlock" in labels and "deadlock" not in program.labels:
            raise ValueError(
                f'{prop.text}: whether "deadlock" holds is known of expanded states alone; build '
                "the model."
            )
        require_known(labels, (*program.labels, "init"), prop.text)
        self.labels = {n: compile_expressions([program.labels[n]]) for n in labels}
        self.expressions = [program.labels[n] for n in labels]
        self.expressions += [c.expression for c in self.comparisons.values()]

    def holds(self, read: StateReader, size: int, initial: bool) -> list[Booleans]:
        """The truth ``bool[N]`` of each formula in N states."""
        columns = np.full((size, len(self.names)), initial)
        for i, name in enumerate(self.names):
            if name in self.comparisons:
                columns[:, i] = self.comparisons[name].holds({v: read(v) for v in self.variables})
            elif name in self.labels:
                columns[:, i] = self.labels[name](read)[0]
        return [satisfying(columns, self.names, f, self.text) for f in self.formulas]


class _ExpandedPart:
    """The known states of a program, in the order in which they are found, and their choices.

    States where the event is decided need no expansion; the frontier has the others that are not
    expanded.
    """

    def __init__(self, program: Program, event: _Event, prop: Property, max_states: int) -> None:
        self.program, self.event, self.max_states = program, event, max_states
        self.conditions = _StateConditions(program, (event.stay, event.goal), prop)
        self.layout = make_layout(program.variables)
        self.search = BreadthFirstSearch(program, self.layout, Numbers(), 2**31 - 2)
        if "init" not in self.conditions.names:
            self.search.orbits = find_orbits(program, self.conditions.expressions)
        initial = self.layout.packed(*initial_columns(program, max_states))
        self.num_initial = initial[0].size
        self.search.known.fill(initial)
        self.order: list[Integers] = []  # expanded states
        self.num_expanded = self.size = 0
        self.truths = np.zeros((3, 0), bool)  # stay, goal and expanded, with room for more states
        self.weights = np.zeros(0)
        self.least = 1.0  # reach probability of a chain's states that are expanded
        self.before = 0  # states that were expanded before the last search
        self.widest = 1.0  # new states of an expanded one
        self._add(1.0)
        self._expand(np.arange(self.num_initial))

    @property
    def weight(self) -> Floats:
        """Estimates of reach probabilities, of the frontier."""
        return self.weights[: self.size]

    @property
    def num_states(self) -> int:
        return len(self.search.known)

    @property
    def frontier(self) -> Booleans:
        """States that are not expanded and do not decide the event."""
        stay, goal, expanded = self.truths[:, : self.size]
        frontier: Booleans = stay & ~goal & ~expanded
        return frontier

    @property
    def room(self) -> int:
        """The number of states that may be expanded before there are too many."""
        return int((self.max_states - self.num_states) / self.widest)

    def expand_to(self, size: int) -> None:
        """Expands the frontier states with the largest weights until `size` states are expanded."""
        states = np.flatnonzero(self.frontier)
        if self.program.kind == "dtmc":
            # From a fixed weight on, so that the probability of all paths to a state is known
            # before it is expanded where these have the same length.
            top = float(self.weight[states].max(initial=0.0))
            if self.num_expanded < _MORE * self.before:
                self.least = min(top, self.least) / _FALL
            states = states[self.weight[states] >= self.least]
        self.before = self.num_expanded
        while states.size and self.num_expanded < size and self.room > 0:
            count = min(states.size, self.room, size - self.num_expanded)
            if self.program.kind == "mdp":
                weight = self.weight[states]
                likely = int(np.count_nonzero(weight >= _LIKELY_SHARE * weight.max()))
                count = min(max(likely, self.num_expanded // _SHARE), count)
            if count < states.size:
                order = np.argpartition(-self.weight[states], count - 1)
                states = np.sort(states[order[:count]])
            reached = self._expand(states)
            if self.program.kind == "mdp":
                states = np.flatnonzero(self.frontier)
            else:
                stay, goal, expanded = self.truths[:, reached]
                inner = stay & ~goal & ~expanded & (self.weight[reached] >= self.least)
                states = np.unique(reached[inner])

    def _add(self, weight: float) -> None:
        """Truths of the state formulas in the states that were found last."""
        before, size = self.size, self.num_states
        if size > self.truths.shape[1]:
            self.truths = np.pad(self.truths, ((0, 0), (0, 2 * size - self.truths.shape[1])))
            self.weights = np.pad(self.weights, (0, 2 * size - self.weights.size))
        words = self.search.known.words(before, size)
        truths = self.conditions.holds(StateReader(self.layout, words), size - before, before == 0)
        self.truths[:2, before:size] = truths
        self.weights[before:size] = weight
        self.size = size

    def _expand(self, states: Integers) -> Integers:
        """Adds the successors of some states, and returns them."""
        before, output = self.size, self.search.output
        begin = {name: len(parts) for name, parts in output.items()}
        self.search.expand(tuple(k[states] for k in self.search.known.keys))
        rows, entries, successor, probability = (
            np.concatenate([output[name][0], *output[name][begin[name] :]])
            for name in ("row_count", "entry_count", "successor", "weight")
        )
        self.order.append(states)
        self.num_expanded += states.size
        self.truths[2, states] = True
        self.widest = max(self.widest, (self.num_states - before) / states.size)
        self._add(0.0)
        # Reach probabilities of a chain; of an mdp those of the most likely paths.
        mass = self.weight[states].repeat(rows).repeat(entries) * probability
        merge = np.add if self.program.kind == "dtmc" else np.maximum
        merge.at(self.weight, successor, mass)
        return successor

    def guide(self, row: Integers, gap: Floats) -> None:
        """Sets the weights of the frontier to its reach probabilities under a policy.

        States whose bounds agree up to `_REST` are not passed.
        """
        host, frontier = self.model.host, self.frontier[self.states]
        first, last = host.entry_start[row], host.entry_start[row + 1]
        stay, goal, expanded = self.truths[:, self.states]
        passed = stay & ~goal & expanded & (gap > _REST)
        state = np.arange(self.num_initial)
        mass, reached = np.full(state.size, 1 / state.size), np.zeros(host.num_states)
        work, steps = _WORK * host.num_transitions, self.event.steps
        while state.size and work > 0 and steps != 0:
            inner = passed[state] & (mass > _REST * _REST)
            state, mass = state[inner], mass[inner]
            count = last[state] - first[state]
            entry = concatenated_ranges(first[state], count)
            state, number = np.unique(host.successor[entry], return_inverse=True)
            mass = np.bincount(number, mass.repeat(count) * host.probability[entry], state.size)
            reached[state] += mass
            work -= entry.size + _STEP
            steps = None if steps is None else steps - 1
        weight = reached + _REST * self.weight[self.states]
        self.weight[self.states] = np.where(frontier, weight, 0)

    def build(self) -> None:
        """Makes the model of the explored part: `model`, whose states are those of `states`."""
        explored, size = self.search.explored(self.num_initial), self.size
        done = np.concatenate(self.order)
        self.states = np.concatenate([done, np.flatnonzero(~self.truths[2, :size])])
        place = np.empty(size, np.int32)
        place[self.states] = np.arange(size, dtype=np.int32)
        rows = np.append(explored.row_count, np.zeros(size - done.size, np.int32))
        explored = replace(explored, row_count=rows, successor=place[explored.successor])
        explored = with_loops(explored)
        if self.program.kind == "dtmc" and explored.action.size > size:
            explored = as_chain(explored, Numbers())
        truths = (*self.truths[:2, :size], self.frontier)
        self.model = make_sparse(
            offsets_from_counts(explored.row_count),
            offsets_from_counts(explored.entry_count),
            explored.successor,
            explored.weight,
            initial=explored.initial,
            label=np.stack([x[self.states] for x in truths], 1),
            propositions=("stay", "goal", "frontier"),
        )

    def solve(self, tolerance: float) -> tuple[Floats, Floats]:
        """Bounds in the initial states, and new weights of the frontier."""
        self.build()
        stay, goal, frontier = (Formula("ap", proposition=x) for x in self.model.propositions)
        objective, steps = self.event.objective, self.event.steps
        states = np.arange(self.model.num_states)

        def solved(left: Formula, right: Formula) -> Answer:
            path = (
                Formula("U", (left, right))
                if steps is None
                else Bounded("U", left, right, 0, steps)
            )
            prop = Property("partial exploration", "P", objective, path=path)
            answer = solve_property(self.model, prop, states=states, tolerance=tolerance)
            return cast(Answer, answer)

        lower, upper = solved(stay & ~frontier, goal), solved(stay, goal | frontier)
        row = states
        if not self.model.is_chain:
            guiding = upper if objective == "max" else lower
            assert guiding.strategy is not None
            row = guiding.strategy.row
        self.guide(row, upper.upper - lower.lower)
        return lower.lower[: self.num_initial], upper.upper[: self.num_initial]
