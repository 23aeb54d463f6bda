"""The page of what can be asked of which model, made from the table of engines."""

from __future__ import annotations

from jaxltl.core.values.door.table import ENGINES, NAMES

# Columns of the page, by those of the table, and what they are called.
COLUMNS = {
    "padded": "MDP, DenseMDP",
    "rows": "SparseMDP, chain",
    "intervals": "IntervalMDP",
    "padded game": "game on an MDP",
    "rows game": "game on a SparseMDP",
    "intervals game": "game on an IntervalMDP",
    "rows pomdp": "POMDP",
    "traced padded": "MDP inside `jit`",
    "traced rows": "SparseMDP inside `jit`",
    "traced padded game": "game inside `jit`",
    "mesh padded": "ShardedMDP",
}


def listing() -> str:
    """A table in Markdown: a row for each question, and "yes" where an engine answers it."""
    lines = [
        "| question | " + " | ".join(COLUMNS.values()) + " |",
        "|---|" + "---|" * len(COLUMNS),
    ]
    for path, engines in ENGINES.items():
        quantity = (path.__doc__ or "").strip().rstrip(".")
        names = " and ".join(f"`{name}`" for name in NAMES[path].split(" and "))
        cells = ["yes" if column in engines else "" for column in COLUMNS]
        lines.append(f"| {quantity}: {names} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
