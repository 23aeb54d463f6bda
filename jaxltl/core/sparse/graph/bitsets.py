"""Qualitative reachability in large products: a bit set of memory states for each world state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Integers

LARGEST = 64  # number of memory states of a word
Part = slice | Integers  # of the states
_BLOCK = 2**15  # states of a block
_SWEEPS = 400  # maximal number of sweeps of a search

Words = NDArray[np.unsignedinteger[Any]]


@dataclass(frozen=True)
class BitGraph:
    """The graph of a product that reads labels of states that are entered."""

    columns: list[list[Integers]]  # for each action and successor int[S]; S in padding
    permitted: list[Words]  # for each action word[S], the memory states in which it is available
    after: list[Words]  # per byte word[L * 256], the predecessors of its memory states by letter
    letter: Integers  # int64[S], 256 times the letter of each state
    full: Words  # the word of all memory states

    @property
    def num_states(self) -> int:
        return self.letter.size

    @property
    def nothing(self) -> Words:
        """The empty set."""
        return np.zeros(self.num_states, self.permitted[0].dtype)

    def read(self, words: Words, part: Part) -> Words:
        """The memory states in which entering a state of a block leads to a pair of a set."""
        letter = self.letter[part]
        memory: Words = self.after[0][letter + (words & 255).astype(np.int64)]
        for i, table in enumerate(self.after[1:], 1):
            memory |= table[letter + (words >> (8 * i) & 255).astype(np.int64)]
        return memory

    def seen(self, words: Words) -> Words:
        """The same for all states, and the empty word for padding."""
        memory = np.zeros(self.num_states + 1, words.dtype)
        memory[:-1] = self.read(words, slice(None))
        return memory

    def hits(self, action: int, seen: Words, part: Part) -> Words:
        """The memory states in which an action may lead to a set, for some states."""
        first, *others = self.columns[action]
        memory = seen[first[part]]
        for column in others:
            memory |= seen[column[part]]
        return memory

    def grow(
        self,
        goal: Words,
        among: Words,
        *,
        forced: bool,
        kept: list[Words] | None = None,
        action: Integers | None = None,
    ) -> Words | None:
        """The attractor ``word[S]`` of a goal; None if it takes too many sweeps."""
        region, kept = goal.copy(), self.permitted if kept is None else kept
        seen = self.seen(region)
        for _ in range(_SWEEPS):
            grown = False
            for a in range(0, self.num_states, _BLOCK):
                block = slice(a, min(a + _BLOCK, self.num_states))
                open_ = among[block] & ~region[block]
                part: Part = block
                if np.count_nonzero(open_) * 2 < open_.size:
                    part = np.flatnonzero(open_)
                    if not part.size:
                        continue
                    open_, part = open_[part], part + a
                new = self._joining(open_, part, seen, forced, kept, action)
                if new.any():
                    region[part] |= new
                    seen[part] = self.read(region[part], part)
                    grown = True
            if not grown:
                return region
        return None

    def _joining(
        self,
        open_: Words,
        part: Part,
        seen: Words,
        forced: bool,
        kept: list[Words],
        action: Integers | None,
    ) -> Words:
        joining = open_.copy() if forced else np.zeros_like(open_)
        for a in range(len(self.columns)):
            hit = self.hits(a, seen, part)
            if forced:
                joining &= hit | ~kept[a][part]
                continue
            hit &= kept[a][part] & open_
            if action is not None:
                _note(action, part, hit & ~joining, a)
            joining |= hit
        return joining

    def only(self, words: Words) -> list[Words]:
        """For each action the pairs in which it is permitted and all successors are in a set."""
        seen = self.seen(self.full & ~words)
        return [x & ~self.hits(a, seen, slice(None)) for a, x in enumerate(self.permitted)]


def _note(action: Integers, part: Part, words: Words, number: int) -> None:
    """Writes a number at the pairs of a set."""
    state = np.flatnonzero(words)
    if not state.size:
        return
    where = np.arange(action.shape[0])[part][state] if isinstance(part, slice) else part[state]
    for q in range(action.shape[1]):
        action[where[(words[state] >> q & 1).astype(bool)], q] = number


def _first(action: Integers, words: Words, kept: list[Words]) -> None:
    """Writes the first action that counts, into an array of zeros."""
    remaining = words & ~kept[0]
    for a in range(1, len(kept)):
        _note(action, slice(None), remaining & kept[a], a)
        remaining &= ~kept[a]


def pack(mask: Booleans) -> Words:
    """Words of bits, the q-th of which is ``mask[..., q]``."""
    size = mask.shape[-1]
    kind: type[np.unsignedinteger] = next(
        k for k in (np.uint8, np.uint16, np.uint32, np.uint64) if np.iinfo(k).bits >= size
    )
    words = np.zeros(mask.shape[:-1], kind)
    for q in range(size):
        words |= mask[..., q].astype(kind) << kind(q)
    return words


def bit_graph(
    successor: Integers,
    used: Booleans,
    available: Booleans,
    delta: Integers,
    letter: Integers,
    allowed: Booleans | None = None,
) -> BitGraph:
    """The graph of a padded world (`used` is ``bool[S, A, K]``) and at most 64 automaton states."""
    num_states, num_actions, width = successor.shape
    num_memory = delta.shape[0]
    every = used.all()
    columns = [
        [
            np.ascontiguousarray(successor[:, a, k])
            if every
            else np.where(used[:, a, k], successor[:, a, k], num_states)
            for k in range(width)
        ]
        for a in range(num_actions)
    ]
    full = pack(np.ones(num_memory, bool))
    permitted = [
        np.where(available[:, a], full if allowed is None else pack(allowed[:, :, a]), 0).astype(
            full.dtype
        )
        for a in range(num_actions)
    ]
    after = []
    byte = np.arange(256)
    for first in range(0, num_memory, 8):
        place = delta - first  # [Q, L]
        inside = (place >= 0) & (place < 8)
        leads = inside[None] & (byte[:, None, None] >> np.clip(place, 0, 7) & 1).astype(bool)
        after.append(pack(leads.transpose(2, 0, 1)).ravel())
    return BitGraph(columns, permitted, after, letter.astype(np.int64) * 256, full)


class BitSets(NamedTuple):
    """Prob0 and prob1 states of an optimum."""

    one: Words  # word[S], probability 1
    zero: Words  # word[S], probability 0
    stays: Words  # word[S], the other pairs that can be kept for ever
    action: Integers  # int32[S, Q], a policy that attains 0 and 1


def decided(graph: BitGraph, target: Words, num_memory: int, *, maximize: bool) -> BitSets | None:
    """Prob0 and prob1 states of a reachability optimum; None if the graph is too deep."""
    everything = graph.full | graph.nothing
    action = np.zeros((graph.num_states, num_memory), np.int32)
    before = everything & ~target
    _first(action, everything, graph.permitted)
    sets = (_largest if maximize else _smallest)(graph, target, before, action)
    if sets is None:
        return None
    one, zero = sets
    undecided = everything & ~(one | zero)
    out = graph.grow(everything & ~undecided, undecided, forced=True) if maximize else everything
    return None if out is None else BitSets(one, zero, everything & ~out, action)


def _largest(
    graph: BitGraph, target: Words, before: Words, action: Integers
) -> tuple[Words, Words] | None:
    some = graph.grow(target, before, forced=False)
    if some is None:
        return None
    everything = graph.full | graph.nothing
    outside = everything & ~some
    while True:
        # First the pairs that are forced out, then those that cannot reach the target inside.
        grown = graph.grow(outside, before, forced=True)
        if grown is None:
            return None
        kept = graph.only(everything & ~grown)
        among = before & ~grown
        reached = graph.grow(target, among, forced=False, kept=kept) if among.any() else target
        if reached is None:
            return None
        if (reached == everything & ~grown).all():
            break
        outside = everything & ~reached
    if among.any():
        graph.grow(target, among, forced=False, kept=kept, action=action)
    return reached, everything & ~some


def _smallest(
    graph: BitGraph, target: Words, before: Words, action: Integers
) -> tuple[Words, Words] | None:
    everything = graph.full | graph.nothing
    grown = graph.grow(target, before, forced=True)
    if grown is None:
        return None
    zero = everything & ~grown
    doomed = graph.grow(zero, before, forced=False)
    if doomed is None:
        return None
    kept = graph.only(zero)
    _first(action, zero, kept)
    return everything & ~doomed, zero
