"""Resolution of programs: formulas, renaming, constants, and types."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from fractions import Fraction
from graphlib import CycleError, TopologicalSorter
from typing import TypeVar, cast

from jaxltl.core.language.exact import (
    exact_comparisons,
    exact_constant,
    is_inexact,
    shared_exact_tree,
)
from jaxltl.core.language.expressions import (
    FUNCTIONS,
    Expression,
    LanguageError,
    MAX_INTEGER,
    Type,
    Value,
    literal,
    names_in,
    substitute,
    type_of,
    value_type,
)
from jaxltl.core.language.composition import composed
from jaxltl.core.language.parser import ExpressionParser, parse_program
from jaxltl.core.language.syntax import (
    Assignment,
    Command,
    Constant,
    Declaration,
    Module,
    Program,
    RenamedModule,
    RewardItem,
    RewardStructure,
    Syntax,
    Variable,
)

Change = Callable[[Expression], Expression]
Tree = TypeVar("Tree")
Guarded = TypeVar("Guarded", Command, RewardItem)


def read_program(
    text: str, constants: Mapping[str, object] | None = None, name: str = "model"
) -> Program:
    """Parses and resolves a program in the PRISM language.

    `constants` are numbers, Booleans or texts such as ``"1/3"``, of constants that the program does not
    define. Those of type double without a value become `parameters` if only probabilities and rewards
    depend on them. Raises ValueError with file, line and column: errors of syntax, names and types,
    unsupported features, and constants without a value.

    >>> p = read_program("dtmc const int N; module m x : [0..N]; [] true -> (x'=0); endmodule",
    ...                  {"N": "2 * 3"})
    >>> p.constants, p.variables[0].high
    ({'N': 6}, 6)
    """
    return resolve(parse_program(text, name), constants)


def resolve(syntax: Syntax, constants: Mapping[str, object] | None = None) -> Program:
    """The program of a syntax tree; arguments, result and errors as of :func:`read_program`."""
    values = {key: constant_value(key, value) for key, value in (constants or {}).items()}
    try:
        program = resolved(syntax, values)
        if _has_inexact_guards(syntax):
            program = _with_exact_guards(program, syntax, constants or {})
    except LanguageError as error:
        raise syntax.source.located(error) from None
    return replace(program, syntax=syntax, arguments=dict(constants or {}))


def resolved(
    syntax: Syntax, values: Mapping[str, Value], real: Callable[[int], float | Fraction] = float
) -> Program:
    """The program of a syntax tree, whose integers become `real` in constants of type double."""
    return _Resolver(syntax, values, real).program()


def exact_syntax(syntax: Syntax) -> Syntax:
    """The syntax tree with all literals and quotients as fractions."""
    memory: dict[int, Expression] = {}
    text = syntax.source.text

    def change(e: Expression) -> Expression:
        return shared_exact_tree(e, text, memory)

    return replace(
        syntax,
        constants=list(changed(tuple(syntax.constants), change)),
        formulas=list(changed(tuple(syntax.formulas), change)),
        variables=list(changed(tuple(syntax.variables), change)),
        modules=list(changed(tuple(syntax.modules), change)),
        labels=list(changed(tuple(syntax.labels), change)),
        rewards=list(changed(tuple(syntax.rewards), change)),
        initial=None if syntax.initial is None else change(syntax.initial),
    )


def _has_inexact_guards(syntax: Syntax) -> bool:
    """True if guards or labels have quotients or decimals, which doubles may compare wrongly."""
    tables = [(c.name, c.expression) for c in syntax.constants if c.type == "double"]
    inexact = {name for name, e in tables if e is None or is_inexact(e)}
    inexact |= {c.name for c in syntax.constants if c.expression and is_inexact(c.expression)}
    inexact |= {name for name, e in syntax.formulas if is_inexact(e)}
    modules = [m for m in syntax.modules if isinstance(m, Module)]
    conditions = [c.guard for m in modules for c in m.commands] + [e for _, e in syntax.labels]
    conditions += [e for _, e in syntax.formulas] + [e for e in [syntax.initial] if e is not None]
    conditions += [i.guard for r in syntax.rewards for i in r.items]
    return any(is_inexact(e) or names_in(e) & inexact for e in conditions)


def _with_exact_guards(
    program: Program, syntax: Syntax, constants: Mapping[str, object]
) -> Program:
    """The program with guards, labels and formulas compared in rational arithmetic, where that is possible."""
    try:
        values = {name: exact_constant(x) for name, x in constants.items()}
        exact = resolved(exact_syntax(syntax), values, real=Fraction)
    except (ValueError, ArithmeticError, TypeError):
        return program
    largest = {v.name: max(abs(v.low), abs(v.high)) for v in program.variables if v.type == "int"}

    def compared(e: Expression, rational: Expression) -> Expression:
        whole = exact_comparisons(rational, largest)
        return e if is_inexact(whole) else whole

    def guarded(parts: Sequence[Guarded], rational: Sequence[Guarded]) -> tuple[Guarded, ...]:
        both = zip(parts, rational, strict=True)
        return tuple([replace(x, guard=compared(x.guard, y.guard)) for x, y in both])

    modules = tuple(
        replace(m, commands=guarded(m.commands, n.commands))
        for m, n in zip(program.modules, exact.modules, strict=True)
    )
    rewards = tuple(
        replace(r, items=guarded(r.items, s.items))
        for r, s in zip(program.rewards, exact.rewards, strict=True)
    )
    initial = program.initial
    if initial is not None and exact.initial is not None:
        initial = compared(initial, exact.initial)
    labels = {name: compared(e, exact.labels[name]) for name, e in program.labels.items()}
    return replace(program, modules=modules, rewards=rewards, labels=labels, initial=initial)


def constant_value(name: str, value: object) -> Value:
    """A value that is given for a constant: a number, a Boolean, or the text of one."""
    if isinstance(value, str):
        try:
            expression = substitute(ExpressionParser(value).whole(), {})
        except LanguageError as error:
            raise ValueError(f"constant {name} = {value!r}: {error.message}") from None
        if not expression.is_literal:
            raise ValueError(f"constant {name} = {value!r}; give a number, true or false.")
        value = expression.value
    if isinstance(value, bool):
        return value
    if hasattr(value, "item"):
        value = value.item()
    if not isinstance(value, int | float) or not math.isfinite(value) or abs(value) > MAX_INTEGER:
        raise ValueError(f"constant {name} is {value!r}; give a finite number, true or false.")
    return value


def changed(tree: Tree, change: Change, names: Mapping[str, str] | None = None) -> Tree:
    """Applies a function to the expressions of a tree, and renames its actions and variables."""
    result: object = tree
    if isinstance(tree, Expression):
        result = change(tree)
    elif isinstance(tree, tuple):
        result = tuple([changed(x, change, names) for x in tree])
    elif isinstance(tree, str):
        result = (names or {}).get(tree, tree)
    elif is_dataclass(tree) and not isinstance(tree, type):
        parts = {f.name: changed(getattr(tree, f.name), change, names) for f in fields(tree)}
        result = type(tree)(**parts)
    return cast(Tree, result)


class _Resolver:
    """Stages of the resolution; each method is one stage."""

    def __init__(
        self,
        syntax: Syntax,
        values: Mapping[str, Value],
        real: Callable[[int], float | Fraction],
    ) -> None:
        self.syntax, self.given, self.real = syntax, values, real
        self.table = {c.name: c for c in syntax.constants}

    def program(self) -> Program:
        syntax = self.syntax
        formulas = _expanded(syntax.formulas, "formula", {})
        expand = _substitution(formulas)
        modules = self.renamed(
            [changed(m, expand) if isinstance(m, Module) else m for m in syntax.modules], formulas
        )
        self.check_names(modules)
        structures, players = tuple(syntax.rewards), tuple(syntax.players)
        if syntax.system is not None:
            modules, structures, players = composed(syntax.system, modules, structures, players)
        constants, known = self.constant_values(expand)
        quoted = [(f'"{name}"', expand(e)) for name, e in syntax.labels]
        labels = _expanded(quoted, "label", known)
        fold = _substitution(known | labels)
        both: Change = lambda e: fold(expand(e))  # noqa: E731
        modules = [changed(m, fold) for m in modules]
        variables = [self.variable(changed(d, both), None) for d in syntax.variables]
        variables += [self.variable(d, i) for i, m in enumerate(modules) for d in m.declarations]
        rewards = changed(_numbered(structures), both)
        _check_distinct(
            [(name, e.place) for name, e in syntax.observables], "{} is observable twice."
        )
        used: set[str] = set()
        for e in (
            *(e for m in modules for c in m.commands for e in c.expressions),
            *(i.value for r in rewards for i in r.items),
        ):
            names_in(e, used)
        undefined = {c.name: c for c in syntax.constants if c.name not in constants}
        program = Program(
            syntax.source,
            syntax.kind,
            constants,
            tuple(c.name for c in undefined.values() if c.type == "double" and c.name in used),
            {name: fold(e) for name, e in formulas.items()},
            tuple(variables),
            tuple(replace(m, declarations=()) for m in modules),
            {name.strip('"'): e for name, e in labels.items()},
            rewards,
            None if syntax.initial is None else both(syntax.initial),
            players,
            {name: both(e) for name, e in syntax.observables},
        )
        _Checker(program, undefined).check()
        return program

    def renamed(
        self, modules: Sequence[Module | RenamedModule], formulas: Mapping[str, Expression]
    ) -> list[Module]:
        by_name: dict[str, Module] = {}
        for m in sorted(modules, key=lambda m: isinstance(m, RenamedModule)):  # copies last
            if m.name in by_name:
                raise LanguageError(m.place, f"there are two modules {m.name}.")
            if isinstance(m, RenamedModule):
                if m.base not in by_name:
                    raise LanguageError(
                        m.place, f"there is no module {m.base} of which {m.name} could be a copy."
                    )
                m = _renamed(by_name[m.base], m, formulas)
            by_name[m.name] = m
        return [by_name[m.name] for m in modules]

    def check_names(self, modules: Sequence[Module]) -> None:
        """Raises LanguageError if two constants, formulas or variables have one name."""
        syntax = self.syntax
        places = [(name, e.place) for name, e in syntax.formulas]
        places += [(c.name, c.place) for c in syntax.constants]
        places += [(d.name, d.place) for d in syntax.variables]
        places += [(d.name, d.place) for m in modules for d in m.declarations]
        _check_distinct(places, "the name {} is declared twice.")
        structures = [(r.name, r.place) for r in _numbered(syntax.rewards)]
        _check_distinct(structures, 'there are two reward structures "{}".')
        if unknown := sorted(self.given.keys() - self.table.keys()):
            listed = ", ".join(self.table) or "none"
            raise LanguageError(0, f"there is no constant {unknown[0]}; it has {listed}.")

    def constant_values(self, expand: Change) -> tuple[dict[str, Value], dict[str, Expression]]:
        """The values of constants that are defined or given, and all of these as expressions."""
        table = self.table
        texts = {c.name: expand(c.expression) for c in table.values() if c.expression is not None}
        order = _in_order(texts, "constant", {c.name: c.place for c in table.values()})
        values: dict[str, Value] = {}
        known: dict[str, Expression] = {}
        types: dict[str, Type] = {c.name: c.type for c in table.values()}
        for name in (*self.given, *order):
            if name not in self.given:
                type_of(texts[name], types)
                e = substitute(texts[name], known)
            elif name in texts:
                raise LanguageError(table[name].place, f"the constant {name} has a value already.")
            else:
                e = literal(self.given[name])
            if e.is_literal:
                values[name] = _typed(table[name], e.value, self.real)
                e = literal(values[name])
            for missing in sorted(names_in(e) & table.keys()):
                if types[name] != "double" or types[missing] != "double":
                    raise LanguageError(table[name].place, _no_value(missing))
            known[name] = e
        return values, known

    def variable(self, d: Declaration, module: int | None) -> Variable:
        if d.initial is not None and self.syntax.initial is not None:
            raise LanguageError(
                d.place, f"{d.name} has an initial value, and there is an init block; remove one."
            )
        if d.low is None or d.high is None:
            value = self.number(d.initial, d, "bool") if d.initial is not None else False
            return Variable(d.name, "bool", 0, 1, int(value), module, d.place)
        low, high = (int(self.number(e, d, "int")) for e in (d.low, d.high))
        if low > high:
            raise LanguageError(d.place, f"the range [{low}..{high}] of {d.name} is empty.")
        initial = low if d.initial is None else int(self.number(d.initial, d, "int"))
        if not low <= initial <= high:
            raise LanguageError(
                d.place, f"{d.name} begins with {initial}, outside of its range [{low}..{high}]."
            )
        return Variable(d.name, "int", low, high, initial, module, d.place)

    def number(self, e: Expression, d: Declaration, expected: Type) -> Value:
        if not e.is_literal:
            if missing := sorted(names_in(e) & self.table.keys()):
                raise LanguageError(e.place, _no_value(missing[0]))
            raise LanguageError(e.place, f"{e} is no constant; ranges and initial values must be.")
        assert e.value is not None and not isinstance(e.value, str)
        if value_type(e.value) != expected:
            kind = "a Boolean" if expected == "bool" else "an integer"
            raise LanguageError(d.place, f"{e} is given for {d.name}; expected {kind}.")
        return e.value


def _check_distinct(names: Sequence[tuple[str, int]], message: str) -> None:
    """Raises LanguageError at the place of a name that occurs before."""
    seen: set[str] = set()
    for name, place in names:
        if name in seen:
            raise LanguageError(place, message.format(name))
        seen.add(name)


def _expanded(
    items: Sequence[tuple[str, Expression]], kind: str, known: Mapping[str, Expression]
) -> dict[str, Expression]:
    """Expressions by name, which may use each other; LanguageError for a circle."""
    places = [(name, e.place) for name, e in items]
    _check_distinct(places, f"the {kind} {{}} is defined twice.")
    table, done = dict(items), dict(known)
    for name in _in_order(table, kind, dict(places)):
        done[name] = substitute(table[name], done)
    return {name: done[name] for name in table}


def _no_value(name: str) -> str:
    return (
        f"the constant {name} has no value; give constants={{{name!r}: ...}}, or --const {name}=... "
        "on the command line."
    )


def _typed(constant: Constant, value: object, real: Callable[[int], float | Fraction]) -> Value:
    """A value of a constant's type."""
    assert isinstance(value, int | float | Fraction)
    actual = value_type(value)
    if isinstance(value, int) and constant.type == "double" and actual == "int":
        return real(value)
    is_argument = constant.expression is None
    if is_argument and constant.type == "int" and _is_whole(value):
        return int(value)
    if actual != constant.type:
        raise LanguageError(
            constant.place,
            f"the constant {constant.name} is {value}, and its type {constant.type}.",
        )
    return value


def _is_whole(value: Value) -> bool:
    return isinstance(value, float | Fraction) and value == math.floor(value)


def _with_functions(change: Change, names: Mapping[str, str]) -> Change:
    """A change of expressions after which functions have other names."""
    functions = {old: new for old, new in names.items() if old in FUNCTIONS and new in FUNCTIONS}

    def renamed(e: Expression) -> Expression:
        operands = tuple([renamed(x) for x in e.operands])
        return replace(e, operator=functions.get(e.operator, e.operator), operands=operands)

    return (lambda e: renamed(change(e))) if functions else change


def _substitution(names: Mapping[str, Expression]) -> Change:
    """Substitution that shares results between expressions."""
    memory: dict[int, Expression] = {}
    alive: list[Expression] = []  # nodes keep their ids in use

    def change(e: Expression) -> Expression:
        alive.append(e)
        return substitute(e, names, memory)

    return change


def _in_order(
    table: Mapping[str, Expression], kind: str, places: Mapping[str, int]
) -> Iterable[str]:
    """Names so that each comes after those that it needs; LanguageError for a circle."""
    needs = {name: sorted(names_in(e) & table.keys()) for name, e in table.items()}
    try:
        return tuple(TopologicalSorter(needs).static_order())
    except CycleError as error:
        name = min(error.args[1], key=places.__getitem__)
        raise LanguageError(places[name], f"the {kind} {name} depends on itself.") from None


def _renamed(base: Module, renaming: RenamedModule, formulas: Mapping[str, Expression]) -> Module:
    """The copy of a module, after formulas have been substituted."""
    names = dict(renaming.renaming)
    rename = _substitution(
        {old: Expression("name", value=new, place=renaming.place) for old, new in names.items()}
    )
    rename = _with_functions(rename, names)
    for old, new in renaming.renaming:
        # PRISM renames within the formula, Storm takes the other formula.
        if old in formulas and new in formulas and rename(formulas[old]) != formulas[new]:
            raise LanguageError(
                renaming.place,
                f"the formula {old} with renamed variables is not the formula {new}; rename the "
                "variables alone, or make them equal.",
            )
    for d in base.declarations:
        if d.name not in names:
            raise LanguageError(
                renaming.place,
                f"the copy {renaming.name} does not rename {d.name}, a variable of {base.name}.",
            )
    copy = changed(base, rename, names)
    placed = tuple(replace(d, place=renaming.place) for d in copy.declarations)
    return replace(copy, name=renaming.name, declarations=placed, place=renaming.place)


def _numbered(rewards: Sequence[RewardStructure]) -> tuple[RewardStructure, ...]:
    """Reward structures with distinct names: of several without one, the name is the position."""
    if sum(not r.name for r in rewards) < 2:
        return tuple(rewards)
    return tuple(replace(r, name=r.name or str(i)) for i, r in enumerate(rewards, 1))


class _Checker:
    """Types, owners of variables, and constants without a value."""

    def __init__(self, program: Program, undefined: Mapping[str, Constant]) -> None:
        self.program, self.undefined = program, undefined
        self.types: dict[str, Type] = {v.name: v.type for v in program.variables}
        self.with_parameters = program.types
        self.owner = {v.name: v.module for v in program.variables}

    def check(self) -> None:
        program = self.program
        uses = Counter(a for m in program.modules for a in {c.action for c in m.commands})
        for i, m in enumerate(program.modules):
            for c in m.commands:
                self.boolean(c.guard, "a guard")
                for o in c.outcomes:
                    for e in (o.probability, o.upper or o.probability):
                        self.number(e, "a probability")
                    variables = [(a.variable, a.place) for a in o.assignments]
                    for a in o.assignments:
                        self.assignment(a, i, c.action if uses[c.action] > 1 else "")
                    _check_distinct(variables, "{} is assigned twice in one update.")
        for name, e in program.labels.items():
            self.boolean(e, f'the label "{name}"')
        for item in (i for r in program.rewards for i in r.items):
            self.boolean(item.guard, "the guard of a reward")
            self.number(item.value, "a reward")
        if program.initial is not None:
            self.boolean(program.initial, "the init block")
        self.observables()
        self.players(set(uses))

    def observables(self) -> None:
        program = self.program
        if program.kind == "pomdp" and not program.observables:
            raise LanguageError(
                0, "the pomdp has no observables; give observables ... endobservables, or an mdp."
            )
        for name, e in program.observables.items():
            if program.kind != "pomdp":
                raise LanguageError(e.place, f"{name} is observable; only a pomdp has observables.")
            self.type(e, self.types)
        if program.kind == "pomdp" and program.has_intervals:
            raise LanguageError(0, "a pomdp with intervals of probabilities is not supported.")

    def players(self, actions: set[str]) -> None:
        program = self.program
        if program.kind == "smg" and not program.players:
            raise LanguageError(0, "the game has no player ... endplayer block.")
        known = {m.name for m in program.modules} | {f"[{a}]" for a in actions}
        seen: set[str] = set()
        for p in program.players:
            controlled = [*p.modules, *(f"[{a}]" for a in p.actions)]
            for name in controlled:
                if name not in known:
                    raise LanguageError(
                        p.place, f"player {p.name}: there is no {name.strip('[]')}."
                    )
                if name in seen:
                    raise LanguageError(p.place, f"{name} belongs to two players.")
            seen.update(controlled)

    def assignment(self, a: Assignment, module: int, shared: str) -> None:
        """Checks an assignment of a module, of a command with a shared action or ""."""
        if a.variable not in self.owner:
            raise LanguageError(a.place, f"{a.variable} is no variable.")
        owner = self.owner[a.variable]
        if owner is None and shared:
            raise LanguageError(
                a.place,
                f"[{shared}] synchronises modules and assigns the global variable {a.variable}; "
                "only commands without synchronisation may.",
            )
        if owner not in (None, module):
            name = self.program.modules[owner].name
            raise LanguageError(
                a.place, f"{a.variable} belongs to the module {name}; only it may assign it."
            )
        actual = self.type(a.expression, self.types)
        expected = self.types[a.variable]
        if actual != expected:
            hint = "; use floor, ceil or round" if (expected, actual) == ("int", "double") else ""
            raise LanguageError(
                a.place,
                f"{a.expression} of type {actual} is assigned to {a.variable} of type {expected}{hint}.",
            )

    def boolean(self, e: Expression, role: str) -> None:
        if self.type(e, self.types) != "bool":
            raise LanguageError(e.place, f"{e} is {role} and no Boolean.")

    def number(self, e: Expression, role: str) -> None:
        if self.type(e, self.with_parameters) == "bool":
            raise LanguageError(e.place, f"{e} is {role} and no number.")

    def type(self, e: Expression, types: Mapping[str, Type]) -> Type:
        """The type; LanguageError that names a constant without a value."""
        if missing := (names_in(e) - types.keys()) & self.undefined.keys():
            name = min(missing)
            raise LanguageError(self.undefined[name].place, _no_value(name))
        return type_of(e, types)
