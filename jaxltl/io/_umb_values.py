"""The values in a UMB file's members: bits, numbers, texts and the variables of states."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.io._umb_index import Record, Type, Variable, bit_bytes

Bytes = NDArray[np.uint8]

_EXACT = 2**53  # whole numbers up to this are doubles


def read_bits(content: Bytes, count: int) -> NDArray[np.bool_]:
    """The first `count` bits, the least significant first."""
    return np.unpackbits(content, count=count, bitorder="little").view(bool)


def write_bits(bits: NDArray[np.bool_]) -> Bytes:
    """Bits in words of 64."""
    content = np.zeros(bit_bytes(bits.size), np.uint8)
    packed = np.packbits(bits, bitorder="little")
    content[: packed.size] = packed
    return content


def read_starts(content: Bytes, total: int, place: str) -> NDArray[np.int64]:
    """Where spans start, ``int64[n + 1]``, from 0 to `total`.

    Raises:
      ValueError: they start or end elsewhere, or fall.
    """
    start = content.view("<u8")
    if start[0] != 0 or start[-1] != total:
        raise ValueError(
            f"{place}it goes from {start[0]} to {start[-1]}; expected from 0 to {total}."
        )
    if (start[1:] < start[:-1]).any():
        i = int(np.flatnonzero(start[1:] < start[:-1])[0])
        raise ValueError(
            f"{place}it falls from {start[i]} to {start[i + 1]} at {i + 1}; expected "
            "numbers that ascend."
        )
    return start.view("<i8").astype(np.int64, copy=False)


def read_numbers(content: Bytes, kind: Type, place: str) -> NDArray[np.float64]:
    """Numbers of a type as doubles; rationals are rounded to the nearest.

    Raises:
      ValueError: a denominator is 0, or a number is beyond the doubles.
    """
    if kind.name == "rational":
        return _read_rationals(content.reshape(-1, kind.size // 8), place)
    code = {"double": "<f8", "int": "<i8", "uint": "<u8"}[kind.name]
    return content.view(code).astype(np.float64, copy=False)


def _read_rationals(content: Bytes, place: str) -> NDArray[np.float64]:
    """Numerators and denominators, half of each record, as doubles."""
    half = content.shape[1] // 2
    found = np.zeros(len(content))
    hard = np.ones(len(content), bool)
    if half == 8:
        pairs = np.ascontiguousarray(content).view("<i8")
        above, below = pairs[:, 0], pairs[:, 1]
        # A quotient of two doubles is rounded once; a denominator with its first bit set is large.
        hard = (above < -_EXACT) | (above > _EXACT) | (below <= 0) | (below > _EXACT)
        np.divide(above, below, out=found, where=~hard)
    if hard.any():
        records, which = np.unique(content[hard], axis=0, return_inverse=True)
        values = np.array([_quotient(record.tobytes(), half, place) for record in records])
        found[hard] = values[which.ravel()]
    return found


def _quotient(record: bytes, half: int, place: str) -> float:
    above = int.from_bytes(record[:half], "little", signed=True)
    below = int.from_bytes(record[half:], "little")
    try:
        return above / below
    except ZeroDivisionError:
        raise ValueError(f"{place}a rational has the denominator 0.") from None
    except OverflowError:
        raise ValueError(f"{place}a rational is beyond the largest double.") from None


def read_texts(start: NDArray[np.int64], content: Bytes, place: str) -> tuple[str, ...]:
    """The texts that lie between the starts.

    Raises:
      ValueError: one is not UTF-8.
    """
    data = content.tobytes()
    try:
        return tuple(data[i:j].decode() for i, j in itertools.pairwise(start.tolist()))
    except UnicodeDecodeError as error:
        raise ValueError(f"{place}a text is not UTF-8: {error}.") from None


# --- variables of states --------------------------------------------------------------------


def read_variables(
    content: Bytes,
    of_class: NDArray[np.uint32] | None,
    records: Sequence[Record],
    count: int,
    place: str,
) -> dict[str, NDArray[Any]]:
    """The variables of states, ``[S]`` each, by name.

    Whole numbers are int32 or, where the type is larger, int64 (or uint64); what is absent in
    some state is a double, NaN there. Texts, and whole numbers of more than 64 bits, are left out.

    Args:
      content: the records of the states, one after the other.
      of_class: which record a state has; None: all the first.
      records: the classes.
      count: the number of states.
      place: what an error begins with.

    Raises:
      ValueError: the content has another size than the records, a class does not exist, or a
        variable has a type of intervals, two kinds of types or values beyond 64 bits.
    """
    if of_class is None:
        of_class = np.zeros(count, np.uint32)
    if of_class.max() >= len(records):
        raise ValueError(f"{place}a state is of class {of_class.max()}; there are {len(records)}.")
    end = np.array([record.size for record in records])[of_class].cumsum()
    if end[-1] != content.size:
        raise ValueError(
            f"{place}it has {content.size} bytes; expected {end[-1]}, the records of "
            f"the {count} states."
        )
    states: list[NDArray[Any] | slice] = [slice(None)]
    if len(records) > 1:
        states = [np.flatnonzero(of_class == i) for i in range(len(records))]
    parts: dict[str, list[tuple[Any, NDArray[Any], NDArray[np.bool_] | None]]] = {}
    for record, chosen in zip(records, states, strict=False):
        if record.size == 0:
            continue
        if isinstance(chosen, slice):
            raw = content.reshape(count, record.size)
        else:
            first = end[chosen] - record.size
            raw = content[first[:, None] + np.arange(record.size)]
        for variable in record.variables:
            values = _read_variable(raw, variable, place)
            if values is not None:
                parts.setdefault(variable.name, []).append((chosen, *values))
    return {name: _joined(part, count) for name, part in parts.items()}


def _read_variable(
    raw: Bytes, variable: Variable, place: str
) -> tuple[NDArray[Any], NDArray[np.bool_] | None] | None:
    """A variable's values and where they are present (None: everywhere), or None if left out."""
    kind, what = variable.type, f"{place}the variable {variable.name!r} "
    if kind.name.endswith("-interval"):
        raise ValueError(f"{what}is {kind.name}; expected single values.")
    if kind.name == "string" or (kind.name in ("int", "uint") and kind.size > 64):
        return None
    field = _field(raw, variable.start, kind.size)
    values: Any
    if kind.name == "bool":
        values = np.any(field, axis=1)
    elif kind.name == "double":
        values = np.ascontiguousarray(field).view("<f8")[:, 0].astype(np.float64, copy=False)
    elif kind.name == "rational":
        if kind.size % 16:
            raise ValueError(f"{what}is a rational of {kind.size} bits; expected whole bytes.")
        present = None if variable.presence is None else _field(raw, variable.presence, 1)[:, 0] > 0
        values = np.full(len(raw), np.nan)
        where = slice(None) if present is None else present
        values[where] = _read_rationals(field[where], what)
        return values, present
    else:
        values = _whole_numbers(field, variable, what)
    if variable.presence is None:
        return values, None
    return values, _field(raw, variable.presence, 1)[:, 0] > 0


def _field(raw: Bytes, start: int, size: int) -> Bytes:
    """The bits from `start` of every record as little-endian bytes, zeros above them."""
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


def _whole_numbers(field: Bytes, variable: Variable, what: str) -> NDArray[Any]:
    """Encoded numbers plus the offset, in the smallest of int32, int64 and uint64 for the type."""
    size, offset, signed = variable.type.size, variable.offset, variable.type.name == "int"
    wide = np.zeros((len(field), 8), np.uint8)
    wide[:, : field.shape[1]] = field
    bits = wide.view("<u8")[:, 0].astype(np.uint64, copy=False)
    if signed and size < 64:  # the sign goes into the bits above
        sign = np.uint64(1) << np.uint64(size - 1)
        bits = (bits ^ sign) - sign
    least, most = (-(2 ** (size - 1)), 2 ** (size - 1) - 1) if signed else (0, 2**size - 1)
    if not -(2**63) <= least + offset <= most + offset < 2**64 or (
        least + offset < 0 and most + offset >= 2**63
    ):
        # Only the values themselves may fit.
        seen = bits.view(np.int64) if signed else bits
        least, most = int(seen.min(initial=0)), int(seen.max(initial=0))
    least, most = least + offset, most + offset
    # Sums are those of the numbers modulo 2^64, which is all there is if these fit.
    total = bits + np.uint64(offset % 2**64)
    if least >= -(2**31) and most < 2**31:
        return total.view(np.int64).astype(np.int32)
    if least >= -(2**63) and most < 2**63:
        return total.view(np.int64)
    if least >= 0 and most < 2**64:
        return total
    raise ValueError(f"{what}goes from {least} to {most}; expected numbers of 64 bits.")


def _joined(
    parts: Sequence[tuple[Any, NDArray[Any], NDArray[np.bool_] | None]], count: int
) -> NDArray[Any]:
    """A variable's values from all classes of states."""
    if len(parts) == 1 and isinstance(parts[0][0], slice):
        _, values, present = parts[0]
        if present is None or present.all():
            return values
        return np.where(present, values, np.nan)
    there = np.zeros(count, bool)
    for chosen, _, present in parts:
        there[chosen] = True if present is None else present
    dtype = np.result_type(*(values.dtype for _, values, _ in parts))
    found = np.full(count, np.nan) if not there.all() else np.zeros(count, dtype)
    for chosen, values, present in parts:
        found[chosen] = values if present is None else np.where(present, values, found[chosen])
    return found


def write_variables(valuation: Mapping[str, Any], place: str) -> tuple[list[Any], Bytes]:
    """The description of variables and the records of all states; each begins at a whole byte.

    Raises:
      ValueError: a variable holds neither truth values nor numbers.
    """
    described: list[Any] = []
    fields: list[NDArray[Any]] = []
    for name, values in valuation.items():
        values = np.asarray(values)
        kind = {"b": "bool", "i": "int", "u": "uint", "f": "double"}.get(values.dtype.kind)
        if kind is None or values.dtype.itemsize > 8:
            raise ValueError(
                f"{place}the variable {name!r} holds {values.dtype}; UMB files hold "
                "truth values and numbers of up to 64 bits."
            )
        if kind == "double":
            values = values.astype(np.float64)
        size = 1 if kind == "bool" else 8 * values.dtype.itemsize
        described.append({"name": name, "type": {"type": kind, "size": size}})
        if kind == "bool":
            described.append({"padding": 7})
        fields.append(values.astype(values.dtype.newbyteorder("<")))
    layout = np.dtype([(f"v{i}", field.dtype) for i, field in enumerate(fields)])
    records = np.zeros(fields[0].size, layout)
    for i, field in enumerate(fields):
        records[f"v{i}"] = field
    return described, records.view(np.uint8)
