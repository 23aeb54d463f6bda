"""Programs in the PRISM language as frozen trees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from jaxltl.core.language.expressions import Expression, Source, Type, Value, names_in

Kind = Literal["dtmc", "mdp", "pomdp", "smg"]


@dataclass(frozen=True)
class Constant:
    """A constant; without an expression its value is given from outside."""

    name: str
    type: Type
    expression: Expression | None
    place: int


@dataclass(frozen=True)
class Declaration:
    """A variable as it is declared: a range of integers, or without ends a Boolean."""

    name: str
    low: Expression | None
    high: Expression | None
    initial: Expression | None
    place: int


@dataclass(frozen=True)
class Assignment:
    """An assignment ``(variable' = expression)``; expressions read the old values."""

    variable: str
    expression: Expression
    place: int


@dataclass(frozen=True)
class Outcome:
    """An update with its probability, or with an interval of probabilities."""

    probability: Expression  # of an interval the lower end
    upper: Expression | None  # the upper end of an interval, else None
    assignments: tuple[Assignment, ...]


@dataclass(frozen=True)
class Command:
    """A guarded command ``[action] guard -> p_1 : update_1 + ...``; no action is ``""``."""

    action: str
    guard: Expression
    outcomes: tuple[Outcome, ...]
    place: int

    @property
    def expressions(self) -> list[Expression]:
        """The guard, the probabilities and the right sides of assignments."""
        ends = [e for o in self.outcomes for e in (o.probability, o.upper) if e is not None]
        return [self.guard, *ends, *(a.expression for o in self.outcomes for a in o.assignments)]

    @property
    def assigned(self) -> set[str]:
        """The variables that some update assigns."""
        return {a.variable for o in self.outcomes for a in o.assignments}


@dataclass(frozen=True)
class Module:
    """A module with its declarations and commands."""

    name: str
    declarations: tuple[Declaration, ...]
    commands: tuple[Command, ...]
    place: int

    @property
    def names(self) -> set[str]:
        """The variables and parameters that the commands read or assign."""
        read = (names_in(e) for c in self.commands for e in c.expressions)
        return set[str]().union(*read, *(c.assigned for c in self.commands))


@dataclass(frozen=True)
class RenamedModule:
    """A module as a copy of another one, ``module name = base [old = new, ...] endmodule``."""

    name: str
    base: str
    renaming: tuple[tuple[str, str], ...]
    place: int


@dataclass(frozen=True)
class RewardItem:
    """A reward ``guard : value`` of states, or ``[action] guard : value`` of choices."""

    action: str | None  # None of states, "" of choices without an action
    guard: Expression
    value: Expression


@dataclass(frozen=True)
class RewardStructure:
    """A reward structure, the sum of its items."""

    name: str
    items: tuple[RewardItem, ...]
    place: int


@dataclass(frozen=True)
class Player:
    """A player of a turn-based game: modules, whose unlabelled commands it controls, and actions."""

    name: str
    modules: tuple[str, ...]
    actions: tuple[str, ...]
    place: int


@dataclass(frozen=True)
class Composition:
    """A composition of modules in a ``system`` block: a module, or an operator on parts."""

    operator: str  # the name of a module, or "||", "|||", "|[]|", "/", "<-"
    place: int
    actions: tuple[tuple[str, str], ...] = ()  # and what they become, "" where they are hidden
    parts: tuple[Composition, ...] = ()


@dataclass
class Syntax:
    """A program as it is written; :func:`~jaxltl.core.language.parser.parse_program`."""

    source: Source
    kind: Kind = "mdp"  # PRISM's default
    constants: list[Constant] = field(default_factory=list)
    formulas: list[tuple[str, Expression]] = field(default_factory=list)
    variables: list[Declaration] = field(default_factory=list)  # global ones
    modules: list[Module | RenamedModule] = field(default_factory=list)
    labels: list[tuple[str, Expression]] = field(default_factory=list)
    rewards: list[RewardStructure] = field(default_factory=list)
    initial: Expression | None = None
    system: Composition | None = None  # None: all modules, synchronised over common actions
    players: list[Player] = field(default_factory=list)
    observables: list[tuple[str, Expression]] = field(default_factory=list)


# --- after resolution -------------------------------------------------------------------------


@dataclass(frozen=True)
class Variable:
    """A bounded variable of a resolved program."""

    name: str  # its name
    type: Type  # "int" or "bool"
    low: int  # the range, 0 and 1 of a Boolean
    high: int
    initial: int  # the initial value, which an init block overrides
    module: int | None  # the number of its module; None for a global variable
    place: int  # offset in the source

    @property
    def bits(self) -> int:
        """The number of bits of ``value - low``."""
        return (self.high - self.low).bit_length()


@dataclass(frozen=True)
class Program:
    """A program with constants folded, formulas substituted and modules renamed.

    All expressions are over the variables and, in probabilities and values of rewards, over the
    `parameters`. They are type-checked: guards, labels, and guards of rewards are Boolean.

    Attributes:
      source: the text, for errors: ``source.located(LanguageError(place, message))``.
      kind: ``"dtmc"``, ``"mdp"``, ``"pomdp"`` or ``"smg"``.
      constants: the value of each constant that has one.
      parameters: constants of type double without a value.
      formulas: the substituted expression of each formula.
      variables: global ones first, then by module; the order of a state's values.
      modules: the modules, without declarations.
      labels: the substituted expression of each label.
      rewards: the reward structures.
      initial: the condition of the ``init`` block, or None.
      players: the players of an smg.
      observables: the expression of each observable of a pomdp.
      syntax, arguments: the syntax tree, and the values that were given for its constants.

    Example:
      >>> from jaxltl.core.language.resolve import read_program
      >>> p = read_program("dtmc const int N; module m x : [0..N]; [] x<N -> (x'=x+1); endmodule",
      ...                  {"N": 3})
      >>> p.variables[0].high, str(p.modules[0].commands[0].guard)
      (3, '(x < 3)')
    """

    source: Source
    kind: Kind
    constants: dict[str, Value]
    parameters: tuple[str, ...]
    formulas: dict[str, Expression]
    variables: tuple[Variable, ...]
    modules: tuple[Module, ...]
    labels: dict[str, Expression]
    rewards: tuple[RewardStructure, ...]
    initial: Expression | None
    players: tuple[Player, ...]
    observables: dict[str, Expression] = field(default_factory=dict)
    syntax: Syntax | None = field(default=None, compare=False, repr=False)
    arguments: Mapping[str, object] = field(default_factory=dict, compare=False, repr=False)

    @property
    def types(self) -> dict[str, Type]:
        """The type of each variable and parameter."""
        return {
            **{v.name: v.type for v in self.variables},
            **dict.fromkeys(self.parameters, "double"),
        }

    @property
    def has_intervals(self) -> bool:
        """True if some probability is an interval."""
        return any(
            o.upper is not None for m in self.modules for c in m.commands for o in c.outcomes
        )
