"""States of a program as unsigned 64-bit words, with a field of bits for each variable."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.language.expressions import LanguageError, compile_expressions, conjuncts, names_in
from jaxltl.core.language.syntax import Program, Variable


Words = tuple[NDArray[np.uint64], ...]  # uint64[N] each
_BITS = 64


@dataclass(frozen=True)
class Field:
    """Place of a variable: ``value - low`` is in some bits of a word."""

    variable: Variable
    word: int
    shift: int

    @property
    def mask(self) -> int:
        """The bits of the word."""
        return ((1 << self.variable.bits) - 1) << self.shift


@dataclass(frozen=True)
class Layout:
    """Fields of the variables, none of which lies in two words; :func:`make_layout`."""

    fields: dict[str, Field]
    num_words: int

    def values(self, words: Words, name: str) -> NDArray[Any]:
        """Values of a variable: ``int64[N]``, or ``bool[N]``."""
        field = self.fields[name]
        raw = words[field.word] & np.uint64(field.mask)
        if field.variable.type == "bool":
            return np.asarray(raw != 0)
        raw >>= np.uint64(field.shift)  # in place, as is what follows
        number = raw.view(np.int64)
        number += field.variable.low
        return number

    def masks(self, names: Iterable[str]) -> tuple[int, ...]:
        """The bits of some variables in each word."""
        masks = [0] * self.num_words
        for name in names:
            field = self.fields[name]
            masks[field.word] |= field.mask
        return tuple(masks)

    def packed(self, columns: dict[str, Integers], size: int) -> Words:
        """Words of N states from the values of all variables."""
        words = [np.zeros(size, np.uint64) for _ in range(self.num_words)]
        for name, field in self.fields.items():
            raw = np.asarray(columns[name], np.int64) - field.variable.low
            words[field.word] |= raw.astype(np.uint64) << np.uint64(field.shift)
        return tuple(words)


class StateReader:
    """Values of variables in some states, unpacked on first use."""

    def __init__(self, layout: Layout, words: Words) -> None:
        self.layout, self.words = layout, words
        self.known: dict[str, NDArray[Any]] = {}

    def __call__(self, name: str) -> NDArray[Any]:
        if name not in self.known:
            self.known[name] = self.layout.values(self.words, name)
        return self.known[name]


def make_layout(variables: Sequence[Variable]) -> Layout:
    """Fields in the order of the variables, in as many words as they need."""
    fields: dict[str, Field] = {}
    word = shift = 0
    for v in variables:
        if shift + v.bits > _BITS:
            word, shift = word + 1, 0
        fields[v.name] = Field(v, word, shift if v.bits else 0)
        shift += v.bits
    return Layout(fields, word + 1)


# Odd multipliers of multiplicative hashing (Fibonacci hashing and splitmix64).
_FACTORS = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0xD6E8FEB86659FD93)
_FIRST = 2**12  # slots of an empty table
_PART = 2**16  # keys that are inserted at once; fits the cache of a core


class HashTable:
    """Keys of W words, numbered from 0; open addressing with linear probing.

    Example:
      >>> table = HashTable(1)
      >>> first, other, same = table.insert((np.array([7, 9, 7], np.uint64),)).tolist()
      >>> first == same, first == other, len(table)
      (True, False, 2)
    """

    def __init__(self, num_words: int) -> None:
        self.size = 0
        self.keys = [np.zeros(_FIRST // 2, np.uint64) for _ in range(num_words)]
        self.slots = np.full(_FIRST, -1, np.int32)

    def __len__(self) -> int:
        return self.size

    def words(self, start: int, stop: int) -> Words:
        """Words of the keys with numbers from `start` to `stop` - 1."""
        return tuple(k[start:stop] for k in self.keys)

    def insert(self, words: Words) -> NDArray[np.int32]:
        """Numbers ``int32[N]`` of keys; new ones are added."""
        count = words[0].size
        numbers = np.empty(count, np.int32)
        for begin in range(0, count, _PART):
            part = slice(begin, begin + _PART)
            self._grow(self.size + min(_PART, count - begin))
            numbers[part] = self._insert(tuple(w[part] for w in words))
        return numbers

    def fill(self, words: Words) -> None:
        """Numbers distinct keys in their order, in an empty table."""
        self._grow(words[0].size)
        for key, w in zip(self.keys, words, strict=True):
            key[: w.size] = w
        self.size = words[0].size
        self._place_all()

    def _hash(self, words: Words) -> NDArray[np.int64]:
        mixed = words[0] * np.uint64(_FACTORS[0])
        for i, w in enumerate(words[1:], 1):
            mixed ^= mixed >> np.uint64(29)
            mixed += w
            mixed *= np.uint64(_FACTORS[i % len(_FACTORS)])
        mixed ^= mixed >> np.uint64(32)
        mixed *= np.uint64(_FACTORS[2])
        bits = self.slots.size.bit_length() - 1
        return (mixed >> np.uint64(64 - bits)).astype(np.int64)

    def _insert(self, words: Words) -> NDArray[np.int32]:
        place = self._hash(words)
        result = np.empty(place.size, np.int32)
        todo = np.arange(place.size)
        slots, last = self.slots, self.slots.size - 1
        while todo.size:
            holder = slots[place]
            free = (holder < 0).nonzero()[0]
            if free.size:
                # Several keys may claim one slot: the last one that is written has it.
                claim = todo[free]
                slots[place[free]] = -2 - claim
                won = free[slots[place[free]] == -2 - claim]
                fresh = np.arange(self.size, self.size + won.size, dtype=np.int32)
                slots[place[won]] = fresh
                for key, w in zip(self.keys, words, strict=True):
                    key[self.size : self.size + won.size] = w[todo[won]]
                self.size += won.size
                holder = slots[place]
            same = self.keys[0][holder] == words[0][todo]
            for key, w in zip(self.keys[1:], words[1:], strict=True):
                same &= key[holder] == w[todo]
            result[todo[same]] = holder[same]
            rest = (~same).nonzero()[0]
            todo = todo[rest]
            place = (place[rest] + 1) & last
        return result

    def _grow(self, size: int) -> None:
        """Room for keys at a load of at most one half."""
        if 2 * size <= self.slots.size:
            return
        capacity = 1 << (4 * size - 1).bit_length()
        room = np.zeros(capacity // 2 - self.size, np.uint64)
        self.keys = [np.concatenate([k[: self.size], room]) for k in self.keys]
        self.slots = np.full(capacity, -1, np.int32)
        self._place_all()

    def _place_all(self) -> None:
        place = self._hash(self.words(0, self.size))
        number = np.arange(self.size, dtype=np.int32)
        while number.size:
            free = self.slots[place] < 0
            self.slots[place[free]] = number[free]
            rest = (self.slots[place] != number).nonzero()[0]
            number, place = number[rest], (place[rest] + 1) & (self.slots.size - 1)


_CANDIDATES = 2**24  # partial assignments that are held at once


def initial_columns(program: Program, max_states: int) -> tuple[dict[str, Integers], int]:
    """Values of the variables in the initial states, and the number of these.

    There is one, or those that satisfy the ``init`` block: variables are assigned one after the
    other, and each conjunct of the condition is evaluated as soon as its variables are. Raises
    LanguageError if no state satisfies the condition, or too many do.
    """
    if program.initial is None:
        return {v.name: np.array([v.initial]) for v in program.variables}, 1
    todo = [(names_in(e), compile_expressions([e])) for e in conjuncts(program.initial)]
    variables = {v.name: v for v in program.variables}
    width_of = {v.name: v.high - v.low + 1 for v in program.variables}
    columns: dict[str, Integers] = {}
    size = int(all(condition({})[0] for names, condition in todo if not names))
    todo = [p for p in todo if p[0]]
    limit = min(_CANDIDATES, max(max_states, 2**16))
    while len(columns) < len(variables):
        # Next are the variables of the conjunct that needs the fewest combinations.
        needs = [sorted(names - columns.keys()) for names, _ in todo]
        rest = [n for n in variables if n not in columns]
        chosen = min(needs, key=lambda some: math.prod(width_of[n] for n in some), default=rest)
        for name in chosen:
            v, width = variables[name], width_of[name]
            if size * width > limit:
                raise LanguageError(
                    program.initial.place,
                    f"the init block has more than {limit} candidates; restrict the variables "
                    "one by one, as in x=0 & y<=3, or give a larger max_states.",
                )
            columns = {n: x.repeat(width) for n, x in columns.items()}
            columns[name] = np.tile(np.arange(v.low, v.high + 1), size)
            size *= width
        ready = [condition for names, condition in todo if names <= columns.keys()]
        todo = [p for p in todo if not p[0] <= columns.keys()]
        for condition in ready:
            typed = {n: x != 0 if variables[n].type == "bool" else x for n, x in columns.items()}
            holds = np.flatnonzero(np.broadcast_to(condition(typed)[0], (size,)))
            columns = {n: x[holds] for n, x in columns.items()}
            size = holds.size
    if not size:
        raise LanguageError(program.initial.place, "no state satisfies the init block.")
    return columns, size
