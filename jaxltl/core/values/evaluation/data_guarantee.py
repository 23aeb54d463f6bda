"""Policies and guarantees for temporal-logic tasks from counted transitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxltl.core.models.refusals import on_host
from jaxltl.core.statistics.confidence_sets import (
    Graph,
    LeastProbability,
    describe_graph,
    require_graph,
)
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.counts import TransitionCounts, align_counts
from jaxltl.core.models.interval import IntervalMDP, make_interval
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.pretty_print import brief
from jaxltl.core.statistics.confidence_sets import ConfidenceSets, Method, intervals_from_counts
from jaxltl.core.types import require_shape
from jaxltl.core import validation
from jaxltl.core.validation import first_true
from jaxltl.core.models.protocols import RowModel
from jaxltl.core.values.interval.sides import require_objective
from jaxltl.core.values.interval.satisfaction import robust_satisfaction
from jaxltl.core.values.engine.state_quantities import safe_mean
from jaxltl.core.types import Solution


@brief
@dataclass(frozen=True)
class DataGuarantee:
    """A policy for a task, and bounds on its satisfaction probability with a confidence.

    Attributes:
      bound: lower bound on the satisfaction probability of the policy from the initial
        distribution (upper bound if it was minimised).
      confidence: probability, over the data, that all statements here are true, under `graph`.
      optimistic: bound that no policy exceeds, with the same confidence.
      satisfaction: the policy, its automaton, and nature's worst case.
      model: the interval model.
      sets: the confidence sets of its rows.
      gain: ``float64[R]``, first-order increase of the bound if a row's frequencies were exact.
      graph: the assumption on the graph.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [.5, .5, 1, 1], initial=[1, 0, 0],
      ...                    label=[[0], [1], [0]], propositions=["a"])
      >>> found = learn_guarantee(coin, np.array([900, 100, 0, 0]), "F a", confidence=0.95,
      ...                         graph="given")
      >>> 0.85 < found.bound < 0.9 < found.optimistic < 0.95, found.confidence
      (True, 0.95)
      >>> found.gain.argmax().item(), found.gain.shape  # sample choice 0
      (0, (3,))
    """

    bound: float
    confidence: float
    optimistic: float
    satisfaction: Solution
    model: IntervalMDP
    sets: ConfidenceSets
    gain: np.ndarray
    graph: Graph

    @property
    def assumption(self) -> str:
        """The assumption on the graph, in words."""
        return describe_graph(self.graph)


@on_host
def learn_guarantee(
    model: RowModel,
    counts: TransitionCounts | ConfidenceSets | np.ndarray,
    formula: FormulaLike,
    confidence: float,
    *,
    graph: Graph,
    method: Method | None = None,
    objective: str = "max",
    tolerance: float | None = None,
) -> DataGuarantee:
    """A policy for a temporal-logic task, with a guarantee from counted transitions.

    Simultaneous confidence sets of all rows
    (:func:`~jaxltl.core.statistics.confidence_sets.intervals_from_counts`) are an interval model.
    Its worst case bounds every policy, so that the policy may be optimised on the same data.

    Args:
      model: gives graph, labels and initial distribution, such as of
        :func:`~jaxltl.core.models.construct.counts.model_from_counts`; its probabilities are unused.
      counts: of its transitions, matched by name; or ``int[T]``, one for each of its entries; or
        confidence sets of its entries, from `intervals_from_counts`.
      formula: a formula, its text, or an automaton.
      confidence: in (0, 1), of all returned statements at once.
      graph: the assumption on the model's graph, required: ``"given"``, it is known; ``"seen"``,
        ``"complete"`` or :class:`~jaxltl.core.statistics.confidence_sets.LeastProbability`, as for
        `model_from_counts`.
      method: of counts; ``"anytime"`` (default) holds for adaptive sampling; ``"clopper-pearson"``,
        ``"hoeffding"`` and ``"weissman"`` need numbers of samples that do not depend on outcomes.
      objective: ``"max"`` or ``"min"``.
      tolerance: width of the enclosures of the interval model's values.

    Returns:
      :class:`DataGuarantee`. Concrete arrays only; not differentiable.

    Raises:
      ValueError: counts that do not match the model; an invalid confidence, label, direction or
        graph; a model that contradicts `graph`.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [.5, .5, 1, 1], initial=[1, 0, 0],
      ...                    label=[[0], [1], [0]], propositions=["a"])
      >>> found = learn_guarantee(coin, np.array([900, 100, 0, 0]), "F a", 0.95, graph="given",
      ...                         method="clopper-pearson")
      >>> round(found.bound, 3), round(found.optimistic, 3)
      (0.88, 0.918)
    """
    require_objective(objective)
    sparse = to_sparse(model)
    needed = _confidence_of_sets(sparse, graph, confidence)
    if isinstance(counts, ConfidenceSets):
        sets = counts
        require_shape("counts.lower", sets.lower, (sparse.num_transitions,))
        if method is not None or sets.confidence < needed:
            raise ValueError(
                f"counts are confidence sets by {sets.method}, of confidence {sets.confidence:g}; "
                f"leave method out, and make them with a confidence of at least {needed:g}."
            )
    else:
        sets = intervals_from_counts(
            align_counts(sparse, counts) if isinstance(counts, TransitionCounts) else counts,
            needed,
            method="anytime" if method is None else method,
            entry_start=sparse.entry_start,
        )
    if isinstance(graph, LeastProbability) and needed == confidence:
        sets = _without_unlikely(sparse, sets, graph.value)
    interval, aligned = _with_sets(sparse, sets)
    worst = robust_satisfaction(
        interval, formula, objective=objective, nature="adversarial", tolerance=tolerance
    )
    best = robust_satisfaction(
        interval, formula, objective=objective, nature="cooperative", tolerance=tolerance
    )
    share = np.asarray(interval.initial)
    share = share[share > 0]
    sure, optimistic = ("lower", "upper") if objective == "max" else ("upper", "lower")
    center = np.asarray(sets.center, np.float64)[aligned]
    sign = 1 if objective == "max" else -1
    return DataGuarantee(
        bound=safe_mean(share, getattr(worst, sure), up=objective != "max", highest=1),
        confidence=float(confidence),
        satisfaction=worst,
        optimistic=safe_mean(share, getattr(best, optimistic), up=objective == "max", highest=1),
        model=interval,
        sets=sets,
        gain=sign * _gain(interval, worst, center, share),
        graph=graph,
    )


def _confidence_of_sets(model: SparseMDP, graph: Graph, confidence: float) -> float:
    """Confidence left for probabilities, after the graph's share of the failures."""
    require_graph(graph)
    host = model.host
    width = np.diff(host.entry_start)
    loops = np.bincount(host.row, host.successor == host.state[host.row], host.num_rows) == width
    missing = (width < host.num_states) & ~loops
    if isinstance(graph, LeastProbability):
        if not missing.any():  # no transition was excluded by numbers of samples
            return confidence
        if not graph.failure < 1 - confidence:
            raise ValueError(
                f"graph.failure={graph.failure:g}; it must be below 1 - confidence, "
                f"{1 - confidence:g}."
            )
        return confidence + graph.failure
    if graph == "complete" and missing.any():
        row = int(np.argmax(missing))
        raise ValueError(
            f"graph='complete', but choice {row} has {width[row]} of {host.num_states} successors; "
            "give the assumption by which the model was made."
        )
    return confidence


def _without_unlikely(model: SparseMDP, sets: ConfidenceSets, least: float) -> ConfidenceSets:
    """The sets without probabilities between 0 and the least one of possible transitions.

    A transition with an upper bound below it is impossible, and one that was observed has at least
    this probability: in the event in which the sets hold, so that no failure is added.
    """
    if sets.radius is not None:
        return sets
    lower, upper = (np.asarray(x, np.float64) for x in (sets.lower, sets.upper))
    seen = np.asarray(sets.center, np.float64) * sets.num_samples[model.host.row] > 0.5
    unlikely = (upper < least) & (seen | (lower > 0))
    for entry in first_true(unlikely):
        row = model.host.row[entry]
        raise ValueError(
            f"graph: with the confidence asked for, the transition of choice {row} to state "
            f"{model.host.successor[entry]} has a probability of at most {upper[entry]:.3g}, below "
            f"the least probability {least:g}; assume a smaller one."
        )
    return replace(
        sets,
        lower=np.where(seen, np.maximum(lower, np.nextafter(least, 0)), lower),
        upper=np.where(upper < least, 0, upper),
    )


def _with_sets(model: SparseMDP, sets: ConfidenceSets) -> tuple[IntervalMDP, np.ndarray]:
    """The interval model, with all transitions of the model."""
    ball = {} if sets.radius is None else {"center": sets.center, "radius": sets.radius}
    interval = make_interval(model, sets.lower, sets.upper, **ball)
    if interval.num_transitions == model.num_transitions:
        return interval, np.ones(model.num_transitions, bool)
    code = [
        np.asarray(x.host.row, np.int64) * model.num_states + x.successor
        for x in (model, interval.nominal)
    ]
    return interval, np.isin(*code)


def _gain(
    model: IntervalMDP, satisfaction: Solution, center: np.ndarray, share: np.ndarray
) -> np.ndarray:
    """Expected visits of each row times the loss to nature there: ``float64[R]``."""
    from scipy.sparse import csr_array, eye_array
    from scipy.sparse.linalg import spsolve

    on_product = satisfaction.product_policy
    assert on_product is not None
    product, value, policy = on_product.product, on_product.value, on_product.row
    host = product.host
    taken = product.base_row == policy[host.state]
    entry = taken[host.row]
    nature = np.asarray(satisfaction.nature)
    open_ = (value > 0) & (value < 1)
    # Under this nature every undecided state is left almost surely.
    inner = entry & open_[host.state[host.row]] & open_[host.successor] & (nature > 0)
    size = host.num_states
    step = csr_array(
        (nature[inner], (host.successor[inner], host.state[host.row][inner])), shape=(size, size)
    )
    first = np.zeros(size)
    np.add.at(first, product.start, share)
    visits = spsolve((eye_array(size) - step).tocsc(), np.where(open_, first, 0))
    world = model.nominal.host
    width = np.diff(host.entry_start)
    whole = width == np.diff(world.entry_start)[product.base_row]
    begin = world.entry_start[product.base_row]
    rank = np.arange(host.num_transitions) - np.repeat(host.entry_start[:-1], width)
    known = np.where(whole[host.row], center[(np.repeat(begin, width) + rank)], nature)
    better = np.add.reduceat((known - nature) * value[host.successor], host.entry_start[:-1])
    gain = np.zeros(world.num_rows)
    use = taken & open_[host.state] & whole
    np.add.at(gain, product.base_row[use], (visits[host.state] * better)[use])
    return gain


@on_host
def guarantee_curve(
    model: RowModel,
    counts: TransitionCounts | np.ndarray,
    formula: FormulaLike,
    confidence: float,
    sizes: Sequence[int],
    *,
    graph: Graph,
    seed: int = 0,
    method: Method = "anytime",
    objective: str = "max",
) -> np.ndarray:
    """Guaranteed bounds for random subsets of the data of given sizes.

    The subsets are the prefixes of one random order of the data.

    Args:
      model, counts, formula, confidence, graph, method, objective: see :func:`learn_guarantee`; the
        confidence is that of each single point.
      sizes: numbers of transitions.
      seed: of the order.

    Returns:
      ``float64[len(sizes)]``, in the order of `sizes`. Concrete arrays only; not differentiable.

    Raises:
      ValueError: a size is negative or larger than the data; or as :func:`learn_guarantee`.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [.5, .5, 1, 1], initial=[1, 0, 0],
      ...                    label=[[0], [1], [0]], propositions=["a"])
      >>> curve = guarantee_curve(coin, np.array([900, 100, 0, 0]), "F a", 0.95, [10, 100, 1000],
      ...                         graph="given")
      >>> curve.shape, bool((np.diff(curve) > 0).all())
      ((3,), True)
    """
    sparse = to_sparse(model)
    every = align_counts(sparse, counts) if isinstance(counts, TransitionCounts) else counts
    every, wanted = np.asarray(every), np.asarray(sizes)
    for name, x in (("counts", every), ("sizes", wanted)):
        if x.ndim != 1 or x.dtype.kind not in "iuf" or (x != np.floor(x)).any():
            raise ValueError(f"{name} is {x.dtype}{list(x.shape)}; expected a list of integers.")
    if (every < 0).any():
        raise ValueError(f"counts[{int(np.argmax(every < 0))}] is {every.min()}; none is negative.")
    every = every.astype(np.int64)
    total = int(every.sum())
    wrong = (wanted < 0) | (wanted > total)
    if wrong.any():
        raise ValueError(
            f"sizes[{int(np.argmax(wrong))}] is {wanted[wrong][0]}; there are {total} transitions."
        )
    rng = np.random.default_rng(validation.integer("seed", seed))
    bound = np.empty(wanted.size)
    for i in np.argsort(-wanted, kind="stable"):
        every = rng.multivariate_hypergeometric(every, int(wanted[i]), method="marginals")
        bound[i] = learn_guarantee(
            sparse, every, formula, confidence, graph=graph, method=method, objective=objective
        ).bound
    return bound
