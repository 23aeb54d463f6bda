"""Certificates of bounds for :mod:`jaxltl.checker`, which proves them without the solvers."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from fractions import Fraction

import chex
import numpy as np

from jaxltl import checker
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.bounded import Bounded, Earned
from jaxltl.core.logic.labels import is_boolean, satisfying
from jaxltl.core.logic.ltl import TRUE, Formula
from jaxltl.core.logic.properties import Property, parse_property
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP, refuse_ball
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import Rewards, reward_structure
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.row_form import row_form, row_of_action
from jaxltl.core.validation import errors_in
from jaxltl.io.files import write_bytes
from jaxltl.io.formula_claims import formula_claims
from jaxltl.io.hoa.hoa import write_hoa
from jaxltl.io.inductive_bounds import (
    SHIFTS,
    TIGHT,
    Booleans,
    Certified,
    Floats,
    Integers,
    as_text,
    candidates,
    store,
)
from jaxltl.io.umb.members import tar_pieces, write_gzip

_OPPOSITE = {"max": "min", "min": "max"}


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
        whose environment is adversarial. For a formula also a Product of a model without players.
      solution: of the question, such as of :func:`~jaxltl.reachability_probability`, with bounds
        and a deterministic policy; of a formula that of :func:`~jaxltl.optimal_satisfaction`.
      question: in PRISM's syntax, over labels of the model: ``Pmax=? [ F "goal" ]``,
        ``Pmin=? [ "safe" U "goal" ]``, ``Pmax=? [ F<=9 "goal" ]``, ``R{"time"}min=? [ F "goal" ]``,
        ``R{"time"}max=? [ C ]``, ``R{"time"}max=? [ C<=9 ]``, ``Pmax=? [ G F "goal" ]``.
        For an interval model with both directions, as in ``Pmaxmin=?``. Formulas and bounded steps
        have values and policies of their own, and the bounds of the solution may not contradict.
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
        product = model if isinstance(model, Product) else None
        world: Model = model if product is None else product.mdp
        problem = _problem(world, parse_property(question), reward, discount)
        steps, is_formula = problem.path.get("steps"), problem.path["kind"] == "formula"
        if not is_formula and (product is not None or solution.product_policy is not None):
            raise ValueError(
                f"{question}: products are for formulas; give to_sparse(product) and its Solution."
            )
        policy = None
        if not is_formula and steps is None:
            policy = _offsets(model, solution, problem)
        contents = problem.contents(policy)
        file = checker.CertificateFile(contents)
        claims = []
        if is_formula:
            claims = formula_claims(problem, file)
            _check_initial(product, solution, claims)
        for side in () if is_formula else ("lower", "upper"):
            bound = np.array(getattr(solution, side), np.float64).ravel()
            if bound.shape != (problem.host.num_states,) or np.isnan(bound).any():
                raise ValueError(f"solution.{side} has shape {bound.shape}, or NaN; expected [S].")
            if isinstance(steps, int):
                claims.append(_step_claim(problem, file, side, bound, steps))
            elif policy is not None and (side == "lower" or problem.is_bounded(bound)):
                value = np.array(solution.value).ravel()
                claims.append(_claim(problem, file, side, (value, bound), policy))
    index = json.loads(contents["certificate/index.json"])
    index |= {"claims": claims, "members": file.members}
    contents["certificate/index.json"] = json.dumps(index, indent=1).encode()
    with write_bytes(path, None) as target:
        write_gzip(target, tar_pieces(list(contents.items())))


def _problem(
    model: Model, prop: Property, reward: Rewards | chex.Array | None, discount: float | None
) -> Certified:
    """Validates the model and the question."""
    inner = model.mdp if isinstance(model, Game) else model
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
    elif prop.operator == "P" and isinstance(prop.path, Formula):
        path = {"kind": "formula", "formula": _nested(prop.path), "automaton": "automaton"}
        if system is not None or isinstance(inner, IntervalMDP):
            raise ValueError(
                f"{prop.text}: of games and interval models, only F and U are written."
            )
    is_wrong = "kind" not in path or prop.definitions
    if is_wrong or (discount is not None and (path["kind"] != "total" or "steps" in path)):
        raise ValueError(
            f"{prop.text}: certificates are written for P of formulas without bounds, of F<=k and "
            "U<=k over labels, for R of F, and R of C, also with steps or a discount."
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
    hoa = ""
    if path["kind"] == "formula" and isinstance(prop.path, Formula):
        hoa = write_hoa(to_automaton(prop.path))

    def mask(formula: Formula | None) -> Booleans:
        names = formula.propositions if formula else ()
        columns = [np.asarray(sparse.states_with_label(x), bool) for x in names]
        label = np.stack([everywhere, *columns], axis=1)[:, 1:]
        return satisfying(label, names, formula or "true", prop.text)

    return Certified(
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
        automaton=hoa,
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


def _offsets(model: Model, solution: Solution, problem: Certified) -> Integers:
    """The policy as numbers of rows within their states."""
    policy = np.asarray(solution.policy)
    if policy.ndim != len(model.state_shape) or not np.issubdtype(policy.dtype, np.integer):
        raise ValueError(
            "solution.policy is randomised or missing; expected an action of each state."
        )
    return row_of_action(problem.sparse, policy) - problem.host.row_start[:-1]


def _claim(
    problem: Certified,
    file: checker.CertificateFile,
    side: str,
    value_and_bound: tuple[Floats, Floats],
    policy: Integers,
) -> dict[str, str]:
    """A claim that the checker accepts, whose arrays are added to the file."""
    claim = {"side": side, "values": side, "policy": "policy", "bound": ""}
    rows = problem.host.row_start[:-1] + policy
    reason = "no bound"
    value, bound = value_and_bound
    for values in candidates(problem, side, bound, value, rows):
        store(file, side, values)
        worst = [values[s] for s in np.flatnonzero(np.asarray(problem.sparse.initial) > 0)]
        claim["bound"] = as_text((min if side == "lower" else max)(worst), side)
        try:
            checker.ClaimChecker(file, claim).check()
        except checker.Refusal as error:
            reason = str(error)
            continue
        return claim
    raise ValueError(f"no {side} bounds could be made inductive; the checker's reason: {reason}.")


def _check_initial(
    product: Product | None, solution: Solution, claims: list[dict[str, str]]
) -> None:
    """Raises a ValueError if bounds of a solution contradict the claims in the initial states."""
    if solution.product_policy is not None:
        bounds = [np.asarray(x, np.float64) for x in (solution.lower, solution.upper)]
    elif product is not None:
        initial = np.asarray(product.initial) > 0
        bounds = [np.asarray(x, np.float64)[initial] for x in (solution.lower, solution.upper)]
    else:
        raise ValueError(
            "solution: give that of optimal_satisfaction(model, formula), or the product."
        )
    proven = {claim["side"]: Fraction(claim["bound"]) for claim in claims}
    low, high = float(bounds[0].min()), float(bounds[1].max())
    if not (low <= proven["upper"] + TIGHT and high >= proven["lower"] - TIGHT):
        raise ValueError(f"solution has the bounds {low} and {high}, which {claims} contradict.")


def _step_claim(
    problem: Certified, file: checker.CertificateFile, side: str, bound: Floats, steps: int
) -> dict[str, str]:
    """A claim of values of all numbers of steps, by backward induction with rounding outwards."""
    host, sign = problem.host, 1 if side == "upper" else -1
    first, inside = host.row_start[:-1], ~problem.target & problem.stay
    is_max = np.where(problem.system, problem.objective, problem.directions[0]) == "max"
    ends = np.where(problem.target, float(problem.is_probability), 0.0)
    initial = np.flatnonzero(np.asarray(problem.sparse.initial) > 0)
    claim, reason = {"side": side, "values": side, "bound": ""}, "none"
    for factor in SHIFTS:
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
        if beyond.max(initial=0) > TIGHT * max(1.0, float(np.abs(bound[initial]).max())):
            reason = "they are beyond the values"
            break
        store(file, side, np.stack(layers, axis=1), [host.num_states, steps + 1])
        worst = layers[-1][initial]
        claim["bound"] = as_text(float(worst.min() if side == "lower" else worst.max()), side)
        try:
            checker.ClaimChecker(file, claim).check()
        except checker.Refusal as error:
            reason = str(error)
            continue
        return claim
    raise ValueError(f"no {side} bounds could be made inductive; the checker's reason: {reason}.")
