"""Certificates of reachability probabilities in the text format of Storm's certifying branch."""

from __future__ import annotations

import os
import re
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np

from jaxltl.core.logic.properties import parse_property
from jaxltl.core.models.protocols import Model
from jaxltl.core.types import Solution
from jaxltl.core.validation import errors_in
from jaxltl.core.values.engine.row_form import row_of_action
from jaxltl.io.certificate.certificates import question_problem
from jaxltl.io.certificate.induced_model import solved
from jaxltl.io.certificate.inductive_bounds import Booleans, Certified, candidates
from jaxltl.io.drn.drn import write_drn
from jaxltl.io.files import write_bytes


def write_storm_certificate(
    path: str | os.PathLike[str],
    model: Model,
    solution: Solution | None,
    question: str,
    *,
    drn: str | os.PathLike[str] | None = None,
) -> None:
    """Writes bounds and ranks of reachability probabilities, as Storm's certificates have them.

    Fixed point certificates (Chatterjee et al., TACAS 2025): upper bounds with ``u >= B u``, lower ones
    with ``l <= B l`` and a rank of each state with ``l > 0``, the number of steps to the target along
    optimal rows, or along all rows for ``Pmin``. After a header and the number of states, target
    and ``stay`` are listed; each line has a state's number, lower bound, rank and upper bound, as
    fractions. They hold for the normalised rows, which a DRN file can have as fractions, too.

    Args:
      path: the file.
      model: a SparseMDP, MDP or DenseMDP.
      solution: of :func:`~jaxltl.reachability_probability`, or None to solve the question.
      question: ``Pmax=? [ F "goal" ]``, ``Pmin=? [ "safe" U "goal" ]``, or such.

      drn: a file for the model with exact probabilities, for ``storm --exact``.

    Raises:
      ValueError: another model or question, or bounds that could not be made inductive.

    Example:
      >>> import pathlib, tempfile, jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                       label={"heads": [1]}, initial=[1, 0, 0])
      >>> path = tempfile.mkdtemp() + "/coin.txt"
      >>> write_storm_certificate(path, coin, None, 'Pmax=? [ F "heads" ]')
      >>> print(pathlib.Path(path).read_text(), end="")
      # Certificate for 'Pmax=? [ F "heads" ]'
      reach max
      3
       1
      0 4503599627370471/9007199254740992 1 4503599627370521/9007199254740992
      1 1 0 1
      2 0 inf 0
    """
    with errors_in("write_storm_certificate: "):
        prop = parse_property(question)
        problem, _ = question_problem(model, prop, None, None)
        is_plain = problem.uncertain is None and problem.system.all()
        if problem.path["kind"] != "until" or "steps" in problem.path or not is_plain:
            raise ValueError(
                f"{question}: Storm has certificates of P of F and U of MDPs and chains."
            )
        answer = solved(problem) if solution is None else solution
        host, direction = problem.host, problem.objective
        probability = [Fraction(p) for p in host.probability.tolist()]
        ends = pairwise(host.entry_start.tolist())
        probability = [p / sum(probability[a:b]) for a, b in ends for p in probability[a:b]]
        rows = row_of_action(problem.sparse, np.asarray(answer.policy)).astype(np.int64)
        columns: list[list[object]] = []
        for side in ("lower", "upper"):
            bound, value = (np.array(x, np.float64) for x in (getattr(answer, side), answer.value))
            for values in candidates(problem, side, bound.ravel(), value.ravel(), rows):
                x = [Fraction(v) for v in values]
                ranks = _ranks_if_inductive(problem, side, x, probability)
                if ranks is not None:
                    columns += [[*map(str, x)], [*ranks]] if side == "lower" else [[*map(str, x)]]
                    break
            else:
                raise ValueError(f"no {side} bounds could be made inductive.")
        until = "stay" in problem.path
        lines = [f"# Certificate for '{prop.text}'"]
        lines += [f"{'until' if until else 'reach'} {direction}", str(host.num_states)]
        for states in (problem.target, problem.stay)[: 1 + until]:
            lines.append("".join(f" {s}" for s in np.flatnonzero(states)))
        lines += [
            " ".join(map(str, line)) for line in zip(range(host.num_states), *columns, strict=True)
        ]
        with write_bytes(path, None) as file:
            file.write(("\n".join(lines) + "\n").encode())
        if drn is not None:
            write_drn(drn, problem.sparse)
            exact = iter(probability)
            text = re.sub(
                r"(?m)^(\t\t\d+ : ).*", lambda x: f"{x[1]}{next(exact)}", Path(drn).read_text()
            )
            text = text.replace("@value_type: double", "@value_type: rational")
            with write_bytes(drn, None) as file:
                file.write(text.encode())


def _ranks_if_inductive(
    problem: Certified, side: str, x: list[Fraction], probability: list[Fraction]
) -> list[object] | None:
    """Ranks of states, ``inf`` where paths may miss the target, if bounds are inductive."""
    host, largest = problem.host, problem.objective == "max"
    inside: Booleans = ~problem.target & problem.stay
    terms = [p * x[t] for p, t in zip(probability, host.successor.tolist(), strict=True)]
    mean = [sum(terms[a:b]) for a, b in pairwise(host.entry_start.tolist())]
    best, used = [], np.zeros(host.num_rows, bool)
    for a, b in pairwise(host.row_start.tolist()):
        best.append((max if largest else min)(mean[a:b]))
        used[a:b] = [not largest or m == best[-1] for m in mean[a:b]]
    sign = 1 if side == "upper" else -1
    for s, y in enumerate(x):
        least = best[s] if inside[s] else Fraction(int(problem.target[s]))
        if sign * y < sign * least:
            return None
    rank = np.full(host.num_states, -1)
    # A row has the least rank of its successors; a state one more than a row's, for min all rows'.
    missing = np.ones(host.num_states, int) if largest else np.diff(host.row_start).astype(int)
    ranked, layer, number = ~used, problem.target.copy(), 0
    while layer.any():
        rank[layer] = number
        reached = np.logical_or.reduceat(layer[host.successor], host.entry_start[:-1])
        new = reached & ~ranked & inside[host.state]
        ranked |= new
        missing -= np.bincount(host.state[new], minlength=host.num_states)
        layer, number = (missing <= 0) & (rank < 0) & inside, number + 1
    if side == "lower" and any(y > 0 and r < 0 for y, r in zip(x, rank, strict=True)):
        return None
    return ["inf" if r < 0 else r for r in rank.tolist()]
