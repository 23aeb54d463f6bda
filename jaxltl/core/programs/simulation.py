"""Programs in the PRISM language as simulated environments, without exploring their states."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import accumulate, product
from math import prod

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.core.array_types import Booleans
from jaxltl.core.environments.environment import Environment, Timestep, make_box, make_environment
from jaxltl.core.language.expressions import (
    Expression,
    FALSE,
    LanguageError,
    compile_expressions,
    conjuncts,
    names_in,
)
from jaxltl.core.language.syntax import Command, Program, RewardItem, Variable
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.programs.packed_states import initial_columns


MAX_CHOICES = 4096
_GRID = 2**12  # values of the variables of a condition that are enumerated


@dataclass(frozen=True)
class Group:
    """Commands of a module with the same action, of which at most one is enabled in a state."""

    module: int
    action: str
    commands: tuple[Command, ...]
    draw: int  # number of the random draw, among those of a synchronised choice


@dataclass(frozen=True)
class Synchronization:
    """A group of each module that takes part in a synchronisation."""

    name: str
    action: str
    groups: tuple[int, ...]


def list_choices(program: Program) -> tuple[tuple[Group, ...], tuple[Synchronization, ...]]:
    """Groups of commands, and the choices that they form; ValueError for more than 4096 choices.

    Two commands are in one group if their guards exclude each other, by the values of at most a few
    variables. Choices without an action come first, by module, then those of each action.
    """
    groups: list[Group] = []
    choices: list[Synchronization] = []
    variables = {v.name: v for v in program.variables}
    actions = sorted({c.action for m in program.modules for c in m.commands if c.action})
    everywhere = range(len(program.modules))
    cells = [(m.name, "", range(i, i + 1)) for i, m in enumerate(program.modules)]
    cells += [(a, a, everywhere) for a in actions]
    for name, action, modules in cells:
        parts, draw = [], 0
        for m in modules:
            commands = [c for c in program.modules[m].commands if c.action == action]
            if not commands:
                continue
            slots: dict[int, list[Command]] = {}
            for c, slot in zip(commands, _colours(_overlap(commands, variables)), strict=True):
                slots.setdefault(slot, []).append(c)
            parts.append(range(len(groups), len(groups) + len(slots)))
            groups += [Group(m, action, tuple(slots[k]), draw) for k in sorted(slots)]
            draw += any(len(c.outcomes) > 1 for c in commands)
        number = prod(map(len, parts)) if parts else 0
        if len(choices) + number > MAX_CHOICES:
            raise program.source.located(
                LanguageError(
                    program.modules[modules[0]].place,
                    f"a state may have {len(choices) + number} choices, more than {MAX_CHOICES}, "
                    f"as the commands of [{action}] may be enabled together; make their guards "
                    "disjoint, or build the model.",
                )
            )
        for k, joint in enumerate(product(*parts) if parts else ()):
            choices.append(
                Synchronization(name if number == 1 else f"{name} {k + 1}", action, joint)
            )
    if not choices:
        raise program.source.located(LanguageError(0, "the program has no commands to simulate."))
    return tuple(groups), tuple(choices)


def _overlap(commands: Sequence[Command], variables: dict[str, Variable]) -> Booleans:
    """``bool[C, C]``: False where two guards are known to exclude each other."""
    parts = [conjuncts(c.guard) for c in commands]
    supports = {frozenset(names_in(e) & variables.keys()) for some in parts for e in some}
    overlap = np.ones((len(commands), len(commands)), bool)
    for support in sorted(supports, key=sorted):
        ranges = [variables[n] for n in sorted(support)]
        if prod(v.high - v.low + 1 for v in ranges) > _GRID:
            continue
        held = np.stack([_holds(some, ranges) for some in parts]).astype(np.float32)
        overlap &= held @ held.T > 0
    return overlap


def _holds(conditions: Sequence[Expression], ranges: Sequence[Variable]) -> Booleans:
    """Values of the variables at which all conditions on no other ones hold."""
    axes = [np.arange(v.low, v.high + 1) for v in ranges]
    grid = np.meshgrid(*axes, indexing="ij") if axes else []
    values = {
        v.name: x.ravel() != 0 if v.type == "bool" else x.ravel()
        for v, x in zip(ranges, grid, strict=True)
    }
    truth = np.ones(prod(map(len, axes)), bool)
    for condition in compile_expressions([e for e in conditions if names_in(e) <= values.keys()])(
        values
    ):
        truth &= condition
    return truth


def _colours(overlap: Booleans) -> list[int]:
    """Greedy colouring: overlapping commands have different colours."""
    colour: list[int] = []
    for i in range(len(overlap)):
        taken = {c for j, c in enumerate(colour) if overlap[i, j]}
        colour.append(next(c for c in range(i + 1) if c not in taken))
    return colour


World = dict[str, jax.Array]  # int32[] or bool[] of each variable
_SUM_TOLERANCE = 1e-4  # of probabilities in single precision
_MAX_STARTS = 2**20


def program_environment(
    program: Program,
    *,
    reward: str | None = None,
    labels: Sequence[str] | None = None,
    observe: Callable[[World], PyTree] | None = None,
) -> Environment:
    """The simulated environment of a program in the PRISM language, without building its model.

    A state is a dict with ``int32[]`` or ``bool[]`` of each variable. An action of an mdp is a
    number in :func:`program_actions`; a choice that is not available changes nothing, as does a step
    in a deadlock, where action 0 is available. A dtmc has one action, and several enabled commands
    have the same probability. Episodes have no end: see ``with_time_limit``.

    The arithmetic is JAX's: 32-bit integers, and doubles of the default precision, in which
    probabilities are exact to 1e-7. An update that leaves the range of a variable is clipped, and
    the reward of a step with such an update, or with probabilities that do not sum to 1, is NaN.

    Args:
      program: of ``jl.io.read_program``, a dtmc or an mdp, without parameters.
      reward: the name of a reward structure, whose rewards of the state and of the choice before
        each step are added; ``""`` is the one without a name. Default: zero.
      labels: names of labels; ``"deadlock"`` marks states without choices. Default: all labels of
        the program.
      observe: ``state -> observation``; default: ``float[V]``, each variable scaled to 0..1.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`.

    Raises:
      ValueError: games, intervals, parameters, unknown names, more than 4096 choices in a state, or
        integers of more than 32 bits.

    Example:
      >>> from jaxltl.core.language.resolve import read_program
      >>> program = read_program('''mdp module m x : [0..2]; [up] x<2 -> (x'=x+1);
      ...     [down] x>0 -> 0.5 : (x'=x-1) + 0.5 : true; endmodule label "top" = x=2;''')
      >>> walk = program_environment(program)
      >>> world = walk.step(walk.reset(jax.random.key(0)), 1, jax.random.key(3)).world
      >>> program_actions(program), int(world["x"]), walk.allowed(world).tolist()
      (('down', 'up'), 1, [True, True])
    """
    _require_simulated(program)
    names = tuple(program.labels) if labels is None else tuple(labels)
    rewards = {r.name: r.items for r in program.rewards}
    if reward is not None:
        _require_name(program, "reward structure", reward, rewards)
    for name in names:
        _require_name(program, "label", name, {*program.labels, "deadlock"})
    try:
        _check_integers(program)
        simulation = _Simulation(program, () if reward is None else rewards[reward], names)
        values, size = initial_columns(program, _MAX_STARTS)
    except LanguageError as error:
        raise program.source.located(error) from None
    types = {v.name: bool if v.type == "bool" else np.int32 for v in program.variables}
    columns = {name: x.astype(types[name]) for name, x in values.items()}
    chain = program.kind == "dtmc"
    variables = len(program.variables)
    return make_environment(
        Partial(_reset, columns),
        Partial(simulation.step),
        Partial(simulation.observe) if observe is None else observe,
        actions=1 if chain else len(simulation.choices),
        allowed=None if chain else Partial(simulation.allowed),
        labels=Partial(simulation.labels),
        propositions=names,
        observations=make_box(0, 1, (variables,), jnp.result_type(float))
        if observe is None
        else None,
        starts=Partial(_starts, columns, np.full(size, 1 / size, jnp.result_type(float))),
    )


def program_actions(program: Program) -> tuple[str, ...]:
    """Names of the actions of the environment of an mdp.

    A choice is an action with a command of each of its modules, or a command without an action of
    one module. Commands that exclude each other share a number; where several may be enabled, the
    names are numbered.

    Args:
      program: of ``jl.io.read_program``.

    Returns:
      By number the name of the action, or of the module of commands without an action.

    Raises:
      ValueError: more than 4096 choices.

    Example:
      >>> from jaxltl.core.language.resolve import read_program
      >>> program_actions(read_program('''mdp module m x : [0..2];
      ...     [] x<2 -> (x'=x+1); [] x<1 -> true; [] x=2 -> true; endmodule'''))
      ('m 1', 'm 2')
    """
    return tuple(choice.name for choice in list_choices(program)[1])


def _require_name(program: Program, kind: str, name: str, known: Iterable[str]) -> None:
    if name not in known:
        raise ValueError(
            f"{program.source.name!r}: there is no {kind} {name!r}; there are {sorted(known)}."
        )


def _require_simulated(program: Program) -> None:
    """Raises ValueError for what has no simulation."""
    if program.kind in ("pomdp", "smg"):
        article = "an" if program.kind == "smg" else "a"
        text = f"{article} {program.kind} is not simulated; build the model, for model_environment."
    elif program.has_intervals:
        text = "a program with intervals of probabilities is not simulated; give numbers."
    elif program.parameters:
        text = f"a program whose constant {program.parameters[0]} has no value is not simulated; give it."
    else:
        return
    raise ValueError(f"{program.source.name!r}: {text}")


# --- functions of the environment -----------------------------------------------------------------


def _reset(columns: World, key: chex.PRNGKey) -> World:
    index = jax.random.randint(key, (), 0, len(next(iter(columns.values()))))
    return {name: jnp.asarray(x)[index] for name, x in columns.items()}


def _starts(columns: World, probability: jax.Array) -> tuple[World, jax.Array]:
    return columns, probability


class _Simulation:
    """A program as functions of one state."""

    def __init__(
        self, program: Program, rewards: Sequence[RewardItem], labels: Sequence[str]
    ) -> None:
        self.variables, self.chain = program.variables, program.kind == "dtmc"
        self.groups, self.choices = list_choices(program)
        commands = [c for g in self.groups for c in g.commands]
        guards = [c.guard for c in commands]
        updates = [e for c in commands for e in _command_expressions(c)]
        earned = [e for i in rewards for e in (i.guard, i.value)]
        self.guards = compile_expressions(guards)  # by group and command
        self.updates = compile_expressions([*guards, *updates, *earned])
        self.earned = tuple(i.action for i in rewards)  # action of each reward
        self.conditions = compile_expressions([program.labels.get(n, FALSE) for n in labels])
        implicit = "deadlock" in labels and "deadlock" not in program.labels
        self.deadlock = labels.index("deadlock") if implicit else -1

    def step(self, world: World, action: jax.Array, key: chex.PRNGKey) -> Timestep:
        values = map(jnp.asarray, self.updates(world, jnp))
        guards = self._by_group(values)
        mask = self._available(guards)
        # The last draw chooses among the enabled commands of a chain.
        draws = 1 + max(g.draw for g in self.groups) + (len(self.choices) > 1)
        uniform = jax.random.uniform(key, (draws if self.chain else max(1, draws - 1),))
        chosen = self._chosen(mask, action, uniform[-1])
        new = dict(world)
        invalid = jnp.bool_(False)
        for i, (group, enabled) in enumerate(zip(self.groups, guards, strict=True)):
            picked = _any([chosen[k] for k, c in enumerate(self.choices) if i in c.groups])
            for command, guard in zip(group.commands, enabled, strict=True):
                active = picked & guard
                invalid |= active & _update(command, active, uniform[group.draw], values, new)
        for v in self.variables:
            if v.type == "int":
                inside = jnp.clip(new[v.name], v.low, v.high)
                invalid |= inside != new[v.name]
                new[v.name] = inside
        earned = jnp.zeros((), jnp.result_type(float))
        for action_name in self.earned:
            guard, value = next(values), next(values)
            if action_name is not None:
                marks = zip(self.choices, chosen, strict=True)
                guard = guard & _any([m for c, m in marks if c.action == action_name])
            earned = earned + jnp.where(guard, value, 0)
        reward = jnp.where(invalid, jnp.nan, earned).astype(jnp.result_type(float))
        return Timestep(new, reward, terminated=jnp.bool_(False))

    def _by_group(self, values: Iterator[jax.Array]) -> list[list[jax.Array]]:
        return [[next(values) for _ in g.commands] for g in self.groups]

    def _available(self, guards: list[list[jax.Array]]) -> list[jax.Array]:
        """Enabledness of each choice, from the guards by group."""
        of_group = [_any(some) for some in guards]
        return [reduce(jnp.logical_and, [of_group[g] for g in c.groups]) for c in self.choices]

    def _chosen(
        self, mask: list[jax.Array], action: jax.Array, uniform: jax.Array
    ) -> list[jax.Array]:
        """Marks of the chosen one among the available choices."""
        if not self.chain:
            return [m & (action == k) for k, m in enumerate(mask)]
        before = jnp.cumsum(jnp.stack(mask), dtype=jnp.int32)
        number = jnp.minimum((uniform * before[-1]).astype(jnp.int32), before[-1] - 1)
        return [m & (before[k] - 1 == number) for k, m in enumerate(mask)]

    def _enabled(self, world: World) -> list[jax.Array]:
        return self._available(self._by_group(map(jnp.asarray, self.guards(world, jnp))))

    def allowed(self, world: World) -> jax.Array:
        mask = self._enabled(world)
        return jnp.stack([mask[0] | ~_any(mask), *mask[1:]])

    def labels(self, world: World) -> jax.Array:
        marks = [jnp.asarray(x) for x in self.conditions(world, jnp)]
        if self.deadlock >= 0:
            marks[self.deadlock] = ~_any(self._enabled(world))
        return jnp.stack(marks) if marks else jnp.zeros(0, bool)

    def observe(self, world: World) -> jax.Array:
        scaled = [(world[v.name] - v.low) / max(1, v.high - v.low) for v in self.variables]
        return jnp.stack(scaled).astype(jnp.result_type(float))


def _command_expressions(command: Command) -> list[Expression]:
    """Probabilities and assigned values, in the order in which :func:`_update` reads them."""
    probabilities = [o.probability for o in command.outcomes]
    return probabilities + [a.expression for o in command.outcomes for a in o.assignments]


def _update(
    command: Command, active: jax.Array, uniform: jax.Array, values: Iterator[jax.Array], new: World
) -> jax.Array:
    """Assigns the variables of a random outcome; returns True for an invalid distribution."""
    weights = [next(values) for _ in command.outcomes]
    marks = _outcome_marks(weights, uniform)
    for outcome, mark in zip(command.outcomes, marks, strict=True):
        for a in outcome.assignments:
            old = new[a.variable]
            value = next(values).astype(old.dtype)
            new[a.variable] = jnp.where(active & mark, value, old)
    total = reduce(jnp.add, weights)
    valid = (total >= 1 - _SUM_TOLERANCE) & (total <= 1 + _SUM_TOLERANCE)
    for weight in weights:
        valid = valid & (weight >= 0)
    return ~valid


def _outcome_marks(weights: Sequence[jax.Array], uniform: jax.Array) -> list[jax.Array]:
    """Marks of the outcome of a uniform number; one of probability 0 never has it."""
    if len(weights) == 1:
        return [jnp.bool_(True)]
    sums = list(accumulate(weights, jnp.add))
    scaled = uniform * sums[-1]
    # From the last one on: the first outcome that is possible and has its sum above the number, or
    # the last possible one, where rounding leaves none.
    number = jnp.asarray(-1, jnp.int32)
    for k, (weight, total) in reversed(list(enumerate(zip(weights, sums, strict=True)))):
        number = jnp.where((weight > 0) & ((scaled < total) | (number < 0)), k, number)
    return [number == k for k in range(len(weights))]


def _any(marks: Sequence[jax.Array]) -> jax.Array:
    result: jax.Array = reduce(jnp.logical_or, marks, jnp.bool_(False))
    return result


# --- sizes of integers --------------------------------------------------------------------------------


_Ends = tuple[float, float, bool]  # least and largest value, and True for integers


def _check_integers(program: Program) -> None:
    """Raises LanguageError for integers that may not fit into 32 bits."""
    known: dict[int, _Ends] = {}
    ranges = {v.name: (float(v.low), float(v.high), v.type == "int") for v in program.variables}
    for v in program.variables:
        _require_32_bits(ranges[v.name], v.place, v.name)
    rewards = [e for r in program.rewards for i in r.items for e in (i.guard, i.value)]
    commands = [e for m in program.modules for c in m.commands for e in c.expressions]
    for e in (*program.labels.values(), *commands, *rewards):
        _ends(e, ranges, known)


def _require_32_bits(ends: _Ends, place: int, text: object) -> None:
    if ends[2] and not (ends[0] > -(2**31) and ends[1] < 2**31):
        raise LanguageError(
            place,
            f"the integer {text} may be {ends[0]:.9g} to {ends[1]:.9g}; a simulation has 32-bit "
            "integers. Write 1.0 * for a double, or build the model.",
        )


def _ends(e: Expression, ranges: dict[str, _Ends], known: dict[int, _Ends]) -> _Ends:
    """Bounds of an expression by interval arithmetic."""
    if e.operator == "name":
        return ranges[str(e.value)]
    if id(e) not in known:
        parts = [_ends(x, ranges, known) for x in e.operands]
        known[id(e)] = _node_ends(e, parts[e.operator == "?:" :])
        _require_32_bits(known[id(e)], e.place, e)
    return known[id(e)]


def _node_ends(e: Expression, parts: list[_Ends]) -> _Ends:
    lows, highs, whole = [p[0] for p in parts], [p[1] for p in parts], all(p[2] for p in parts)
    sizes = [max(abs(low), abs(high)) for low, high, _ in parts]
    match e.operator:
        case "literal":
            value = float(e.value) if isinstance(e.value, bool | int | float) else 0.0
            return value, value, type(e.value) is int
        case "floor" | "ceil" | "round":
            return lows[0] - (not whole), highs[0] + (not whole), True
        case "neg":
            return -highs[0], -lows[0], whole
        case "+":
            return sum(lows), sum(highs), whole
        case "-":
            return lows[0] - highs[1], highs[0] - lows[1], whole
        case "*":
            return (0.0 if min(lows) >= 0 else -math.prod(sizes)), math.prod(sizes), whole
        case "?:" | "min" | "max":
            return min(lows), max(highs), whole
        case "mod":
            return 0.0, max(highs[1] - 1, 0.0), True
        case "pow":
            base, exponent = max(sizes[0], 1.0), max(highs[1], 0.0)
            power = math.inf if exponent * math.log2(base) > 60 else base**exponent
            return (0.0 if lows[0] >= 0 else -power), power if whole else math.inf, whole
        case "/" if lows[1] > 0 or highs[1] < 0:
            size = sizes[0] / min(abs(lows[1]), abs(highs[1]))
            return -size, size, False
        case "/" | "log":
            return -math.inf, math.inf, False
    return 0.0, 1.0, False  # Boolean
