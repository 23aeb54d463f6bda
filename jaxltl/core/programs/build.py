"""Sparse models of programs in the PRISM language."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.language.expressions import Expression, LanguageError, compile_expressions, literal
from jaxltl.core.language.syntax import Program, RewardItem
from jaxltl.core.models.number_source import NumberSource
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP, interval_rows
from jaxltl.core.models.multiplayer import MultiplayerGame, make_multiplayer_game
from jaxltl.core.models.pomdp import POMDP, make_pomdp, observation_numbers
from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse
from jaxltl.core.programs.exact import rational_numbers
from jaxltl.core.programs.explore import Explored, Progress, RewardParts, BreadthFirstSearch
from jaxltl.core.programs.packed_states import (
    Layout,
    StateReader,
    Words,
    initial_columns,
    make_layout,
)
from jaxltl.core.programs.local_choices import Functions, Intervals, Numbers, state_text
from jaxltl.core.programs.rows import ProgramRows as ProgramRows
from jaxltl.core.sparse.rows import offsets_from_counts

MAX_STATES = 10_000_000
_PART = 2**17  # states on which labels and rewards are evaluated together


def build_model(
    program: Program,
    *,
    coalition: Sequence[str] | None = None,
    max_states: int = MAX_STATES,
    progress: Progress | None = None,
) -> SparseMDP | IntervalMDP | Game | MultiplayerGame | POMDP:
    """The model of a program, with all reachable states.

    The initial states come first. Deadlocks get a self-loop, with a warning. In a ``dtmc`` each of
    several enabled commands has the same probability, with a warning. `valuation` has the variables
    of each state, and the label ``"deadlock"`` is added where it differs from certain self-loops.

    Args:
      program: of :func:`~jaxltl.core.language.resolve.read_program`, without parameters.
      coalition: players of an smg, names or numbers from 1, that are the system of a two-player game.
      max_states: the largest number of states, and a hundredth of that of transitions.
      progress: is called with the numbers of states that are found and expanded.

    Returns:
      A SparseMDP; an IntervalMDP if some probability is an interval; a MultiplayerGame of an smg, or
      the Game of a coalition; a POMDP of a pomdp.

    Raises:
      ValueError: too many states, parameters, an update that leaves the range of a variable or is
        no distribution, a state of a game with choices of two players or of none, an unknown
        player, or states of equal observation with different actions.

    Example:
      >>> from jaxltl.core.language.resolve import read_program
      >>> text = "dtmc module m x : [0..2]; [] x<2 -> 0.5 : (x'=x+1) + 0.5 : (x'=2); [] x=2 -> true; endmodule"
      >>> model = build_model(read_program(text))
      >>> model.successor.tolist(), model.valuation["x"].tolist()
      ([1, 2, 2, 2], [0, 1, 2])
    """
    if program.parameters:
        name = program.parameters[0]
        place = program.source.text.find(name)
        text = (
            f"the constant {name} has no value; give constants={{{name!r}: ...}} (--const {name}=...), "
            "or read it as a parameter with jl.io.read_parametric."
        )
        raise program.source.located(LanguageError(place, text))
    rows = build_rows(program, max_states=max_states, progress=progress)
    rewards = {name: Rewards(*parts) for name, parts in rows.rewards.items()}
    starts = rows.row_start, rows.entry_start, rows.successor
    ends = rows.weight.T if rows.weight.ndim == 2 else [rows.weight]
    make: Any = interval_rows if len(ends) == 2 else make_sparse
    with validation.errors_in(f"{program.source.name!r}: "):
        model: SparseMDP | IntervalMDP = make(*starts, *ends, rewards=rewards, **rows.annotations)
        if isinstance(model, SparseMDP):
            source = NumberSource(partial(rational_numbers, program, build_rows))
            model = replace(model, numbers=source)
            if rows.observables:
                number, values = observation_numbers(rows.observables)
                return make_pomdp(model, number, observables=values)
        if rows.owner is None:
            return model
        smg = make_multiplayer_game(model, rows.owner, [p.name for p in program.players])
        return smg if coalition is None else smg.game(coalition)


def build_rows(
    program: Program,
    *,
    max_states: int = MAX_STATES,
    progress: Progress | None = None,
    weights: Numbers | None = None,
) -> ProgramRows:
    """Rows of the model of a program, also of one with parameters; see :func:`build_model`."""
    max_states = validation.integer("max_states", max_states, least=1, limit=2**31 - 2)
    layout = make_layout(program.variables)
    if weights is None:
        intervals = Intervals() if program.has_intervals else Numbers()
        weights = Functions() if program.parameters else intervals
    try:
        initial = layout.packed(*initial_columns(program, max_states))
        explored = BreadthFirstSearch(program, layout, weights, max_states).run(initial, progress)
        return _rows(program, explored, weights)
    except LanguageError as error:
        raise program.source.located(error) from None


def _rows(program: Program, explored: Explored, weights: Numbers) -> ProgramRows:
    size = explored.words[0].size
    explored.rewards.update(
        (r.name, _reward_parts(explored, weights, r.items)) for r in program.rewards
    )
    owner = _owners(program, explored) if program.kind == "smg" else None
    deadlock = explored.row_count == 0
    if deadlock.any():
        count = f"{int(deadlock.sum())} of {size} states are deadlocks"
        _warn(program, f"{count}; each gets a self-loop.")
        explored = with_loops(explored)
    if program.kind == "dtmc" and explored.action.size > size:
        several = f"in {int((explored.row_count > 1).sum())} states of a dtmc"
        _warn(program, f"several commands are enabled {several}; each has the same probability.")
        explored = as_chain(explored, weights)
    label = _label_columns(program, explored, deadlock)
    observed = on_states(explored.layout, explored.words, list(program.observables.values()))
    annotations = {
        "initial": explored.initial,
        "label": np.stack(list(label.values()), 1) if label else np.zeros((size, 0), bool),
        "propositions": tuple(label),
        "action": explored.action,
        "action_names": explored.actions,
        "valuation": {
            v.name: _column(explored.layout, explored.words, v.name) for v in program.variables
        },
    }
    return ProgramRows(
        offsets_from_counts(explored.row_count),
        offsets_from_counts(explored.entry_count),
        explored.successor,
        explored.weight,
        annotations,
        explored.rewards,
        tuple(weights.expressions) if isinstance(weights, Functions) else (),
        owner,
        dict(zip(program.observables, observed, strict=True)),
    )


def _warn(program: Program, text: str) -> None:
    warnings.warn(f"{program.source.name!r}: {text}", stacklevel=4)


def _column(layout: Layout, words: Words, name: str) -> NDArray[Any]:
    """Values of a variable, in the smallest type."""
    variable, values = layout.fields[name].variable, layout.values(words, name)
    if variable.type == "bool":
        return values
    return values.astype(
        np.result_type(*map(np.min_scalar_type, (min(variable.low, -1), variable.high)))
    )


def on_states(
    layout: Layout, words: Words, expressions: Sequence[Expression]
) -> list[NDArray[Any]]:
    """Values of expressions in some states, ``[S]`` each."""
    compiled, size = compile_expressions(expressions), words[0].size
    parts: list[list[NDArray[Any]]] = [[] for _ in expressions]
    for begin in range(0, size, _PART):
        some = tuple(w[begin : begin + _PART] for w in words)
        values = compiled(StateReader(layout, some))
        for part, value in zip(parts, values, strict=True):
            part.append(np.broadcast_to(value, (some[0].size,)))
    return [np.concatenate(part) for part in parts]


def _label_columns(
    program: Program, explored: Explored, deadlock: Booleans
) -> dict[str, NDArray[np.bool_]]:
    """The states of each label."""
    columns = on_states(explored.layout, explored.words, list(program.labels.values()))
    label = dict(zip(program.labels, columns, strict=True))
    only = np.flatnonzero(explored.row_count == 1)
    first = offsets_from_counts(explored.row_count)[only]
    entry = offsets_from_counts(explored.entry_count)[first]
    loops = np.zeros(deadlock.size, bool)
    loops[only] = (explored.entry_count[first] == 1) & (explored.successor[entry] == only)
    return label if np.array_equal(loops, deadlock) else label | {"deadlock": deadlock}


# --- rewards ----------------------------------------------------------------------------------


def _reward_parts(explored: Explored, weights: Numbers, items: Sequence[RewardItem]) -> RewardParts:
    """Rewards of states and of choices; numbers of functions in a program with parameters."""
    size = explored.words[0].size
    by_action: dict[str | None, list[RewardItem]] = {}
    for i in items:
        by_action.setdefault(i.action, []).append(i)
    state = choices = None
    if None in by_action:
        state = _earned(explored, weights, by_action.pop(None), np.arange(size))
    of_row = np.repeat(np.arange(size), explored.row_count)
    for number, action in enumerate(explored.actions):
        rows = (
            np.flatnonzero(explored.action == number) if action in by_action else np.zeros(0, int)
        )
        if rows.size:
            earned = _earned(explored, weights, by_action[action], of_row[rows])
            choices = np.zeros(of_row.size, earned.dtype) if choices is None else choices
            choices[rows] = earned
    return state, choices


def _earned(
    explored: Explored, weights: Numbers, items: Sequence[RewardItem], states: Integers
) -> NDArray[Any]:
    """The sum of some items in some states."""
    words = tuple(w[states] for w in explored.words)
    if isinstance(weights, Functions):
        terms = [Expression("?:", (i.guard, i.value, literal(0))) for i in items]
        total = Expression("+", (literal(0), *terms))
        return weights.numbers(total, StateReader(explored.layout, words), states.size)
    values = on_states(explored.layout, words, [e for i in items for e in (i.guard, i.value)])
    earned = np.zeros(states.size)
    for item, guard, value in zip(items, values[::2], values[1::2], strict=True):
        bad = guard & ~np.isfinite(value.astype(np.float64))
        if bad.any():
            raise LanguageError(item.value.place, f"the reward {item.value} is not finite.")
        earned += np.where(guard, value, 0.0)
    return earned


# --- deadlocks and overlapping commands -------------------------------------------------------


def with_loops(explored: Explored) -> Explored:
    """The model with a self-loop in each state without choices."""
    states = np.flatnonzero(explored.row_count == 0)
    row = offsets_from_counts(explored.row_count)[states]
    entry = offsets_from_counts(explored.entry_count)[row]
    return replace(
        explored,
        row_count=np.maximum(explored.row_count, 1),
        action=np.insert(explored.action, row, 0),
        owner=np.insert(explored.owner, row, -1),
        entry_count=np.insert(explored.entry_count, row, 1),
        successor=np.insert(explored.successor, entry, states.astype(np.int32)),
        weight=np.insert(explored.weight, entry, 1, axis=0),
        rewards={
            name: (state, None if choice is None else np.insert(choice, row, 0))
            for name, (state, choice) in explored.rewards.items()
        },
    )


def as_chain(explored: Explored, weights: Numbers) -> Explored:
    """The Markov chain that picks each enabled command with the same probability."""
    starts = offsets_from_counts(explored.row_count)[:-1]
    share = np.repeat(explored.row_count, explored.row_count)
    rewards = dict(explored.rewards)
    for name, (state, choice) in rewards.items():
        if choice is not None and isinstance(weights, Functions):
            raise LanguageError(
                0,
                "rewards of choices in a dtmc with overlapping commands and parameters are not "
                "supported; make the guards disjoint.",
            )
        if choice is not None:
            rewards[name] = state, np.add.reduceat(choice / share, starts)
    return replace(
        explored,
        row_count=np.ones_like(explored.row_count),
        action=np.where(explored.row_count == 1, explored.action[starts], 0).astype(np.int32),
        entry_count=np.add.reduceat(explored.entry_count, starts),
        weight=weights.divided(explored.weight, np.repeat(share, explored.entry_count)),
        rewards=rewards,
    )


# --- games ------------------------------------------------------------------------------------


def _owners(program: Program, explored: Explored) -> Integers:
    """The player of each state: of its choices with a player, the first one where there is one choice.

    Raises:
      LanguageError: a state with choices of several players, or with several choices and no player.
    """
    modules = [m.name for m in program.modules]
    of_module = np.full(len(modules) + 1, -1)
    of_action = np.full(len(explored.actions), -1)
    for i, player in enumerate(program.players):
        of_module[[modules.index(m) for m in player.modules]] = i
        of_action[[explored.actions.index(a) for a in player.actions]] = i
    of_row = np.where(explored.action > 0, of_action[explored.action], of_module[explored.owner])
    state = np.repeat(np.arange(explored.row_count.size), explored.row_count)
    owner = np.where(explored.row_count > 1, -1, 0)
    owner[state[of_row >= 0]] = of_row[of_row >= 0]
    wrong = (owner[state] < 0) | ((of_row >= 0) & (owner[state] != of_row))
    if wrong.any():
        row = int(np.argmax(wrong))
        i, action = int(state[row]), int(explored.action[row])
        name = f"the action [{explored.actions[action]}]"
        if not action:
            name = f"the unlabelled command of module {modules[int(explored.owner[row])]}"
        words = tuple(w[i : i + 1] for w in explored.words)
        place = f"in the state {state_text(StateReader(explored.layout, words), 0)}"
        if of_row[row] < 0:
            raise LanguageError(
                0, f"{name} {place} belongs to no player; list it in a player ... endplayer block."
            )
        raise LanguageError(
            0,
            f"the choices {place} belong to several players; in a turn-based game one player has all.",
        )
    return owner
