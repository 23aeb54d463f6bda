"""Recursive-descent parser of the PRISM language."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from jaxltl.core.language.composition import read_composition
from jaxltl.core.language.expressions import (
    FUNCTIONS,
    RELATIONS,
    TRUE,
    Expression,
    LanguageError,
    Source,
    Type,
    literal,
)
from jaxltl.core.language.tokens import TokenReader
from jaxltl.core.language.syntax import (
    Assignment,
    Command,
    Constant,
    Declaration,
    Kind,
    Module,
    Outcome,
    Player,
    RenamedModule,
    RewardItem,
    RewardStructure,
    Syntax,
)

_MAX_NESTING = 60  # of parentheses and prefixes, at most 10 frames of Python each
_KINDS: dict[str, Kind] = {
    **dict.fromkeys(("dtmc", "probabilistic"), "dtmc"),
    **dict.fromkeys(("mdp", "nondeterministic"), "mdp"),
    "pomdp": "pomdp",
    **dict.fromkeys(("smg", "stpg"), "smg"),
}
_REFUSED = {
    **dict.fromkeys(("ctmc", "stochastic"), "continuous-time Markov chains"),
    "ma": "Markov automata",
    "pta": "probabilistic timed automata",
    "popta": "partially observable timed automata",
    "csg": "concurrent games",
    **dict.fromkeys(("tptg", "tsg"), "timed games"),
    "invariant": "invariants of timed automata",
}
_RESERVED = frozenset(_KINDS) | {
    *("bool", "clock", "const", "double", "endinit", "endinvariant", "endmodule", "endrewards"),
    *("endplayer", "endsystem", "false", "formula", "global", "init", "int", "label", "max", "min"),
    *("module", "player", "prob", "rate", "rewards", "true", "ctmc", "stochastic", "func"),
    *("pta", "popta", "csg", "invariant", "observables", "endobservables", "observable", "system"),
}
# Binary operators by precedence, the tightest last; operators of one level associate to the left.
_LEVELS = {
    **dict.fromkeys(("=", "!="), 6),
    **dict.fromkeys(RELATIONS, 7),
    **dict.fromkeys("+-", 8),
    **dict.fromkeys("*/%", 9),
}
_LEVELS |= {"=>": 1, "<=>": 2, "|": 3, "&": 4, "^": 10}
_NOT = 5
SIMPLE = 6  # the level of comparisons, in which no Boolean operator stands outside of parentheses
ADDITIVE = 8  # the level of + and -
_FLAT = ("&", "|", "+", "*")


class ExpressionParser(TokenReader):
    """Expressions, by precedence climbing."""

    sign_level = 11  # of the operand of a minus sign

    def __init__(self, text: str, start: int = 0) -> None:
        super().__init__(text, start)
        self.nesting = 0

    def expression(self, level: int = 0) -> Expression:
        """An expression with operators of a level and tighter ones; level 0 has ``? :`` too."""
        self.nesting += 1
        if self.nesting > _MAX_NESTING:
            raise LanguageError(self.place, f"parentheses are nested deeper than {_MAX_NESTING}.")
        tree = self._climb(level)
        if level == 0 and self.texts[self.at] == "?":
            self.at += 1
            then = self.expression()
            self.expect(":", " of a conditional expression")
            tree = Expression("?:", (tree, then, self.expression()), place=tree.place)
        self.nesting -= 1
        return tree

    def whole(self) -> Expression:
        """The expression that is the rest of the text."""
        tree = self.expression()
        if self.kinds[self.at] != "end":
            self.fail("an operator or the end")
        return tree

    def _climb(self, level: int) -> Expression:
        left = self._prefix(level)
        while self.kinds[self.at] == "sign":
            operator = self.texts[self.at]
            precedence = _LEVELS.get(operator, -1)
            if precedence < max(level, 1):
                break
            # A chain of one operator is one node, so that long chains are not deep.
            is_chain = operator in _FLAT
            operands = list(left.operands if is_chain and left.operator == operator else [left])
            while self.accept(operator):
                operands.append(self._climb(precedence + 1))
                if not is_chain:
                    break
            name = {"^": "pow", "%": "mod"}.get(operator, operator)
            left = self._node(name, tuple(operands), left.place)
        return left

    def _node(self, operator: str, operands: tuple[Expression, ...], place: int) -> Expression:
        return Expression(operator, operands, place=place)

    def _prefix(self, level: int) -> Expression:
        place = self.place
        if self.kinds[self.at] == "sign" and self.texts[self.at] in ("!", "-"):
            self.nesting += 1
            if self.nesting > _MAX_NESTING:
                raise LanguageError(place, f"operators are nested deeper than {_MAX_NESTING}.")
            negated = self.texts[self.at] == "!"
            self.at += 1
            # After a tighter operator, as in a = !b, the negation takes one operand alone.
            operand = (
                self._climb(SIMPLE) if negated and level <= _NOT else self._climb(self.sign_level)
            )
            self.nesting -= 1
            return Expression("!" if negated else "neg", (operand,), place=place)
        return self._atom()

    def _atom(self) -> Expression:
        kind, text, place = self.kinds[self.at], self.texts[self.at], self.place
        if kind == "integer":
            self.at += 1
            if len(text) > 15:
                raise LanguageError(place, f"the integer {text[:20]}... is larger than 2^53.")
            return literal(int(text), place)
        if kind == "real":
            self.at += 1
            if len(text) > 400 or float(text) == float("inf"):
                raise LanguageError(place, "the number is too large for double precision.")
            return literal(float(text), place)
        if kind == "word":
            return self._word(text, place)
        if kind == "quoted":
            return Expression("name", value=f'"{self.quoted("a label")}"', place=place)
        if not self.accept("("):
            self.fail("an expression, such as a variable or a number")
        inner = self.expression()
        self.expect(")", " or an operator")
        return inner

    def _word(self, text: str, place: int) -> Expression:
        """A literal, a name, or the call of a function."""
        self.at += 1
        if text in ("true", "false"):
            return literal(text == "true", place)
        if self.texts[self.at] != "(" or text not in (*FUNCTIONS, "func"):
            if text in _RESERVED:
                self.at -= 1
                self.fail("an expression")
            return Expression("name", value=text, place=place)
        self.at += 1
        if text == "func":
            text = self.word("the name of a function")
            self.expect(",", " after the name of a function")
        if text not in FUNCTIONS:
            raise LanguageError(place, f"{text} is no function; there are {', '.join(FUNCTIONS)}.")
        operands = self.separated(self.expression)
        self.expect(")", " or ','")
        least, limit = FUNCTIONS[text]
        if not least <= len(operands) <= limit:
            raise LanguageError(
                place, f"{text} takes {limit} argument{'s' * (limit != 1)}, not {len(operands)}."
            )
        return Expression(text, tuple(operands), place=place)


def parse_expression(text: str) -> Expression:
    """The expression of a text; ValueError with line and column.

    >>> str(parse_expression("!x = 1 | a => b"))
    '((!(x = 1) | a) => b)'
    """
    try:
        return ExpressionParser(text).whole()
    except LanguageError as error:
        raise Source(text, "expression").located(error) from None


def parse_program(text: str, name: str = "model") -> Syntax:
    """The syntax tree of a program in the PRISM language.

    Raises ValueError with file, line and column: a syntax error, or a feature that is not supported
    (continuous time, clocks, concurrent games, unbounded integers).

    >>> parse_program("mdp module m x : [0..1]; [a] x=0 -> (x'=1); endmodule").kind
    'mdp'
    """
    source = Source(text, name)
    try:
        return _ProgramParser(source).program()
    except LanguageError as error:
        raise source.located(error) from None


class _ProgramParser(ExpressionParser):
    """Items of a program; each method reads the construct of its name."""

    def __init__(self, source: Source) -> None:
        super().__init__(source.text)
        self.syntax = Syntax(source)
        self.has_type = False

    def program(self) -> Syntax:
        readers = {
            **dict.fromkeys(("const", "rate", "prob"), self.constant),
            **dict.fromkeys(_KINDS, self.model_type),
            "formula": self.formula,
            "label": self.label,
            "global": self.global_variable,
            "module": self.module,
            "rewards": self.reward_structure,
            "init": self.initial_block,
            "system": self.system_block,
            "player": self.player,
            "observables": self.observable_variables,
            "observable": self.observable,
        }
        while self.kinds[self.at] != "end":
            self.refuse(*_REFUSED)
            text = self.texts[self.at]
            if text not in readers:
                self.fail(
                    "the type of the model (dtmc, mdp, pomdp, smg), const, formula, label, global, "
                    "module, rewards, init, player, observables or observable"
                )
            if text not in ("rate", "prob"):
                self.at += 1
            readers[text]()
        if not self.syntax.modules:
            raise LanguageError(self.place, "the model has no module; it needs at least one.")
        return self.syntax

    def refuse(self, *words: str) -> None:
        """Raises LanguageError if the next word is one of some features that are not supported."""
        text = self.texts[self.at]
        if text in words:
            raise LanguageError(self.place, f"{text}: {_REFUSED[text]} are not supported.")

    def model_type(self) -> None:
        if self.has_type:
            raise LanguageError(self.starts[self.at - 1], "the type of the model is given twice.")
        self.syntax.kind, self.has_type = _KINDS[self.texts[self.at - 1]], True

    def name(self, expected: str) -> tuple[str, int]:
        """A name that is no keyword, and its place."""
        place = self.place
        name = self.word(expected)
        if name in _RESERVED:
            self.at -= 1
            self.fail(f"{expected}; {name} is a keyword")
        return name, place

    def action(self) -> str:
        """The action after an opening bracket, "" for none."""
        action = "" if self.texts[self.at] == "]" else self.name("the name of an action")[0]
        self.expect("]", " after the action")
        return action

    def constant(self) -> None:
        type_: Type = "int"
        if self.accept("rate") or self.accept("prob"):  # also without const
            type_ = "double"
            self.accept("double")
        elif self.texts[self.at] in ("int", "double", "bool"):
            type_ = cast(Type, self.texts[self.at])
            self.at += 1
        name, place = self.name("the name of a constant")
        expression = self.expression() if self.accept("=") else None
        self.expect(";", " at the end of a constant")
        self.syntax.constants.append(Constant(name, type_, expression, place))

    def defined(self, kind: str) -> Expression:
        """The expression of a formula or a label."""
        self.expect("=")
        definition = self.expression()
        self.expect(";", f" at the end of a {kind}")
        return definition

    def formula(self) -> None:
        name, _ = self.name("the name of a formula")
        self.syntax.formulas.append((name, self.defined("formula")))

    def label(self) -> None:
        place = self.place
        name = self.quoted("the name of a label in double quotes")
        if name in ("init", "deadlock") or not name:
            raise LanguageError(place, f'the label "{name}" is built in; choose another name.')
        self.syntax.labels.append((name, self.defined("label")))

    def observable_variables(self) -> None:
        def named() -> tuple[str, Expression]:
            name, place = self.name("the name of a variable")
            return name, Expression("name", value=name, place=place)

        if not self.accept("endobservables"):
            self.syntax.observables += self.separated(named)
            self.expect("endobservables", " or ','")

    def observable(self) -> None:
        name = self.quoted("the name of an observable in double quotes")
        self.syntax.observables.append((name, self.defined("observable")))

    def global_variable(self) -> None:
        self.syntax.variables.append(self.declaration())

    def declaration(self) -> Declaration:
        name, place = self.name("the name of a variable")
        self.expect(":", " and the range of a variable")
        low = high = None
        kind = self.place
        if self.accept("["):
            low = self.expression()
            self.expect("..", " between the ends of a range")
            high = self.expression()
            self.expect("]")
        elif self.accept("int"):
            raise LanguageError(
                kind,
                f"the integer {name} is unbounded, which is not supported; give a range [0..9].",
            )
        elif self.accept("clock"):
            raise LanguageError(kind, f"{name} is a clock: timed automata are not supported.")
        elif not self.accept("bool"):
            self.fail("a range, such as [0..3], or bool")
        initial = self.expression() if self.accept("init") else None
        self.expect(";", " at the end of a variable")
        return Declaration(name, low, high, initial, place)

    def module(self) -> None:
        name, place = self.name("the name of a module")
        if self.accept("="):
            base, _ = self.name("the name of the module to copy")
            copy = RenamedModule(name, base, self.renaming(), place)
            self.syntax.modules.append(copy)
            return
        declarations: list[Declaration] = []
        commands: list[Command] = []
        while not self.accept("endmodule"):
            self.refuse("invariant")
            if self.texts[self.at] == "[":
                commands.append(self.command())
            elif commands:
                self.fail("a command, which begins with '[', or endmodule")
            elif self.kinds[self.at] == "word":
                declarations.append(self.declaration())
            else:
                self.fail("a variable, a command or endmodule")
        self.syntax.modules.append(Module(name, tuple(declarations), tuple(commands), place))

    def renaming(self) -> tuple[tuple[str, str], ...]:
        renaming: dict[str, str] = {}

        def pair() -> None:
            place = self.place
            old = self.word("a name to be replaced")
            self.expect("=")
            if old in renaming:
                raise LanguageError(place, f"{old} is renamed twice.")
            is_function = old in FUNCTIONS and self.texts[self.at] in FUNCTIONS
            renaming[old] = self.word("") if is_function else self.name("a new name")[0]

        self.expect("[")
        self.separated(pair)
        self.expect("]", " or ','")
        self.expect("endmodule")
        return tuple(renaming.items())

    def command(self) -> Command:
        place = self.place
        self.at += 1
        action = self.action()
        guard = self.expression()
        self.expect("->", " after the guard")
        outcomes = self.separated(self.outcome, "+")
        self.expect(";", " or '+' after an update")
        if outcomes[0].probability is TRUE and len(outcomes) == 1:
            outcomes = [replace(outcomes[0], probability=literal(1))]
        if any(o.probability is TRUE for o in outcomes):
            raise LanguageError(place, "an update of several has no probability.")
        return Command(action, guard, tuple(outcomes), place)

    def outcome(self) -> Outcome:
        """An update; without a probability, the constant TRUE stands for it."""
        text, upper = self.texts[self.at], None
        after = self.texts[self.at + 1 : self.at + 3]
        if (text == "true" and after[:1] in ([";"], ["&"])) or (text == "(" and after[1:] == ["'"]):
            return Outcome(TRUE, None, self.update())
        is_interval = self.accept("[")
        lower = self.expression()
        if is_interval:
            self.expect(",", " between the ends of an interval of probabilities")
            upper = self.expression()
            self.expect("]")
        self.expect(":", " after a probability")
        return Outcome(lower, upper, self.update())

    def update(self) -> tuple[Assignment, ...]:
        assignments = self.separated(self.assignment, "&")
        return tuple(a for a in assignments if a is not None)

    def assignment(self) -> Assignment | None:
        if self.accept("true"):
            return None
        self.expect("(", " before an assignment, such as (x'=1), or true")
        name, place = self.name("a variable")
        self.expect("'", " after the variable that is assigned")
        self.expect("=")
        assignment = Assignment(name, self.expression(), place)
        self.expect(")", " or an operator")
        return assignment

    def reward_structure(self) -> None:
        place = self.starts[self.at - 1]
        name = self.quoted("a name") if self.kinds[self.at] == "quoted" else ""
        items: list[RewardItem] = []
        while not self.accept("endrewards"):
            action = self.action() if self.accept("[") else None
            guard = self.expression()
            if self.texts[self.at] == "->":
                raise LanguageError(self.place, "rewards of single successors are not supported.")
            self.expect(":", " between a guard and a reward")
            items.append(RewardItem(action, guard, self.expression()))
            self.expect(";", " after a reward")
        self.syntax.rewards.append(RewardStructure(name, tuple(items), place))

    def initial_block(self) -> None:
        if self.syntax.initial is not None:
            raise LanguageError(self.starts[self.at - 1], "there are two init blocks.")
        self.syntax.initial = self.expression()
        self.expect("endinit")

    def system_block(self) -> None:
        if self.syntax.system is not None:
            raise LanguageError(self.starts[self.at - 1], "there are two system blocks.")
        self.syntax.system = read_composition(self)
        self.expect("endsystem", " or an operator")

    def player(self) -> None:
        place = self.place
        quoted = self.kinds[self.at] == "quoted"
        name = self.quoted("a name") if quoted else self.name("the name of a player")[0]
        members: dict[str, list[str]] = {"module": [], "action": []}

        def controlled() -> None:
            if self.accept("["):
                members["action"].append(self.name("an action")[0])
                self.expect("]")
            else:
                members["module"].append(self.name("a module or an action in brackets")[0])

        self.separated(controlled)
        self.expect("endplayer", " or ','")
        self.syntax.players.append(
            Player(name, tuple(members["module"]), tuple(members["action"]), place)
        )
