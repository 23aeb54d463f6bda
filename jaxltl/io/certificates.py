"""Certificates of bounds for :mod:`jaxltl.checker`, which proves them without the solvers."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import chex
import numpy as np
from numpy.typing import NDArray

import jaxltl
from jaxltl import checker
from jaxltl.core.logic.bounded import Bounded, Earned
from jaxltl.core.logic.labels import is_boolean, satisfying
from jaxltl.core.logic.ltl import TRUE, Formula
from jaxltl.core.logic.properties import Property, parse_property
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP, refuse_ball
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import Rewards, SparseMDP, reward_structure
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.row_form import row_form, row_of_action
from jaxltl.core.validation import errors_in
from jaxltl.io.files import write_bytes
from jaxltl.io.umb.members import tar_pieces, write_gzip
from jaxltl.io.umb.umb import umb_contents

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]
Values = Floats | list[Fraction]
_OPPOSITE = {"max": "min", "min": "max"}
_SHIFTS = (1, 8, 64, 4096)  # multiples of the largest violation by which bounds are widened
_LARGEST_SHIFT = 1e-3  # relative; a larger violation means that the bounds are wrong
_LARGEST_EXACT = 60  # states that are solved in fractions
_TIGHT = 1e-6  # relative slack up to which rows count when bounds are widened


def write_certificate(
    path: str | os.PathLike[str],
    model: Model,
    solution: Solution,
    question: str,
    *,
    reward: Rewards | chex.Array | None = None,
    discount: float | None = None,
) -> None:
    """Writes a model with a certificate of a solution's bounds in its initial states.

    ``jaxltl verify FILE`` accepts the file: this is checked before it is written. The bounds are made
    inductive, where they are not, by widening them by multiples of the expected number of steps, or
    by solving a small model in fractions.

    Args:
      path: the file, a UMB archive.
      model: a SparseMDP, MDP or DenseMDP, an IntervalMDP without L1 balls, or a Game of one of them,
        whose environment is adversarial.
      solution: of the question, such as of :func:`~jaxltl.reachability_probability`, with bounds
        and a deterministic policy.
      question: in PRISM's syntax, over labels of the model: ``Pmax=? [ F "goal" ]``,
        ``Pmin=? [ "safe" U "goal" ]``, ``Pmax=? [ F<=9 "goal" ]``, ``R{"time"}min=? [ F "goal" ]``,
        ``R{"time"}max=? [ C ]``, ``R{"time"}max=? [ C<=9 ]``. For an interval model with both
        directions, as in ``Pmaxmin=?``. With bounded steps the policy is not used.
      reward: ``float[S]``, ``float[R]`` or ``float[S, A]``: replaces the reward that the question
        names.
      discount: in [0, 1), of a question ``R{"name"}max=? [ C ]``: discounted instead of total reward.

    Raises:
      ValueError: the model or the question is of another kind, the solution has no bounds, or they
        could not be made inductive; with the reason of the checker.

    Example:
      >>> import tempfile, jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                       label={"heads": [1]}, initial=[1, 0, 0])
      >>> found = jl.reachability_probability(coin, coin.states_with_label("heads"))
      >>> path = tempfile.mkdtemp() + "/coin.umb"
      >>> write_certificate(path, coin, found, 'Pmax=? [ F "heads" ]')
      >>> jl.checker.main([path])
      claimed: Pmax=? [ F "heads" ] is >= 0.499999999999 in every initial state
      checked: 3 nodes of the claim's graph
      claimed: Pmax=? [ F "heads" ] is <= 0.500000000001 in every initial state
      checked: 3 nodes of the claim's graph
      on trust: that the model is the one meant; nothing else
      ACCEPTED
      0
    """
    with errors_in("write_certificate: "):
        problem = _problem(model, parse_property(question), reward, discount)
        steps = problem.path.get("steps")
        policy = None if isinstance(steps, int) else _offsets(model, solution, problem)
        contents = problem.contents(policy)
        file = checker.CertificateFile(contents)
        claims = []
        for side in ("lower", "upper"):
            bound = np.array(getattr(solution, side), np.float64).ravel()
            if bound.shape != (problem.host.num_states,) or np.isnan(bound).any():
                raise ValueError(f"solution.{side} has shape {bound.shape}, or NaN; expected [S].")
            if policy is None and isinstance(steps, int):
                claims.append(_step_claim(problem, file, side, bound, steps))
            elif policy is not None and (side == "lower" or problem.is_bounded(bound)):
                claims.append(_claim(problem, file, side, solution, bound, policy))
    index = json.loads(contents["certificate/index.json"])
    index |= {"claims": claims, "members": file.members}
    contents["certificate/index.json"] = json.dumps(index, indent=1).encode()
    with write_bytes(path, None) as target:
        write_gzip(target, tar_pieces(list(contents.items())))


@dataclass(frozen=True)
class _Certified:
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

    @property
    def host(self) -> HostMDP:
        return self.sparse.host

    @property
    def is_probability(self) -> bool:
        return self.path["kind"] == "until"

    def is_bounded(self, bound: Floats) -> bool:
        """True if some initial state has a finite bound."""
        return bool(np.isfinite(bound[np.asarray(self.sparse.initial) > 0]).any())

    @cached_property
    def row_of_entry(self) -> Integers:
        return np.repeat(np.arange(self.host.num_rows), np.diff(self.host.entry_start))

    def contents(self, policy: Integers | None) -> dict[str, bytes]:
        """Members of the archive, with a policy, if there is one, and without claims."""
        index = {
            "version": 1,
            "producer": f"jaxltl {jaxltl.__version__}",
            "numbers": checker.NUMBERS,
            "question": self.question,
            "claims": [{}],
            "members": {},
        }
        members = {name: bytes(content) for name, content in umb_contents(self.model)}
        if policy is not None:
            index["members"] = {"policy": {"dtype": "uint32", "shape": [policy.size]}}
            members["certificate/policy.bin"] = policy.astype("<u4").tobytes()
        members["certificate/index.json"] = json.dumps(index).encode()
        return members

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


def _problem(
    model: Model, prop: Property, reward: Rewards | chex.Array | None, discount: float | None
) -> _Certified:
    """Validates the model and the question."""
    inner = model.mdp if isinstance(model, Game) else model
    if isinstance(inner, Product):
        raise ValueError("certificates of products are not written; give to_sparse(product).")
    if isinstance(inner, IntervalMDP):
        refuse_ball(inner, "a certificate holds intervals")
    sparse = inner.nominal if isinstance(inner, IntervalMDP) else to_sparse(inner)
    system = np.asarray(model.system, bool).ravel() if isinstance(model, Game) else None
    direction = prop.objective or ("max" if sparse.is_chain else None)
    if direction is None or prop.relation is not None or prop.aggregate is not None:
        raise ValueError(f"{prop.text}: give the objective and =?, as in Pmax=? or R{{...}}min=?.")
    name = prop.reward
    if prop.operator == "R" and reward is not None:
        name = name or "reward"
        sparse = replace(sparse, rewards={name: row_form(model).reward(reward)})
    elif prop.operator == "R":
        name = name or next(iter(sparse.rewards), None)
    path: dict[str, object] = {}
    until = prop.path.operands if isinstance(prop.path, Formula) else ()
    operator = prop.path.operator if isinstance(prop.path, Formula) else ""
    if isinstance(prop.path, Bounded) and prop.path.lower == 0 and prop.path.upper is not None:
        operator = "F" if prop.path.left == TRUE else prop.path.operator
        until = (prop.path.left, prop.path.right)
        path["steps"] = prop.path.upper
    goal = until[-1] if until and all(map(is_boolean, until)) else None
    earned = prop.path if isinstance(prop.path, Earned) else Earned("average")
    if prop.operator == "P" and goal is not None and operator in ("F", "U"):
        path |= {"kind": "until", "target": _nested(goal)}
        path |= {"stay": _nested(until[0])} if operator == "U" else {}
    elif prop.operator == "R" and goal is not None and operator == "F":
        path = {"kind": "reward", "reward": name, "target": _nested(goal)}
    elif prop.operator == "R" and earned == Earned("total"):
        path = {"kind": "total", "reward": name}
    elif prop.operator == "R" and earned.kind == "cumulative" and earned.steps is not None:
        path = {"kind": "total", "reward": name, "steps": earned.steps}
    is_wrong = "kind" not in path or prop.definitions
    if is_wrong or (discount is not None and (path["kind"] != "total" or "steps" in path)):
        raise ValueError(
            f"{prop.text}: certificates are written for P of F and U over labels, also with a "
            "largest number of steps, R of F, and R of C, also with steps or a discount; not for "
            "other formulas and averages."
        )
    if discount is not None:
        path |= {"discount": str(Fraction(float(discount)))}
    question: dict[str, object] = {"path": path, "objective": direction}
    environment: str = direction
    nature: str = direction
    if system is not None:
        question["environment"], environment = "adversarial", _OPPOSITE[direction]
    if isinstance(inner, IntervalMDP):
        if prop.nature is None:
            raise ValueError(f"{prop.text}: give nature's direction too, as in Pmaxmin=?.")
        nature = prop.nature
        question["nature"] = "cooperative" if nature == direction else "adversarial"
    question["text"] = checker.question_text(question)
    written: Model = replace(inner, nominal=sparse) if isinstance(inner, IntervalMDP) else sparse
    written = replace(model, mdp=written) if isinstance(model, Game) else written
    host = sparse.host
    gain = np.zeros(host.num_transitions)
    if "reward" in path:
        structure = reward_structure(sparse, name)
        row = np.repeat(np.arange(host.num_rows), np.diff(host.entry_start))
        parts = (structure.state, host.state[row]), (structure.choice, row)
        for part, place in (*parts, (structure.transition, slice(None))):
            gain += 0 if part is None else np.asarray(part, np.float64)[place]
    everywhere = np.ones(host.num_states, bool)

    def mask(formula: Formula | None) -> Booleans:
        names = formula.propositions if formula else ()
        columns = [np.asarray(sparse.states_with_label(x), bool) for x in names]
        label = np.stack([everywhere, *columns], axis=1)[:, 1:]
        return satisfying(label, names, formula or "true", prop.text)

    return _Certified(
        model=written,
        sparse=sparse,
        uncertain=inner.host if isinstance(inner, IntervalMDP) else None,
        system=everywhere if system is None else system,
        objective=direction,
        directions=(environment, nature),
        question=question,
        path=path,
        target=mask(goal) if "target" in path else ~everywhere,
        stay=mask(until[0]) if "stay" in path else everywhere,
        gain=gain,
        discount=1.0 if discount is None else float(discount),
    )


def _nested(formula: Formula) -> str | list[object]:
    """A formula as the checker reads it: a label, or a list of an operator and its operands."""
    if formula.operator == "ap":
        return formula.proposition
    operands = [_nested(x) for x in formula.operands]
    if formula.operator == "xor":
        return ["!", ["<->", *operands]]
    if formula.operator == "M":
        return ["U", operands[1], ["&", *operands]]
    return [formula.operator, *operands]


def _offsets(model: Model, solution: Solution, problem: _Certified) -> Integers:
    """The policy as numbers of rows within their states."""
    policy = np.asarray(solution.policy)
    if policy.ndim != len(model.state_shape) or not np.issubdtype(policy.dtype, np.integer):
        raise ValueError(
            "solution.policy is randomised or missing; expected an action of each state."
        )
    return row_of_action(problem.sparse, policy) - problem.host.row_start[:-1]


def _claim(
    problem: _Certified,
    file: checker.CertificateFile,
    side: str,
    solution: Solution,
    bound: Floats,
    policy: Integers,
) -> dict[str, str]:
    """A claim that the checker accepts, whose arrays are added to the file."""
    claim = {"side": side, "values": side, "policy": "policy", "bound": ""}
    rows = problem.host.row_start[:-1] + policy
    reason = "no bound"
    for values in _candidates(problem, side, bound, np.array(solution.value).ravel(), rows):
        _store(file, side, values)
        worst = [values[s] for s in np.flatnonzero(np.asarray(problem.sparse.initial) > 0)]
        claim["bound"] = _as_text((min if side == "lower" else max)(worst), side)
        try:
            checker.ClaimChecker(file, claim).check()
        except checker.Refusal as error:
            reason = str(error)
            continue
        return claim
    raise ValueError(f"no {side} bounds could be made inductive; the checker's reason: {reason}.")


def _step_claim(
    problem: _Certified, file: checker.CertificateFile, side: str, bound: Floats, steps: int
) -> dict[str, str]:
    """A claim of values of all numbers of steps, by backward induction with rounding outwards."""
    host, sign = problem.host, 1 if side == "upper" else -1
    first, inside = host.row_start[:-1], ~problem.target & problem.stay
    is_max = np.where(problem.system, problem.objective, problem.directions[0]) == "max"
    ends = np.where(problem.target, float(problem.is_probability), 0.0)
    initial = np.flatnonzero(np.asarray(problem.sparse.initial) > 0)
    claim, reason = {"side": side, "values": side, "bound": ""}, "none"
    for factor in _SHIFTS:
        layers = [ends]
        for _ in range(steps):
            mean, _ = problem.means(layers[-1])
            scale = max(1.0, float(np.abs(mean).max()), float(np.abs(problem.gain).max()))
            best = np.where(
                is_max, np.maximum.reduceat(mean, first), np.minimum.reduceat(mean, first)
            )
            best = best + sign * 4 * factor * host.backup_unit * scale
            best = np.clip(best, 0, 1) if problem.is_probability else best
            layers.append(np.where(inside, best, ends))
        beyond = sign * (layers[-1] - bound)[initial]  # a proven bound may be wider by rounding
        if beyond.max(initial=0) > _TIGHT * max(1.0, float(np.abs(bound[initial]).max())):
            reason = "they are beyond the values"
            break
        _store(file, side, np.stack(layers, axis=1))
        worst = layers[-1][initial]
        claim["bound"] = _as_text(float(worst.min() if side == "lower" else worst.max()), side)
        try:
            checker.ClaimChecker(file, claim).check()
        except checker.Refusal as error:
            reason = str(error)
            continue
        return claim
    raise ValueError(f"no {side} bounds could be made inductive; the checker's reason: {reason}.")


def _store(file: checker.CertificateFile, name: str, values: Values) -> None:
    """Adds an array of doubles or fractions."""
    dtype, shape = "double", [len(values)]
    if isinstance(values, np.ndarray):
        shape = list(values.shape)
        content = values.astype("<f8").tobytes()
    else:
        ratios = [x.as_integer_ratio() for x in values]
        words = max(max(n.bit_length() + 1, d.bit_length()) for n, d in ratios) // 64 + 1
        dtype, size = f"rational{128 * words}", 8 * words
        content = b"".join(
            n.to_bytes(size, "little", signed=True) + d.to_bytes(size, "little") for n, d in ratios
        )
    file.contents[f"certificate/{name}.bin"] = content
    file.members[name] = {"dtype": dtype, "shape": shape}


def _as_text(value: float | Fraction, side: str) -> str:
    """A bound as text: twelve digits, rounded outwards, or the exact ratio of a tiny number."""
    if value == np.inf:
        return "inf"
    exact = Fraction(value)
    scaled = exact * 10**12
    if abs(exact) < 1e-3 or scaled.denominator == 1:
        return str(exact)
    rounded = scaled.__floor__() if side == "lower" else scaled.__ceil__()
    return f"{'-' * (rounded < 0)}{abs(rounded) // 10**12}.{abs(rounded) % 10**12:012}"


# --- inductive bounds -------------------------------------------------------------------------


def _candidates(
    problem: _Certified, side: str, bound: Floats, value: Floats, rows: Integers
) -> Iterator[Values]:
    """Bounds as they are, widened, and solved in fractions, in the order of their cost."""
    signed = "discount" in problem.path
    x = np.where(problem.target, float(problem.is_probability), bound)
    x = np.where(problem.target | problem.stay, x, 0.0)
    if problem.is_probability:
        x = np.clip(x, 0, 1)
    elif not signed:
        x = np.maximum(x, 0)
    yield x
    yield from _widened(problem, 1 if side == "upper" else -1, x, rows)
    if problem.host.num_states <= _LARGEST_EXACT and problem.uncertain is None:
        exact = _exact(problem, value, rows)
        if exact is not None:
            yield exact


def _widened(problem: _Certified, sign: int, x: Floats, rows: Integers) -> Iterator[Floats]:
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
    scale = max(1.0, float(np.max(np.abs(x[np.isfinite(x)]), initial=0)))
    tight = np.flatnonzero(used & (slack < _TIGHT * scale))
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
    for factor in _SHIFTS:
        if factor * violation * shape.max() > _LARGEST_SHIFT * scale:
            return
        shifted = np.where(inside, x + sign * factor * violation * shape, x)
        yield shifted if "discount" in problem.path else np.clip(shifted, 0, top)


def _extreme_by_label(x: Floats, label: Integers) -> Floats:
    """The largest value of each label."""
    largest = np.full(x.size, -np.inf)
    np.maximum.at(largest, label, x)
    return largest[label]


def _exact(problem: _Certified, value: Floats, rows: Integers) -> list[Fraction] | None:
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
