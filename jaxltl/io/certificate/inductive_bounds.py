"""Inductive bounds of a question, for certificates: widened by expected steps, or solved exactly."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import jaxltl
from jaxltl import checker
from jaxltl.core.models.exact_numbers import written_probabilities
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.statistics.confidence_sets import LeastProbability
from jaxltl.core.values.evaluation.data_guarantee import DataGuarantee
from jaxltl.io.umb.umb import umb_contents

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]
Values = Floats | list[Fraction]
OPPOSITE = {"max": "min", "min": "max"}
SHIFTS = (1, 8, 64, 4096)  # multiples of the largest violation by which bounds are widened
_LARGEST_SHIFT = 1e-3  # relative; a larger violation means that the bounds are wrong
_QUICK = 2000  # transitions below which bounds are tried even if they seem to be violated
_LARGEST_EXACT = 60  # states that are solved in fractions
TIGHT = 1e-6  # relative slack up to which rows count when bounds are widened


@dataclass(frozen=True)
class Certified:
    """The model and the question of a certificate, as arrays."""

    model: Model  # as it is written
    sparse: SparseMDP
    uncertain: UncertainMDP | None  # the intervals
    system: Booleans  # bool[S], the states of the system
    objective: str
    directions: tuple[str, str]  # of the environment, of nature
    question: dict[str, object]
    path: dict[str, object]
    target: Booleans
    stay: Booleans
    gain: Floats  # float[T], the reward of a transition with that of its row and state
    discount: float
    node: Integers  # int[S], of each state the node of the file's arrays
    shape: tuple[int, ...]  # of these arrays
    sides: tuple[str, ...] = ("lower", "upper")  # of the claims
    rule: dict[str, object] = field(default_factory=dict)  # policy, memory and next of the claims

    @property
    def host(self) -> HostMDP:
        return self.sparse.host

    @property
    def is_probability(self) -> bool:
        return self.path["kind"] in ("until", "formula")

    @property
    def nature(self) -> str | None:
        """The direction of nature in relation to the objective; games have an adversary."""
        is_same = self.directions[1] == self.objective
        return None if self.uncertain is None else "cooperative" if is_same else "adversarial"

    @cached_property
    def row_of_entry(self) -> Integers:
        return np.repeat(np.arange(self.host.num_rows), np.diff(self.host.entry_start))

    @cached_property
    def initial(self) -> Integers:
        return np.flatnonzero(np.asarray(self.sparse.initial).ravel() > 0)

    def complement(self) -> Certified:
        """The same with opposite directions, as for the probability of the complement."""
        nature = OPPOSITE[self.directions[1]]
        return replace(
            self,
            objective=OPPOSITE[self.objective],
            directions=(OPPOSITE[self.directions[0]], nature),
        )

    def means(self, x: Floats) -> tuple[Floats, Floats]:
        """Expected reward and value of each row, and nature's distribution, for finite values."""
        host = self.host
        value = self.gain + self.discount * x[host.successor]
        if self.uncertain is None:
            p = host.probability
        else:
            largest = self.directions[1] == "max"
            p = self.uncertain.extreme_distributions(value, maximize=largest)
        p = p / np.add.reduceat(p, host.entry_start[:-1])[self.row_of_entry]
        return np.add.reduceat(p * value, host.entry_start[:-1]), p


def contents_of(
    model: Model | POMDP,
    question: dict[str, object],
    automaton: str,
    guarantee: DataGuarantee | None,
) -> dict[str, bytes]:
    """Members of the archive, without claims; of a guarantee from data with its counts.

    Those of a POMDP have its observations, its initial belief, and the probabilities for which its
    doubles stand as rational numbers.
    """
    known: dict[str, object] = {}
    arrays: dict[str, tuple[str, NDArray[np.generic]]] = {}
    if isinstance(model, POMDP):
        arrays["observations"] = "uint32", np.asarray(model.observation, "<u4")
        if (np.asarray(model.initial) > 0).sum() > 1:
            arrays["initial"] = "double", np.asarray(model.initial, "<f8")
        question |= {name: name for name in arrays}
        question["text"] = checker.question_text(question)
        known = {k: {"dtype": kind, "shape": [x.size]} for k, (kind, x) in arrays.items()}
    index: dict[str, object] = {
        "version": 1,
        "producer": f"jaxltl {jaxltl.__version__}",
        "numbers": checker.NUMBERS,
        "question": question,
        "claims": [{}],
        "members": known,
    }
    members = {name: bytes(content) for name, content in umb_contents(model)}
    if isinstance(model, POMDP):  # exact, as otherwise few cycles of beliefs are
        written = written_probabilities(model.fully_observable)
        bits, members["branch-to-probability.bin"] = _rationals(written)
        table = json.loads(members["index.json"])
        kind = {"type": "rational", "size": bits}
        table["transition-system"]["branch-probability-type"] = kind
        members["index.json"] = json.dumps(table, separators=(",", ":")).encode()
    for name, (_, values) in arrays.items():
        members[f"certificate/{name}.bin"] = values.tobytes()
    if automaton:
        members["certificate/automaton.hoa"] = automaton.encode()
    if guarantee is not None:
        sets, host = guarantee.sets, guarantee.model.nominal.host
        if isinstance(guarantee.graph, LeastProbability):
            raise ValueError(
                "solution: guarantees that assume a least probability have no certificates; those "
                "with the graphs 'given', 'seen' and 'complete' have."
            )
        total = np.repeat(sets.num_samples, np.diff(host.entry_start))
        counts = np.rint(sets.center * total).astype("<u8")
        members["certificate/counts.bin"] = counts.tobytes()
        index["members"] = {"counts": {"dtype": "uint64", "shape": [counts.size]}}
        index["counts"] = {
            "member": "counts",
            "method": sets.method,
            "confidence": str(sets.confidence),
            "assumption": guarantee.assumption,
        }
    members["certificate/index.json"] = json.dumps(index).encode()
    return members


def store(
    file: checker.CertificateFile, name: str, values: Values | Integers, shape: tuple[int, ...]
) -> None:
    """Adds an array of doubles, integers or fractions."""
    dtype = "double"
    if isinstance(values, np.ndarray):
        dtype = "double" if values.dtype.kind == "f" else "uint32"
        content = values.astype("<f8" if dtype == "double" else "<u4").tobytes()
    else:
        bits, content = _rationals(values)
        dtype = f"rational{bits}"
    file.contents[f"certificate/{name}.bin"] = content
    file.members[name] = {"dtype": dtype, "shape": [*shape]}


def _rationals(values: list[Fraction]) -> tuple[int, bytes]:
    """Numerators and denominators, and the bits of both."""
    ratios = [x.as_integer_ratio() for x in values]
    bits = [max(n.bit_length() + 1, d.bit_length()) for n, d in ratios]
    words = max(bits, default=0) // 64 + 1
    size = 8 * words
    pairs = (
        n.to_bytes(size, "little", signed=True) + d.to_bytes(size, "little") for n, d in ratios
    )
    return 128 * words, b"".join(pairs)


def proven(
    problem: Certified,
    file: checker.CertificateFile,
    side: str,
    bounds: Iterable[Values],
    initial: Integers | None = None,
    policy: str = "",
) -> dict[str, object]:
    """A claim of the first bounds that the checker accepts; its arrays are added to the file."""
    claim, reason = {"side": side, "values": side, "bound": "", **problem.rule}, "no bound"
    claim |= {"policy": policy} if policy else {}
    initial = problem.initial if initial is None else initial
    size = int(np.prod(problem.shape))
    for values in bounds:
        nodes: Values = np.zeros(size) if isinstance(values, np.ndarray) else [Fraction(0)] * size
        if isinstance(nodes, np.ndarray):
            nodes[problem.node] = values
        else:
            for v, x in zip(problem.node.tolist(), values, strict=True):
                nodes[v] = x
        store(file, side, nodes, problem.shape)
        begins = [values[s] for s in initial]
        bound = (min if side == "lower" else max)(begins)
        if file.weights and all(map(np.isfinite, map(float, begins))):  # on average
            weights = [Fraction(w) for w in file.weights if w]
            pairs = zip(weights, map(Fraction, begins), strict=True)
            bound = sum(w * x for w, x in pairs) / sum(weights)
        claim["bound"] = as_text(bound, side)
        try:
            checker.ClaimChecker(file, claim).check()
        except checker.Refusal as error:
            reason = str(error)
            continue
        return claim
    raise ValueError(f"no {side} bounds could be made inductive; the checker's reason: {reason}.")


def as_text(value: float | Fraction, side: str) -> str:
    """A bound as text: twelve digits, rounded outwards, or the exact ratio of a tiny number."""
    if value == np.inf:
        return "inf"
    exact = Fraction(value)
    scaled = exact * 10**12
    if abs(exact) < 1e-3 or scaled.denominator == 1:
        return str(exact)
    rounded = scaled.__floor__() if side == "lower" else scaled.__ceil__()
    return f"{'-' * (rounded < 0)}{abs(rounded) // 10**12}.{abs(rounded) % 10**12:012}"


def candidates(
    problem: Certified, side: str, bound: Floats, value: Floats, rows: Integers
) -> Iterator[Values]:
    """Bounds as they are, widened, and solved in fractions, in the order of their cost."""
    signed = "discount" in problem.path
    x = np.where(problem.target, float(problem.is_probability), bound)
    x = np.where(problem.target | problem.stay, x, 0.0)
    if problem.is_probability:
        x = np.clip(x, 0, 1)
    elif not signed:
        x = np.maximum(x, 0)
    if problem.host.num_transitions < _QUICK:
        yield x
    yield from _widened(problem, 1 if side == "upper" else -1, x, rows)
    if problem.host.num_states <= _LARGEST_EXACT and problem.uncertain is None:
        exact = _exact(problem, value, rows)
        if exact is not None:
            yield exact


def _widened(problem: Certified, sign: int, x: Floats, rows: Integers) -> Iterator[Floats]:
    """``x + sign e w`` with ``w >= 1 + P w`` in all rows that may violate the inequality.

    Then ``e`` times 1 is gained in each row, more than rounding and the violation cost. End
    components in which paths may stay have one value, of which the mean is exact.
    """
    from scipy.sparse import csr_array, eye_array
    from scipy.sparse.linalg import spsolve

    host, d = problem.host, problem.discount
    top = 1.0 if problem.is_probability else np.inf
    inside = ~problem.target & problem.stay
    if "discount" not in problem.path:
        inside &= (x > 0) & (x < top)
    ours = "max" if sign < 0 else "min"
    owner = np.where(problem.system, problem.objective, problem.directions[0])
    used = (owner != ours)[host.state]
    used[rows] = True
    used &= inside[host.state]
    label = np.arange(host.num_states)
    if problem.path["kind"] != "reward" and "discount" not in problem.path and sign > 0:
        components = end_components(host, inside, used)
        label, used = np.asarray(components.component), used & ~components.inside
        x = _extreme_by_label(x, label)
    mean, p = problem.means(np.where(np.isfinite(x), x, 0.0))
    infinite = np.add.reduceat(p * ~np.isfinite(x[host.successor]), host.entry_start[:-1]) > 0
    slack = np.where(infinite, np.inf, sign * (x[host.state] - mean))
    if host.num_transitions >= _QUICK and not (slack[used] < 0).any():
        yield x
    scale = max(1.0, float(np.max(np.abs(x[np.isfinite(x)]), initial=0)))
    tight = np.flatnonzero(used & (slack < TIGHT * scale))
    place = np.full(host.num_states, -1)
    parts = np.unique(label[host.state[tight]])
    place[parts] = np.arange(parts.size)
    if not parts.size:
        return
    source, goal = place[label[host.state]], place[label[host.successor]]
    entries = np.flatnonzero((goal >= 0) & np.isin(problem.row_of_entry, tight))
    number = np.full(host.num_rows, -1)
    number[tight] = np.arange(tight.size)
    index = number[problem.row_of_entry[entries]], goal[entries]
    step = csr_array((d * p[entries], index), shape=(tight.size, parts.size))
    home = source[tight]
    chosen = np.full(parts.size, -1)
    chosen[home] = np.arange(tight.size)
    w = np.zeros(parts.size)
    for _ in range(30):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            w = np.atleast_1d(
                spsolve((eye_array(parts.size) - step[chosen]).tocsc(), np.ones(parts.size))
            )
        if not np.isfinite(w).all() or w.min() < 0.5:
            return
        growth = 1 + step @ w
        better = growth > w[home] * (1 + 1e-9)
        if not better.any():
            break
        chosen[home[better]] = np.flatnonzero(better)
    violation = max(0.0, float(-slack[tight].min())) + 8 * host.backup_unit * scale
    shape = np.where(place[label] >= 0, w[place[label]], 0.0)
    for factor in SHIFTS:
        if factor * violation * shape.max() > _LARGEST_SHIFT * scale:
            return
        shifted = np.where(inside, x + sign * factor * violation * shape, x)
        yield shifted if "discount" in problem.path else np.clip(shifted, 0, top)


def _extreme_by_label(x: Floats, label: Integers) -> Floats:
    """The largest value of each label."""
    largest = np.full(x.size, -np.inf)
    np.maximum.at(largest, label, x)
    return largest[label]


def _exact(problem: Certified, value: Floats, rows: Integers) -> list[Fraction] | None:
    """Exact values of the chain of a policy; None if its system is singular."""
    host, d = problem.host, Fraction(problem.discount)
    result = [Fraction(int(t and problem.is_probability)) for t in problem.target]
    is_open = ~problem.target & problem.stay
    if "discount" not in problem.path:
        if not np.isfinite(value).all():
            return None
        is_open &= value > 0
    states = np.flatnonzero(is_open).tolist()
    place = {s: i for i, s in enumerate(states)}
    table: list[dict[int, Fraction]] = []
    for s in states:
        begin, end = host.entry_start[rows[s]], host.entry_start[rows[s] + 1]
        weights = [Fraction(float(n)) for n in host.probability[begin:end]]
        line = {place[s]: Fraction(1), -1: Fraction(0)}
        for i, n in zip(range(begin, end), weights, strict=True):
            t, p = int(host.successor[i]), n / sum(weights)
            line[-1] += p * (
                Fraction(float(problem.gain[i])) + d * (0 if t in place else result[t])
            )
            if t in place:
                line[place[t]] = line.get(place[t], Fraction(0)) - d * p
        table.append(line)
    for i in range(
        len(states)
    ):  # elimination without a choice of pivots, as rows are diagonally dominant
        if not table[i].get(i):
            return None
        table[i] = {j: v / table[i][i] for j, v in table[i].items()}
        for k, line in enumerate(table):
            if k != i and line.get(i):
                factor = line[i]
                for j, v in table[i].items():
                    line[j] = line.get(j, Fraction(0)) - factor * v
    for s, line in zip(states, table, strict=True):
        result[s] = line[-1]
    return result
