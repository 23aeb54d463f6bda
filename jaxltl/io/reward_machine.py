"""Reward machines: automata with rewards on transitions, in their text format.

Toro Icarte, Klassen, Valenzano and McIlraith, "Reward machines: exploiting reward function
structure in reinforcement learning" (JAIR 2022).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.automata.automaton import Automaton, make_alphabet, make_automaton
from jaxltl.core.logic.labels import satisfying
from jaxltl.core.logic.ltl import Formula, Letter, parse_ltl, proposition_text
from jaxltl.core.models.product import read_probability
from jaxltl.core.models import Game, Product, SparseMDP, to_sparse
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.pretty_print import brief
from jaxltl.io.files import read_text


@brief
class RewardMachine(NamedTuple):
    """Reward machine: an automaton with transition rewards.

    Attributes:
      automaton: co-safe, with the terminal states as final ones; `state_names` are the file's
        numbers.
      reward: ``float64[Q, L]``, of letter l in state q; zero in terminal states.
    """

    automaton: Automaton
    reward: NDArray[np.float64]


def read_reward_machine(
    source: str | os.PathLike[str], letters: Iterable[Letter] | None = None
) -> RewardMachine:
    """Reward machine of a file or a text.

    The first line has the initial state, the second the list of terminal states, each other line a
    transition ``(u, v, 'e&!n', ConstantRewardFunction(1))``; ``#`` starts a comment. Guards are
    Boolean formulas over propositions, ``True`` and ``False`` with ``! & |`` and parentheses. The
    first transition with a satisfied guard is taken; without one the machine ends, in a state named
    "ended", with reward 0. Terminal states have reward 0, and their transitions are ignored.

    Args:
      source: a file, or the text itself.
      letters: possible letters, each a collection of proposition names, such as
        ``jaxltl.models.occurring_letters(world)``; None for all 2^P subsets.

    Returns:
      :class:`RewardMachine`; :func:`machine_reward` is its reward in a product.

    Raises:
      ValueError: with file and line, for malformed text, rewards that are not constant, and more
        than 12 propositions without `letters`.

    Example:
      >>> machine = read_reward_machine('''0
      ... [1]
      ... (0, 1, 'goal', ConstantRewardFunction(2))
      ... (0, 0, '!goal', ConstantRewardFunction(0))''')
      >>> machine.automaton.propositions, machine.reward.max(axis=1).tolist()
      (('goal',), [2.0, 0.0])
    """
    is_text = isinstance(source, str) and "\n" in source
    place = "read_reward_machine" if is_text else str(source)
    reader = _RewardMachineReader(
        place, str(source) if is_text else read_text(source, "a reward machine")
    )
    initial, terminal, transitions = reader.statements()
    names = tuple(sorted({name for x in transitions for name in x.guard.propositions}))
    alphabet = make_alphabet(names, letters, f"{place}: line {reader.last}")
    return _machine(initial, terminal, transitions, names, alphabet)


class _MachineTransition(NamedTuple):
    source: int
    target: int
    guard: Formula
    reward: float


_STATE = re.compile(r"-?[0-9]{1,9}")
_STATES = re.compile(r"\[\s*(?:-?[0-9]{1,9}\s*(?:,\s*-?[0-9]{1,9}\s*)*,?\s*)?\]")
_NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_TRANSITION = re.compile(
    r"\(\s*(-?[0-9]{1,9})\s*,\s*(-?[0-9]{1,9})\s*,\s*(?:'([^']*)'|\"([^\"]*)\")\s*,"
    r"\s*(\w+)\s*\(([^()]*)\)\s*\)"
)
_NAME = re.compile(r"[A-Za-z_][\w.-]*", re.ASCII)


class _RewardMachineReader:
    """Parser of reward machines; keeps non-empty lines with their numbers."""

    def __init__(self, place: str, text: str) -> None:
        self.place = place
        lines = [line.partition("#")[0].strip() for line in text.split("\n")]
        self.lines = [(i, line) for i, line in enumerate(lines, start=1) if line]
        self.last = len(lines)
        self.guards: dict[str, Formula] = {}

    def error(self, line: int, message: str) -> ValueError:
        return ValueError(f"{self.place}, line {line}: {message}")

    def statements(self) -> tuple[int, set[int], list[_MachineTransition]]:
        head = iter(self.lines)
        line, text = next(head, (self.last, ""))
        if not _STATE.fullmatch(text):
            raise self.error(
                line, f"found {text[:40]!r}; expected the number of the initial state."
            )
        initial = int(text)
        line, text = next(head, (self.last, ""))
        if not _STATES.fullmatch(text):
            raise self.error(
                line, f"found {text[:40]!r}; expected the list of terminal states, such as [2]."
            )
        return initial, {int(x) for x in _STATE.findall(text)}, [self._transition(*x) for x in head]

    def _transition(self, line: int, text: str) -> _MachineTransition:
        match = _TRANSITION.fullmatch(text)
        if match is None:
            raise self.error(
                line, f"found {text[:60]!r}; expected a transition such as "
                "(0, 1, 'e & !n', ConstantRewardFunction(1))."
            )  # fmt: skip
        source, target, single, double, kind, number = match.groups()
        if kind != "ConstantRewardFunction":
            raise self.error(
                line, f"the reward is {kind}(...), which depends on more than the labels; expected "
                "ConstantRewardFunction(a number)."
            )  # fmt: skip
        number = number.strip()  # float() strips fewer kinds of whitespace
        if not re.fullmatch(_NUMBER, number) or not np.isfinite(float(number)):
            raise self.error(line, f"the reward is {number[:40]!r}; expected a finite number.")
        guard = self._guard(line, single if double is None else double)
        return _MachineTransition(int(source), int(target), guard, float(number))

    def _guard(self, line: int, text: str) -> Formula:
        if text not in self.guards:
            constants = {"True": "true", "False": "false"}
            plain = _NAME.sub(lambda m: constants.get(m[0]) or _quoted(m[0]), text)
            try:
                if not re.fullmatch(r"[!&|()\s]*", _NAME.sub("", text)):
                    raise ValueError
                self.guards[text] = parse_ltl(plain)
            except (ValueError, RecursionError):
                raise self.error(
                    line, f"the guard is {text[:60]!r}; expected propositions joined by ! & |, or "
                    "True."
                ) from None  # fmt: skip
        return self.guards[text]


def _quoted(name: str) -> str:
    text = proposition_text(name)
    return text if text.startswith('"') else f'"{text}"'


def _machine(
    initial: int, terminal: set[int], transitions: list[_MachineTransition], names: tuple[str, ...],
    alphabet: NDArray[np.bool_],
) -> RewardMachine:  # fmt: skip
    states = sorted({initial, *terminal, *[q for x in transitions for q in x[:2]]})
    index = {q: i for i, q in enumerate(states)}
    count, width = len(states), len(alphabet)
    delta, reward = np.full((count, width), -1), np.zeros((count, width))
    final = np.array([q in terminal for q in states])
    delta[final] = np.flatnonzero(final)[:, None]
    holds: dict[Formula, NDArray[np.bool_]] = {}
    for source, target, guard, pays in transitions:
        if guard not in holds:
            holds[guard] = satisfying(alphabet, names, guard, "guard")
        taken = holds[guard] & (delta[index[source]] < 0)
        delta[index[source], taken] = index[target]
        reward[index[source], taken] = pays
    labels = [str(q) for q in states]
    if (delta < 0).any():
        delta = np.vstack([np.where(delta < 0, count, delta), np.full(width, count)])
        reward = np.vstack([reward, np.zeros(width)])
        final, labels = np.append(final, True), [*labels, "ended"]
    automaton = make_automaton(
        delta, index[initial], alphabet, names, final=final, acceptance="cosafe", state_names=labels
    )
    return RewardMachine(automaton, reward)


def machine_reward(product: Model, reward: ArrayLike | jax.Array) -> Array:
    """Expected reward of a reward machine in a product model.

    With ``label_on="entry"`` a step from (s, q) reads the label of the successor,
    ``R(s, q, a) = sum_t P(t | s, a) reward[q, L(t)]``; with ``"exit"`` the label of s,
    ``R(s, q, a) = reward[q, L(s)]``. The letter that an entry product reads in its initial state
    earns no step reward; a machine that does not read it starts in ``(s, automaton.initial)``.

    Args:
      product: of a world or a game with the machine's automaton.
      reward: ``float[Q, L]``, such as of :func:`read_reward_machine`.

    Returns:
      ``float[S, Q, A]``, zero at unavailable actions, differentiable in the reward and the world's
      probabilities; for a product over a SparseMDP ``float64[R]``, per choice of its sparse form.

    Raises:
      ValueError: the reward has another shape, or the model is not a product.

    Example:
      >>> machine = read_reward_machine('''0
      ... [1]
      ... (0, 1, 'goal', ConstantRewardFunction(1))
      ... (0, 0, '!goal', ConstantRewardFunction(0))''')
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0.5, 0.5]], [[0, 1.0]]], label=[[0], [1]], propositions=["goal"])
      >>> machine_reward(product(world, machine.automaton), machine.reward)[0, :, 0].tolist()
      [0.5, 0.0]
    """
    model = product.mdp if isinstance(product, Game) else product
    if not isinstance(model, Product):
        raise ValueError(
            f"{type(model).__name__} is no product; give product(world, machine.automaton)."
        )
    shape = np.shape(model.automaton.delta)
    if np.shape(reward) != shape:
        raise ValueError(f"reward has shape {np.shape(reward)}; expected {shape}, a number for "
                         "each state and letter of the automaton.")  # fmt: skip
    if not isinstance(model.mdp, SparseMDP):
        return read_probability(model, jnp.asarray(reward))
    host = to_sparse(model).host
    pays, letter = np.asarray(reward, np.float64), np.asarray(model.letter)
    state, memory = np.divmod(host.state, model.num_memory)
    if model.label_on == "exit":
        return pays[memory, letter[state]]
    earned = host.probability * pays[memory[host.row], letter[host.successor // model.num_memory]]
    return np.add.reduceat(earned, host.entry_start[:-1])
