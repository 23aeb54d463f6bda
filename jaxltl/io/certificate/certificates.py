"""Certificates of bounds for :mod:`jaxltl.checker`, which proves them without the solvers."""

from __future__ import annotations

import contextlib
import gc
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import cast

import chex
import numpy as np

from jaxltl import checker
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.bounded import Bounded, Earned
from jaxltl.core.logic.labels import is_boolean, satisfying
from jaxltl.core.logic.ltl import TRUE, Formula
from jaxltl.core.logic.properties import Property, parse_property
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.lifting import project_policy
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP, refuse_ball
from jaxltl.core.models.multiplayer import MultiplayerGame
from jaxltl.core.models.pomdp import POMDP, policy_of_states
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Model, PyTree
from jaxltl.core.models.sparse import Rewards, reward_structure
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.types import Solution
from jaxltl.core import validation
from jaxltl.core.validation import errors_in
from jaxltl.core.values.engine.row_form import row_form, row_of_action
from jaxltl.core.values.evaluation.data_guarantee import DataGuarantee
from jaxltl.core.values.partial_observability.solve import MAX_BELIEFS, TOLERANCE
from jaxltl.io.certificate.belief_claims import BeliefSearch, Improvement
from jaxltl.io.certificate.formula_claims import formula_claims
from jaxltl.io.certificate.induced_model import induced_problem, solved
from jaxltl.io.certificate.inductive_bounds import (
    OPPOSITE,
    SHIFTS,
    TIGHT,
    Booleans,
    Certified,
    Floats,
    Integers,
    candidates,
    contents_of,
    proven,
    store,
)
from jaxltl.io.files import write_bytes
from jaxltl.io.hoa.hoa import write_hoa
from jaxltl.io.umb.members import tar_pieces, write_gzip


def write_certificate(
    path: str | os.PathLike[str],
    model: Model | MultiplayerGame | POMDP,
    solution: Solution | DataGuarantee | FiniteMemoryPolicy | None,
    question: str,
    *,
    reward: Rewards | chex.Array | None = None,
    discount: float | None = None,
    policy: FiniteMemoryPolicy | chex.Array | None = None,
    max_beliefs: int = MAX_BELIEFS,
) -> None:
    """Writes a model with a certificate of a solution's bounds in its initial states.

    ``jaxltl verify FILE`` accepts the file: this is checked before it is written. The bounds are made
    inductive, where they are not, by widening them by multiples of the expected number of steps, or
    by solving a small model in fractions.

    Args:
      path: the file, a UMB archive.
      model: a SparseMDP, MDP or DenseMDP, an IntervalMDP without L1 balls, or a Game of one of them,
        whose environment is adversarial; for a formula also a Product. Of a POMDP, from its initial
        belief: the bound that a controller attains, and that of all policies by explored beliefs, or of those
        that see the states where it is as good.
      solution: of the question, such as of :func:`~jaxltl.reachability_probability`, with bounds
        and a deterministic policy, of a POMDP a finite-memory policy over its observations; of a formula
        that of :func:`~jaxltl.optimal_satisfaction`, or the guarantee of :func:`~jaxltl.learn_guarantee`,
        with the counts of its log; of a POMDP also the finite-memory policy alone. None: it is solved.
      question: in PRISM's syntax, over labels of the model: ``Pmax=? [ F "goal" ]``,
        ``Pmin=? [ "safe" U "goal" ]``, ``Pmax=? [ F<=9 "goal" ]``, ``R{"time"}min=? [ F "goal" ]``,
        ``R{"time"}max=? [ C ]``, ``R{"time"}max=? [ C<=9 ]``, ``Pmax=? [ G F "goal" ]``.
        For an interval model with both directions, as in ``Pmaxmin=?``. Formulas and bounded steps
        have values and policies of their own, and the bounds of the solution may not contradict.
      reward: ``float[S]``, ``float[R]`` or ``float[S, A]``: replaces the reward that the question
        names.
      discount: in [0, 1), of a question ``R{"name"}max=? [ C ]``: discounted instead of total reward.
      policy: the question is about this policy of the system: actions ``int[S]`` or weights
        ``float[S, A]``, of a product ``[S, Q]`` and ``[S, Q, A]``, or with a finite memory; of a POMDP
        over its observations.
      max_beliefs: largest number of beliefs of a POMDP that are explored for the bound of all policies, until
        the bounds are as close as those of the solution; 0 for policies that see the states.

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
    with errors_in("write_certificate: "), _no_collection():
        prop = parse_property(question)
        if isinstance(model, MultiplayerGame) and prop.coalition and not prop.universal:
            model, prop = model.game(prop.coalition), replace(prop, coalition=None)
        if isinstance(model, MultiplayerGame):
            raise ValueError(
                f"{question}: certificates are written for a coalition, as in <<a>> Pmax=?."
            )
        pomdp = controller = None
        if isinstance(model, POMDP):
            pomdp, model = model, model.fully_observable
            controller, policy = _policies(pomdp, solution, policy)
        lazy = model.mdp if isinstance(model, Game) else model
        world: Model = model
        if isinstance(lazy, Product):
            world = replace(model, mdp=lazy.mdp) if isinstance(model, Game) else lazy.mdp
        problem, formula = question_problem(world, prop, reward, discount)
        answer = solution.satisfaction if isinstance(solution, DataGuarantee) else solution
        answer = None if isinstance(answer, FiniteMemoryPolicy) else answer
        is_other = policy is not None or isinstance(lazy, Product) or pomdp is not None
        simple = None if is_other else answer
        if simple is not None and simple.product_policy is not None:
            simple = None  # its values are those of a product
        automaton = None if formula is None else to_automaton(formula)
        if isinstance(lazy, Product) and not isinstance(policy, FiniteMemoryPolicy | None):
            policy = project_policy(lazy, policy)
        induced = None
        if policy is not None:
            induced, arrays, rule = induced_problem(problem, policy)
            problem.question.update(rule)
        problem.question["text"] = checker.question_text(problem.question)
        text = "" if automaton is None else write_hoa(automaton)
        guarantee = solution if isinstance(solution, DataGuarantee) else None
        if guarantee is not None:  # of what holds for all probabilities in the intervals
            side = "lower" if problem.directions[1] == "min" else "upper"
            problem = replace(problem, sides=(side,))
        if pomdp is not None:
            pomdp = replace(pomdp, fully_observable=problem.sparse)
        written = problem.model if pomdp is None else pomdp
        contents = contents_of(written, problem.question, text, guarantee)
        try:
            file = checker.CertificateFile(contents)
        except checker.Refusal as error:
            raise ValueError(f"the checker refuses the model or the question: {error}.") from None
        problems, search, limit = [problem], None, 0
        if induced is not None:
            problems = [induced]
            for name, (values, shape) in arrays.items():
                store(file, name, values, shape)
        elif pomdp is not None and controller is not None:
            problems = _of_controller(problem, file, policy_of_states(pomdp, controller))
            limit = validation.integer("max_beliefs", max_beliefs, least=0)
        claims: list[dict[str, object]] = []
        for part in problems:
            if limit and claims and pomdp is not None:
                search = _search(pomdp, answer, str(claims[0]["bound"]), prop, limit)
            improve = None if search is None else search.improve
            if automaton is not None:
                claims += formula_claims(part, file, automaton, improve)
            else:
                claims += _claims(part, file, solved(part) if simple is None else simple, improve)
        if answer is not None:
            _check_initial(answer, model, claims)
    index = json.loads(contents["certificate/index.json"])
    index |= {"claims": claims, "members": file.members}
    contents["certificate/index.json"] = json.dumps(index, indent=1).encode()
    with write_bytes(path, None) as target:
        write_gzip(target, tar_pieces(list(contents.items())))


def _policies(
    pomdp: POMDP, solution: Solution | DataGuarantee | FiniteMemoryPolicy | None, policy: PyTree
) -> tuple[FiniteMemoryPolicy | None, FiniteMemoryPolicy | None]:
    """The policies of states of a solution's controller, and of a controller in the question."""
    if policy is not None:
        return None, policy_of_states(pomdp, policy)
    attained = solution.policy if isinstance(solution, Solution) else solution
    if not isinstance(attained, FiniteMemoryPolicy):
        raise ValueError(
            "certificates of a POMDP are written for a controller; give a solution that has one, or policy=, "
            "a FiniteMemoryPolicy over observations."
        )
    policy_of_states(pomdp, attained)
    return attained, None


def _search(
    pomdp: POMDP, answer: Solution | None, attained: str, prop: Property, max_beliefs: int
) -> BeliefSearch:
    """The search for a bound of all policies as close as that of an answer, or to a tolerance."""
    value = float("inf") if attained == "inf" else float(Fraction(attained))
    scale = abs(value) if prop.operator == "R" else 1.0
    sign = 1 if prop.objective == "max" else -1
    goal = value + sign * TOLERANCE * scale
    if answer is not None:
        goal = float(answer.upper if sign > 0 else answer.lower)
    width = min(abs(goal - value) / max(scale, 1e-300), TOLERANCE)
    return BeliefSearch(pomdp, goal, width, max_beliefs)


def _of_controller(
    problem: Certified, file: checker.CertificateFile, controller: FiniteMemoryPolicy
) -> list[Certified]:
    """The chain of a controller, for the bound that it attains, and the problem for the other one."""
    induced, arrays, rule = induced_problem(problem, controller)
    attained, other = ("lower", "upper")[:: 1 if problem.objective == "max" else -1]
    for name, (values, shape) in arrays.items():
        if file.automaton is not None:  # the same in all states of the automaton
            size = file.automaton.num_states
            table = np.reshape(values, (shape[0], 1, *shape[1:]))
            shape = shape[0], size, *shape[1:]
            store(file, name, cast(Integers, np.broadcast_to(table, shape).ravel()), shape)
        else:
            store(file, name, values, shape)
    return [replace(induced, sides=(attained,), rule=rule), replace(problem, sides=(other,))]


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Without garbage collection, since the checker makes millions of tuples that are not cyclic."""
    is_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if is_enabled:
            gc.enable()


def question_problem(
    model: Model, prop: Property, reward: Rewards | chex.Array | None, discount: float | None
) -> tuple[Certified, Formula | None]:
    """Validates the model and the question; with the formula that needs an automaton."""
    if prop.coalition not in (None, ("system",)) or prop.universal:
        raise ValueError(f"{prop.text}: certificates are written for the system of a game.")
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
        path |= {"kind": "until", "target": nested(goal)}
        path |= {"stay": nested(until[0])} if operator == "U" else {}
    elif prop.operator == "R" and goal is not None and operator == "F":
        path = {"kind": "reward", "reward": name, "target": nested(goal)}
    elif prop.operator == "R" and earned == Earned("total"):
        path = {"kind": "total", "reward": name}
    elif prop.operator == "R" and earned.kind == "cumulative" and earned.steps is not None:
        path = {"kind": "total", "reward": name, "steps": earned.steps}
    elif prop.operator == "P" and isinstance(prop.path, Formula):
        path = {"kind": "formula", "formula": nested(prop.path), "automaton": "automaton"}
    is_wrong = "kind" not in path or prop.definitions or prop.unreached != "infinite"
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
        question["environment"], environment = "adversarial", OPPOSITE[direction]
    if isinstance(inner, IntervalMDP):
        if prop.nature is None:
            raise ValueError(f"{prop.text}: give nature's direction too, as in Pmaxmin=?.")
        nature = prop.nature
        question["nature"] = "cooperative" if nature == direction else "adversarial"
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

    problem = Certified(
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
        node=np.arange(host.num_states),
        shape=(host.num_states,),
    )
    is_formula = path["kind"] == "formula"
    return problem, prop.path if is_formula and isinstance(prop.path, Formula) else None


def nested(formula: Formula) -> str | list[object]:
    """A formula as the checker reads it: a label, or a list of an operator and its operands."""
    if formula.operator == "ap":
        return formula.proposition
    operands = [nested(x) for x in formula.operands]
    if formula.operator == "xor":
        return ["!", ["<->", *operands]]
    if formula.operator == "M":
        return ["U", operands[1], ["&", *operands]]
    return [formula.operator, *operands]


def _claims(
    problem: Certified,
    file: checker.CertificateFile,
    solution: Solution,
    improve: Improvement | None = None,
) -> list[dict[str, object]]:
    """Claims of reachability and rewards, of both sides where they have bounds."""
    steps, claims, host = problem.path.get("steps"), [], problem.host
    policy, name = np.asarray(solution.policy), ""
    rows: Integers = np.array(host.row_start[:-1], np.int64)
    if not host.is_chain and steps is None:
        if policy.size != host.num_states or not np.issubdtype(policy.dtype, np.integer):
            raise ValueError(
                "solution.policy is randomised or missing; expected an action of each state, or "
                "give it as policy=."
            )
        rows, name = row_of_action(problem.sparse, policy).astype(np.int64), "choices"
        choices = np.zeros(int(np.prod(problem.shape)), np.int64)
        choices[problem.node] = rows - host.row_start[:-1]
        store(file, name, choices, problem.shape)
    for side in problem.sides:
        bound = np.array(getattr(solution, side), np.float64).ravel()
        if bound.shape != (host.num_states,) or np.isnan(bound).any():
            raise ValueError(f"solution.{side} has shape {bound.shape}, or NaN; expected [S].")
        if isinstance(steps, int):
            claims.append(_step_claim(problem, file, side, bound, steps))
        elif side == "lower" or np.isfinite(bound[problem.initial]).any():
            value = np.array(solution.value).ravel()
            bounds = candidates(problem, side, bound, value, rows)
            claim = proven(problem, file, side, bounds, policy=name)
            claims.append(claim if improve is None else improve(problem, file, claim))
    return claims


def _step_claim(
    problem: Certified, file: checker.CertificateFile, side: str, bound: Floats, steps: int
) -> dict[str, object]:
    """A claim of values of all numbers of steps, by backward induction with rounding outwards."""
    host, sign = problem.host, 1 if side == "upper" else -1
    first, inside = host.row_start[:-1], ~problem.target & problem.stay
    is_max = np.where(problem.system, problem.objective, problem.directions[0]) == "max"
    ends = np.where(problem.target, float(problem.is_probability), 0.0)
    initial = problem.initial

    def bounds() -> Iterator[Floats]:
        for factor in SHIFTS:
            layers = [ends]
            for _ in range(steps):
                mean, _ = problem.means(layers[-1])
                scale = max(1.0, float(np.abs(mean).max()), float(np.abs(problem.gain).max()))
                most, least = (x.reduceat(mean, first) for x in (np.maximum, np.minimum))
                best = np.where(is_max, most, least)
                best = best + sign * 4 * factor * host.backup_unit * scale
                best = np.clip(best, 0, 1) if problem.is_probability else best
                layers.append(np.where(inside, best, ends))
            beyond = sign * (layers[-1] - bound)[initial]  # a proven bound may be wider by rounding
            if beyond.max(initial=0) > TIGHT * max(1.0, float(np.abs(bound[initial]).max())):
                raise ValueError(
                    f"no {side} bounds could be made inductive: they are beyond the values."
                )
            yield np.stack(layers, axis=1).ravel()

    shape = host.num_states, steps + 1
    counted = replace(problem, node=np.arange(shape[0] * shape[1]), shape=shape)
    return proven(counted, file, side, bounds(), initial * (steps + 1) + steps)


def _check_initial(solution: PyTree, model: Model, claims: list[dict[str, object]]) -> None:
    """Raises a ValueError if bounds of a solution contradict the claims in the initial states."""
    initial: Booleans | slice = slice(None)
    if solution.product_policy is None and np.ndim(solution.lower):
        initial = np.asarray(model.initial) > 0
    low, high = (
        np.array(x, np.float64, ndmin=1)[initial] for x in (solution.lower, solution.upper)
    )
    slack = TIGHT * max([1.0, *(abs(x) for x in (low.min(), high.max()) if np.isfinite(x))])
    for claim in claims:
        text = str(claim["bound"])
        bound = float("inf") if text == "inf" else float(Fraction(text))
        fits = (
            bound <= high.max() + slack if claim["side"] == "lower" else bound >= low.min() - slack
        )
        if not fits:
            raise ValueError(
                f"solution has the bounds {low.min()} and {high.max()}, which {claims} contradict."
            )
