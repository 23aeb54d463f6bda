"""Text files of coloured gridworlds: one letter per cell, and the kinds of cells.

Example:
  >>> from jaxltl.io.colored_world import read_world, write_world
  >>> world = read_world("rbrp\\nbrbp\\nrbry")
  >>> world.shape, world.mdp.label[:, 0].tolist(), read_world(write_world(world)).shape
  ((1, 2), [True, False], (1, 2))
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from jaxltl.envs.cell_kinds import COLORS, OBJECTS, OBSTACLES
from jaxltl.envs.temporal_gridworld import World, colored_world

LETTERS = "rywpb"  # of the colours, in text files


def write_world(world: World) -> str:
    """Text form of a coloured gridworld: margin, slip, kinds of cells and a letter per cell.

    Args:
      world: the world.

    Returns:
      The text; :func:`read_world` restores the same world.
    """
    slip = 0.0
    if world.mdp.num_successors > 1:
        slip = 1 - float(world.mdp.probability[0, 0, 0])
    kinds = [
        f"{name}: {', '.join(f'{n} {c}' for c, n in zip(COLORS, counts, strict=True) if n)}"
        for name, counts in world.kinds
    ]
    rows = map("".join, np.array(list(LETTERS))[np.asarray(world.colors)])
    return "\n".join([f"margin: {world.margin}", f"slip: {slip:.6g}", *kinds, "", *rows, ""])


def read_world(
    text: str,
    *,
    margin: int | None = None,
    slip: float | None = None,
    objects: Mapping[str, Mapping[str, int]] | None = None,
    obstacles: Mapping[str, Mapping[str, int]] | None = None,
) -> World:
    """Coloured gridworld of the text form of :func:`write_world`.

    Lines with a colon are settings: ``margin`` (default 1), ``slip`` (default 0) and the colours of
    a kind of cell, such as ``o1: 5 red, 4 black`` (default: the kinds of the dissertation). The
    other lines are the rows of the map including its margin, with the letters r, y, w, p and b.

    Args:
      text: the text form.
      margin, slip: instead of the settings of the text.
      objects, obstacles: kinds of cells, of a text without kinds or with the same ones.

    Returns:
      A :class:`~jaxltl.envs.temporal_gridworld.World`.

    Raises:
      ValueError: with the line, or the row and column of the map, for malformed text, and for kinds
        that differ from those of the text.
    """
    own_margin, own_slip = 1, 0.0
    kinds: dict[str, dict[str, int]] = {}
    rows = []
    for i, line in enumerate(text.splitlines()):
        name, colon, value = (part.strip() for part in line.partition(":"))
        if not colon:
            rows += [name] if name else []
        elif name == "margin":
            own_margin = int(_number(value, int, i, name))
        elif name == "slip":
            own_slip = _number(value, float, i, name)
        elif name in kinds:
            raise ValueError(f"line {i + 1}: {name} is given twice; remove one of the lines.")
        else:
            kinds[name] = _read_counts(value, i, name)
    requested = objects is not None or obstacles is not None
    objects = OBJECTS if objects is None else objects
    obstacles = OBSTACLES if obstacles is None else obstacles
    if kinds and requested and _counts(kinds) != _counts({**objects, **obstacles}):
        raise ValueError(
            f"the map says {', '.join(kinds)} by lines of its own, which differ from objects and "
            "obstacles; remove one of the two."
        )
    return colored_world(
        _read_rows(rows),
        objects=kinds or objects,
        obstacles={} if kinds else obstacles,
        margin=own_margin if margin is None else margin,
        slip=own_slip if slip is None else slip,
    )


def _counts(kinds: Mapping[str, Mapping[str, int]]) -> dict[str, dict[str, int]]:
    return {name: {c: n for c, n in counts.items() if n} for name, counts in kinds.items()}


def _number(text: str, kind: type, line: int, name: str) -> float:
    try:
        return kind(text)
    except ValueError:
        raise ValueError(f"line {line + 1}: {name} is {text!r}, which is no number.") from None


def _read_counts(text: str, line: int, name: str) -> dict[str, int]:
    counts = {}
    for part in text.split(","):
        words = part.split()
        if len(words) != 2:
            raise ValueError(
                f"line {line + 1}: {name}: {part.strip()!r}; write it as: o1: 5 red, 4 black."
            )
        counts[words[1]] = int(_number(words[0], int, line, name))
    return counts


def _read_rows(rows: Sequence[str]) -> NDArray[np.int32]:
    if not rows:
        raise ValueError(f"the map is empty; write rows of the letters {', '.join(LETTERS)}.")
    for i, row in enumerate(rows):
        for j, letter in enumerate(row):
            if letter not in LETTERS:
                raise ValueError(
                    f"map row {i + 1}, column {j + 1}: {letter!r} is no colour; use "
                    f"{', '.join(f'{a} ({b})' for a, b in zip(LETTERS, COLORS, strict=True))}."
                )
        if len(row) != len(rows[0]):
            raise ValueError(
                f"map row {i + 1} has {len(row)} cells, row 1 has {len(rows[0])}; all rows must "
                "have the same length."
            )
    return np.array([[LETTERS.index(letter) for letter in row] for row in rows], np.int32)
