"""The page of what can be asked of which model, made from the table of engines."""

from __future__ import annotations

from jaxltl.core.values.door.table import ENGINES, NAMES

# Kinds of models, by the columns of the table, and their names on the page.
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
    """A table in Markdown: a row for each question, with the kinds of models that it is not for."""
    lines = [f"Kinds of models: {', '.join(COLUMNS.values())}.", ""]
    lines += ["| question | function | not for |", "|---|---|---|"]
    for path, engines in ENGINES.items():
        quantity = (path.__doc__ or "").strip().rstrip(".")
        names = " and ".join(f"`{name}`" for name in NAMES[path].split(" and "))
        missing = ", ".join(kind for column, kind in COLUMNS.items() if column not in engines)
        lines.append(f"| {quantity} | {names} | {missing} |")
    return "\n".join(lines)
