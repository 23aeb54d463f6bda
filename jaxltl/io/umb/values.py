"""Encoding and decoding of UMB values: bits, numbers, strings and state variables."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.validation import errors_in
from jaxltl.io.umb.index import Record, Type, RecordVariable, bit_bytes

Bytes = NDArray[np.uint8]
Values = NDArray[np.generic]  # of a state variable: bool, integers, doubles or strings

_EXACT = 2**53  # integers up to this are exact doubles
_MAX_TEXT = 2**30  # bytes of the strings of one variable


def read_bits(content: Bytes, count: int) -> NDArray[np.bool_]:
    """The first `count` bits, least significant first."""
    return np.unpackbits(content, count=count, bitorder="little").view(bool)


def write_bits(bits: NDArray[np.bool_]) -> Bytes:
    """Bit vector padded to 64-bit words."""
    content = np.zeros(bit_bytes(bits.size), np.uint8)
    packed = np.packbits(bits, bitorder="little")
    content[: packed.size] = packed
    return content


def read_starts(content: Bytes, total: int) -> NDArray[np.int64]:
    """Offsets ``int64[n + 1]``, checked to ascend from 0 to `total`."""
    start = content.view("<u8")
    if start[0] != 0 or start[-1] != total:
        raise ValueError(f"it goes from {start[0]} to {start[-1]}; expected from 0 to {total}.")
    if (start[1:] < start[:-1]).any():
        i = int(np.flatnonzero(start[1:] < start[:-1])[0])
        raise ValueError(
            f"it falls from {start[i]} to {start[i + 1]} at {i + 1}; expected numbers that ascend."
        )
    return start.view("<i8").astype(np.int64, copy=False)


def read_numbers(content: Bytes, kind: Type) -> NDArray[np.float64]:
    """Numbers as doubles; rationals are rounded to nearest."""
    if kind.name == "rational":
        return _read_rationals(content.reshape(-1, kind.size // 8))
    code = {"double": "<f8", "int": "<i8", "uint": "<u8"}[kind.name]
    return content.view(code).astype(np.float64, copy=False)


def read_ends(content: Bytes, kind: Type) -> NDArray[np.float64]:
    """Interval bounds ``float64[n, 2]``; numbers become point intervals."""
    if kind.end is None:
        numbers = read_numbers(content, kind)
        return np.stack([numbers, numbers], 1)
    return read_numbers(content, kind.end).reshape(-1, 2)


def read_points(content: Bytes, kind: Type, *, first: int = 0) -> NDArray[np.float64]:
    """Numbers or point intervals as doubles; `first` is the first index, for messages."""
    if kind.end is None:
        return read_numbers(content, kind)
    ends = read_ends(content, kind)
    wrong = ~(ends[:, 0] == ends[:, 1])
    if wrong.any():
        i = int(wrong.argmax())
        raise ValueError(
            f"number {first + i} is the interval [{ends[i, 0]:.9g}, {ends[i, 1]:.9g}]; "
            "single numbers, or intervals of one point, are read."
        )
    return ends[:, 0].copy()


def _read_rationals(content: Bytes) -> NDArray[np.float64]:
    """Rationals (numerator and denominator, half a record each) as doubles."""
    half = content.shape[1] // 2
    doubles = np.zeros(len(content))
    hard = np.ones(len(content), bool)
    if half == 8:
        pairs = np.ascontiguousarray(content).view("<i8")
        above, below = pairs[:, 0], pairs[:, 1]
        # The quotient of two exact doubles is rounded once; denominators are unsigned.
        hard = (above < -_EXACT) | (above > _EXACT) | (below <= 0) | (below > _EXACT)
        np.divide(above, below, out=doubles, where=~hard)
    if hard.any():
        records, which = np.unique(content[hard], axis=0, return_inverse=True)
        values = np.array([_quotient(record.tobytes(), half) for record in records])
        doubles[hard] = values[which.ravel()]
    return doubles


def _quotient(record: bytes, half: int) -> float:
    above = int.from_bytes(record[:half], "little", signed=True)
    below = int.from_bytes(record[half:], "little")
    try:
        return above / below
    except ZeroDivisionError:
        raise ValueError("a rational has the denominator 0.") from None
    except OverflowError:
        raise ValueError("a rational is beyond the largest double.") from None


def read_texts(start: NDArray[np.int64], content: Bytes) -> tuple[str, ...]:
    """Strings between the offsets."""
    data = content.tobytes()
    try:
        return tuple(data[i:j].decode() for i, j in itertools.pairwise(start.tolist()))
    except UnicodeDecodeError as error:
        raise ValueError(f"a text is not UTF-8: {error}.") from None


# --- variables of states --------------------------------------------------------------------


def read_variables(
    content: Bytes,
    of_class: NDArray[np.uint32] | None,
    records: Sequence[Record],
    count: int,
    texts: Sequence[str],
) -> dict[str, Values]:
    """State variables by name, ``[S]`` each; absent values are NaN (as doubles) or empty strings.

    Integers become int32, int64 or uint64, and are dropped beyond 64 bits. Strings over 1 GB in
    total are objects.
    """
    if of_class is None:
        of_class = np.zeros(count, np.uint32)
    if of_class.max() >= len(records):
        raise ValueError(f"a state is of class {of_class.max()}; there are {len(records)}.")
    end = np.array([record.size for record in records])[of_class].cumsum()
    if end[-1] != content.size:
        raise ValueError(
            f"it has {content.size} bytes; expected {end[-1]}, the records of the {count} states."
        )
    parts: dict[str, list[_Part]] = {}
    for i, record in enumerate(records):
        chosen = np.arange(count) if len(records) == 1 else np.flatnonzero(of_class == i)
        if record.size == 0 or chosen.size == 0:
            continue
        if chosen.size == count:
            raw = content.reshape(count, record.size)
        else:
            raw = content[(end[chosen] - record.size)[:, None] + np.arange(record.size)]
        for variable in record.variables:
            with errors_in(f"the variable {variable.name!r} "):
                values = _read_variable(raw, variable, texts)
            if values is None:
                continue
            there = np.ones(len(raw), bool)
            if variable.presence is not None:
                there = _field(raw, variable.presence, 1)[:, 0] > 0
            parts.setdefault(variable.name, []).append((chosen[there], values[there]))
    joined = {}
    for name, part in parts.items():
        with errors_in(f"the variable {name!r} "):
            joined[name] = _joined(part, count)
    return joined


_Part = tuple[NDArray[np.intp], Values]  # some states, and the values there


def _read_variable(raw: Bytes, variable: RecordVariable, texts: Sequence[str]) -> Values | None:
    """Value of a variable in each record, or None if it is unsupported."""
    kind = variable.type
    if kind.name.endswith("-interval"):
        raise ValueError(f"is {kind.name}; expected single values.")
    if kind.name in ("int", "uint") and kind.size > 64:
        return None
    field = _field(raw, variable.start, kind.size)
    if kind.name == "bool":
        return np.asarray(field.any(axis=1))
    if kind.name == "double":
        return np.ascontiguousarray(field).view("<f8")[:, 0].astype(np.float64, copy=False)
    if kind.name == "string":
        return _texts(np.ascontiguousarray(field).view("<u8")[:, 0], texts)
    if kind.name != "rational":
        values = _whole_numbers(field, variable)
        return _texts(values, texts) if variable.is_text else values
    if kind.size % 16:
        raise ValueError(f"is a rational of {kind.size} bits; expected whole bytes.")
    values = np.full(len(raw), np.nan)
    there = np.ones(len(raw), bool)
    if variable.presence is not None:  # absent values may have denominator 0
        there = _field(raw, variable.presence, 1)[:, 0] > 0
    values[there] = _read_rationals(field[there])
    return values


def _texts(number: Values, texts: Sequence[str]) -> Values:
    used, which = np.unique(number, return_inverse=True)
    if used[0] < 0 or used[-1] >= len(texts):
        raise ValueError(f"has the text {used[-1]}; there are {len(texts)}.")
    chosen = [texts[i] for i in used.tolist()]
    # NumPy pads every string to the longest one.
    dtype = object if 4 * number.size * max(map(len, chosen)) > _MAX_TEXT else str
    return np.array(chosen, dtype)[which.ravel()]


def _field(raw: Bytes, start: int, size: int) -> Bytes:
    """Bit field of every record as little-endian bytes, zero-padded."""
    first, shift, width = start // 8, start % 8, -(-size // 8)
    field = raw[:, first : first + width]
    if shift:
        field = field >> np.uint8(shift)
        above = raw[:, first + 1 : first + 1 + width] << np.uint8(8 - shift)
        field[:, : above.shape[1]] |= above
    if size % 8:
        field = field.copy() if not shift else field
        field[:, -1] &= np.uint8(2 ** (size % 8) - 1)
    return field


def _whole_numbers(field: Bytes, variable: RecordVariable) -> Values:
    """Integers with offset, in the smallest of int32, int64 and uint64 that fits the type."""
    size, offset, signed = variable.type.size, variable.offset, variable.type.name == "int"
    wide = np.zeros((len(field), 8), np.uint8)
    wide[:, : field.shape[1]] = field
    bits = wide.view("<u8")[:, 0].astype(np.uint64, copy=False)
    if signed and size < 64:  # sign extension
        sign = np.uint64(1) << np.uint64(size - 1)
        bits = (bits ^ sign) - sign
    smallest, largest = (-(2 ** (size - 1)), 2 ** (size - 1) - 1) if signed else (0, 2**size - 1)
    if not -(2**63) <= smallest + offset <= largest + offset < 2**64 or (
        smallest + offset < 0 and largest + offset >= 2**63
    ):
        # The type exceeds 64 bits; the values may fit.
        seen = bits.view(np.int64) if signed else bits
        smallest, largest = int(seen.min(initial=0)), int(seen.max(initial=0))
    smallest, largest = smallest + offset, largest + offset
    # Sums modulo 2^64 are exact if the results fit.
    total = bits + np.uint64(offset % 2**64)
    if smallest >= -(2**31) and largest < 2**31:
        return total.view(np.int64).astype(np.int32)
    if smallest >= -(2**63) and largest < 2**63:
        return total.view(np.int64)
    if smallest >= 0 and largest < 2**64:
        return total
    raise ValueError(f"goes from {smallest} to {largest}; expected numbers of 64 bits.")


def _joined(parts: Sequence[_Part], count: int) -> Values:
    """Values of a variable, merged over all classes of states."""
    if len(parts) == 1 and parts[0][0].size == count:
        return parts[0][1]
    texts = {values.dtype.kind in "UO" for _, values in parts}
    if len(texts) > 1:
        raise ValueError("is a text in some states only; expected one type.")
    dtype = np.result_type(*(values.dtype for _, values in parts))
    joined: Values = np.full(count, "" if True in texts else 0, dtype)
    if sum(states.size for states, _ in parts) < count and True not in texts:
        joined = np.full(count, np.nan)
    for states, values in parts:
        joined[states] = values
    return joined


@dataclass(frozen=True)
class EncodedVariables:
    """Encoded state variables."""

    variables: list[dict[str, object]]  # their descriptions in the index
    records: Bytes  # records of all states
    texts: list[str]  # strings by index
    named: list[str]  # names of the variables that hold strings


def write_variables(valuation: Mapping[str, ArrayLike]) -> EncodedVariables:
    """Encodes state variables; each starts at a byte boundary of the record."""
    described: list[dict[str, object]] = []
    fields: list[Values] = []
    texts: list[str] = []
    named: list[str] = []
    for name, values in valuation.items():
        values = np.asarray(values)
        kind = {"b": "bool", "i": "int", "u": "uint", "f": "double", "U": "string"}.get(
            values.dtype.kind
        )
        if values.dtype.kind == "O" and all(isinstance(x, str) for x in values):
            kind = "string"
        if kind is None or (kind != "string" and values.dtype.itemsize > 8):
            raise ValueError(
                f"the variable {name!r} holds {values.dtype}; UMB files hold "
                "truth values, numbers of up to 64 bits and texts."
            )
        if kind == "double":
            values = values.astype(np.float64)
        if kind == "string":
            different, number = np.unique(values, return_inverse=True)
            values = number.ravel().astype(np.uint64) + np.uint64(len(texts))
            texts += map(str, different)
            named.append(name)
            kind = "uint"  # as Storm refuses files that have the type string
        size = 1 if kind == "bool" else 8 * values.dtype.itemsize
        described.append({"name": name, "type": {"type": kind, "size": size}})
        if kind == "bool":
            described.append({"padding": 7})
        fields.append(values.astype(values.dtype.newbyteorder("<")))
    layout = np.dtype([(f"v{i}", field.dtype) for i, field in enumerate(fields)])
    records = np.zeros(fields[0].size, layout)
    for i, field in enumerate(fields):
        records[f"v{i}"] = field
    return EncodedVariables(described, records.view(np.uint8), texts, named)


def write_texts(texts: Sequence[str]) -> tuple[Bytes, bytes]:
    """Offsets and UTF-8 bytes of strings."""
    try:
        encoded = [text.encode() for text in texts]
    except UnicodeEncodeError as error:
        raise ValueError(f"a text is no Unicode: {error}.") from None
    return np.cumsum([0, *map(len, encoded)], dtype="<u8").view(np.uint8), b"".join(encoded)
