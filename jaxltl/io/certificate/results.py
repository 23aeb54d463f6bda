"""Certificates beside results: written, verified, and described in lines of text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jaxltl.core.array_types import PyTree
from jaxltl.core.logic.ltl import parse_ltl
from jaxltl.core.models.multiplayer import MultiplayerGame
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.types import Solution
from jaxltl.core.values.evaluation.data_guarantee import DataGuarantee

MAX_NODES = 50_000  # states with memory, up to which a command writes a certificate by itself


@dataclass(frozen=True)
class Certifiable:
    """A result that has a certificate: the arguments of `write_certificate`."""

    model: Model | MultiplayerGame | POMDP
    solution: Solution | DataGuarantee | FiniteMemoryPolicy | None
    question: str
    options: dict[str, PyTree] = field(default_factory=dict)
    num_nodes: int = 0  # an estimate, compared with `MAX_NODES`
    reason: str = ""  # why there is none


def formula_question(formula: str, objective: str = "max", nature: str = "") -> str:
    """The property of a formula in PRISM's syntax, with labels in quotes.

    >>> formula_question("F goal & !trap")
    'Pmax=? [ (F "goal") & (! "trap") ]'
    """
    from jaxltl import checker
    from jaxltl.io.certificate.certificates import nested

    return f"P{objective}{nature}=? [ {checker.formula_text(nested(parse_ltl(formula)))} ]"


def policy_certificate(
    model: Product, solution: Solution, formula: str, policy: Array
) -> Certifiable:
    """The satisfaction probability of a policy of a product."""
    count = model.num_states * (model.num_memory + 1)
    return Certifiable(model, solution, formula_question(formula), {"policy": policy}, count)


def write_certificates(
    directory: Path, results: Sequence[Certifiable] | str, name: str = "certificate.umb"
) -> list[dict[str, PyTree]]:
    """Writes a certificate of each result, and verifies it; or the reason why there is none.

    Several files are numbered. The records have `file`, `claims` and `trust`, or `reason`.
    """
    from jaxltl.checker import verdict
    from jaxltl.io.certificate.certificates import write_certificate

    if isinstance(results, str):
        return [{"reason": results}]
    records: list[dict[str, PyTree]] = []
    for i, one in enumerate(results):
        stem, suffix = Path(name).stem, Path(name).suffix
        path = directory / (name if len(results) == 1 else f"{stem}_{i + 1}{suffix}")
        path.unlink(missing_ok=True)
        try:
            if one.num_nodes > MAX_NODES:
                large = f"{one.num_nodes} states with memory; jaxltl.io.write_certificate writes it"
                raise ValueError(large)
            if one.reason:
                raise ValueError(one.reason)
            write_certificate(path, one.model, one.solution, one.question, **one.options)
        except ValueError as error:
            records.append({"reason": str(error).removeprefix("write_certificate: ")})
            continue
        _, lines = verdict(str(path))
        claims = [line.removeprefix("claimed: ") for line in lines if line.startswith("claimed")]
        trust = next(x.removeprefix("on trust: ") for x in lines if x.startswith("on trust"))
        records.append({"file": path.name, "claims": claims, "trust": trust})
    return records


def certificate_lines(records: Sequence[dict[str, PyTree]], directory: Path = Path()) -> list[str]:
    """The records as lines of text: what each proves, takes on trust, and the command."""
    lines = []
    for record in records:
        if "file" in record:
            lines += [f"{record['file']} proves: {x}" for x in record["claims"]]
            lines.append(f"  on trust: {record['trust']}")
            lines.append(f"  check it by: jaxltl verify {directory / record['file']}")
        else:
            lines.append(f"no certificate: {record['reason']}")
    return lines
