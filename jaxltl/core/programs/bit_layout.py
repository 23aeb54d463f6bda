"""States of a program as unsigned 64-bit words, with a field of bits for each variable."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.language.syntax import Variable

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
        raw = (words[field.word] & np.uint64(field.mask)) >> np.uint64(field.shift)
        if field.variable.type == "bool":
            return np.asarray(raw != 0)
        return raw.astype(np.int64) + field.variable.low

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


class Reader:
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
