"""Vectorised hash table: consecutive numbers of distinct keys."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.programs.bit_layout import Words

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
