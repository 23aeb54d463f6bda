"""Claims of certificates for formulas of linear temporal logic, of Markov chains and MDPs."""

from __future__ import annotations

from fractions import Fraction

import jax.numpy as jnp
import numpy as np

from jaxltl import checker
from jaxltl.core.models.sparse import SparseMDP, make_sparse
from jaxltl.core.values.engine.row_form import row_of_action
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.io.inductive_bounds import Booleans, Certified, Integers, as_text, candidates, store


def formula_claims(problem: Certified, file: checker.CertificateFile) -> list[dict[str, str]]:
    """A lower and an upper claim of the probability of a formula, with values ``[S, Q]``.

    The system reaches the end components with accepting (for min: rejecting) priorities. One bound
    holds for all rows; the other one is of a policy, whose chain reaches the opposite priorities
    with the remaining probability.
    """
    automaton = file.automaton
    if automaton is None:
        raise ValueError("the certificate has no automaton.")
    size, letter = automaton.num_states, np.asarray(automaton.letter_of)
    edges = np.array([[out[q] for q in range(size)] for out in automaton.edges])[letter]
    after, priority = edges[..., 0].ravel(), dict(enumerate(edges[..., 1].ravel().tolist()))
    host, parity = problem.host, int(problem.objective == "min")
    rows = _ranges(np.repeat(host.row_start[:-1], size), np.repeat(np.diff(host.row_start), size))
    node = np.repeat(np.arange(after.size), np.repeat(np.diff(host.row_start), size))
    entry_count = np.diff(host.entry_start)[rows]
    entries = _ranges(host.entry_start[rows].astype(np.int64), entry_count)
    successor = host.successor[entries] * size + np.repeat(after[node], entry_count)
    row_start = np.searchsorted(node, np.arange(after.size + 1))
    entry_start = np.r_[0, np.cumsum(entry_count)]
    product = make_sparse(row_start, entry_start, successor, host.probability[entries])
    target, chosen = _winning(product, priority, parity)
    reached = reachability_probability(product, jnp.asarray(target))
    optimal = row_of_action(product, np.asarray(reached.policy))
    policy: Integers = np.where(target, chosen, optimal).astype(np.int64)
    file.members["policy"] = {"dtype": "uint32", "shape": [host.num_states, size]}
    offsets = (policy - row_start[:-1]).astype("<u4")
    file.contents["certificate/policy.bin"] = offsets.tobytes()
    taken = _ranges(entry_start[policy], entry_count[policy])
    starts = np.r_[0, np.cumsum(entry_count[policy])]
    chain = make_sparse(None, starts, successor[taken], product.host.probability[taken])
    opposite, _ = _winning(chain, priority, 1 - parity)
    sides = ("upper", "lower") if parity == 0 else ("lower", "upper")
    claims = [_claim(problem, file, sides[0], product, target, policy)]
    claims.append(_claim(problem, file, sides[1], chain, opposite, np.arange(after.size)))
    claims[1]["policy"] = "policy"
    return sorted(claims, key=lambda claim: claim["side"])


def _ranges(start: Integers, count: Integers) -> Integers:
    """Concatenation of ``arange(start, start + count)``."""
    return np.repeat(start - np.r_[0, np.cumsum(count)[:-1]], count) + np.arange(count.sum())


def _winning(model: SparseMDP, priority: dict[int, int], parity: int) -> tuple[Booleans, Integers]:
    """Where the least recurring priority has a parity almost surely, and the rows of a policy."""
    host = model.host
    graph: dict[int, list[tuple[object, ...]]] = {v: [] for v in range(host.num_states)}
    for r, v in enumerate(host.state.tolist()):
        begin, end = host.entry_start[r], host.entry_start[r + 1]
        targets = host.successor[begin:end][host.probability[begin:end] > 0].tolist()
        graph[v].append((targets, [1] * len(targets), len(targets), None, r))
    inside: Booleans = np.zeros(host.num_states, bool)
    chosen = np.array(host.row_start[:-1], np.int64)
    for least in sorted({p for p in priority.values() if p % 2 == parity}):
        part = {v: options for v, options in graph.items() if priority[v] >= least}
        marked = {v for v in part if priority[v] == least}
        kept = checker.recurring(part, [marked])
        before, start = checker.sources(kept), sorted(marked & kept.keys())
        order = checker.explore(start, lambda v, before=before: before.get(v, ()), lambda v: (v,))
        place = {v: i for i, v in enumerate(order)}
        for v in (v for v in kept if not inside[v]):
            nearer = (o for o in kept[v] if any(place[t] < place[v] for t in o[0]))
            chosen[v] = (kept[v][0] if v in marked else next(nearer))[4]
        inside[[*kept]] = True
    return inside, chosen


def _claim(
    problem: Certified,
    file: checker.CertificateFile,
    side: str,
    model: SparseMDP,
    target: Booleans,
    rows: Integers,
) -> dict[str, str]:
    """A claim from upper bounds of the probability to reach a target in a product."""
    everywhere = np.ones(target.size, bool)
    reaching = Certified(
        model=model,
        sparse=model,
        uncertain=None,
        system=everywhere,
        objective="max",
        directions=("max", "max"),
        question={},
        path={"kind": "until"},
        target=target,
        stay=everywhere,
        gain=np.zeros(model.host.num_transitions),
        discount=1.0,
    )
    reached = reachability_probability(model, jnp.asarray(target))
    size = target.size // problem.host.num_states
    claim, reason = {"side": side, "values": side, "bound": ""}, "no bound"
    start = 0 if file.automaton is None else file.automaton.initial
    initial = np.flatnonzero(np.asarray(problem.sparse.initial) > 0) * size + start
    for upper in candidates(
        reaching, "upper", np.array(reached.upper), np.array(reached.value), rows
    ):
        values = [1 - Fraction(x) for x in upper] if side == "lower" else upper
        store(file, side, values, [problem.host.num_states, size])
        worst = [values[v] for v in initial]
        claim["bound"] = as_text((min if side == "lower" else max)(worst), side)
        try:
            checker.ClaimChecker(file, {**claim, "policy": "policy"}).check()
        except checker.Refusal as error:
            reason = str(error)
            continue
        return claim
    raise ValueError(f"no {side} bounds could be made inductive; the checker's reason: {reason}.")
