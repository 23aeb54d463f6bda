"""Preprocessing of questions for solves with other probabilities and rewards."""

from __future__ import annotations


import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import validation
from jaxltl.core import struct

from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.mesh.sharded import refuse_sharded
from jaxltl.core.models.refusals import of_one_player
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.protocols import Array, Model, PyTree
from jaxltl.core.models.sparse import Rewards, SparseMDP, refuse_underflow
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.prepared.reachability_plan import Plan, plan_optimum, plan_policy
from jaxltl.core.sparse.solvers.reachability import reduce_reachability, reduce_total_reward
from jaxltl.core.values.prepared.block_iteration import Blocks
from jaxltl.core.values.engine.row_form import row_form
from jaxltl.core.values.engine.state_quantities import nonnegative_reward
from jaxltl.core.values.interval.sides import refuse_nature
from jaxltl.core.values.prepared.prepared_interval import PreparedInterval, prepare_interval


@brief
@struct.dataclass
class Prepared:
    """Preprocessed question about a model, for solves with other numbers.

    Result of :func:`prepare`, argument of :func:`solve_prepared`. Pass it to compiled functions as an
    argument; a closed-over one becomes part of the program.

    Attributes:
      segments: the blocks.
      place: ``int32[S]``, the place of a state's value.
      nodes: ``int32[M]``, the places with rows; others fill blocks.
      own: ``int32[S]``, the place from which a state takes its row, or -1.
      row: ``int32[S]``, the row that it takes else.
      entry_row, row_state: ``int32[T]`` and ``int32[R]``, row of a transition, state of a row.
      action: ``int32[R]``, the action number of a row.
      probability, reward: ``float[T]`` and ``float[R]``, as they were.
      loops: self-loops: entries, groups, rows, groups of these; or None.
      cycles: end components that are one node, or None.
      question: ``"probability"`` or ``"reward"``, static.
      objective: ``"max"``, ``"min"`` or ``"policy"``, static.
      cyclic: True if some nodes are on cycles, static.
      levels, choices, terms, groups: see the plan, static.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> prepared = prepare(coin, [False, True, False])
      >>> prepared.question, prepared.objective, prepared.num_states, prepared.num_rows
      ('probability', 'max', 3, 3)
    """

    segments: tuple[Blocks, Blocks, Blocks]
    place: jax.Array
    nodes: jax.Array
    own: jax.Array
    row: jax.Array
    entry_row: jax.Array
    row_state: jax.Array
    action: jax.Array
    probability: jax.Array
    reward: jax.Array | None
    loops: tuple[jax.Array, ...] | None
    cycles: tuple[jax.Array, ...] | None
    question: str = struct.field(pytree_node=False)
    objective: str = struct.field(pytree_node=False)
    cyclic: bool = struct.field(pytree_node=False)
    levels: int = struct.field(pytree_node=False)
    choices: int = struct.field(pytree_node=False)
    terms: int = struct.field(pytree_node=False)
    groups: int = struct.field(pytree_node=False)

    @property
    def num_states(self) -> int:
        """S, of the model."""
        return self.place.shape[-1]

    @property
    def num_rows(self) -> int:
        """R, of the model."""
        return self.row_state.shape[-1]

    @property
    def size(self) -> int:
        """Number N of places."""
        return self.segments[2].last


@of_one_player
def prepare(
    model: Model | IntervalMDP,
    target: Array | str,
    *,
    stay: Array | str | None = None,
    reward: str | Rewards | chex.Array | None = None,
    policy: chex.Array | None = None,
    objective: str = "max",
    nature: str | None = None,
) -> Prepared | PreparedInterval:
    """Prepares a question about a model for solves with other numbers inside ``jit``.

    Contracts chains of single successors and end components, removes states of value 0, 1 or
    infinity, and orders the others in blocks of equal shape, in reverse topological order.

    Args:
      model: a concrete model of one player.
      target: ``bool[S]``, a label's name, or a Boolean formula of labels.
      stay: in the same forms, the states that may be passed before; default all. Not with a reward.
      reward: asks for the expected total reward until the target and not for the probability of
        reaching it; as of :func:`~jaxltl.core.models.sparse.choice_reward`, finite and at least 0.
      policy: of an IntervalMDP, actions ``int32[S]`` to be evaluated; default: optimise.
      objective: ``"max"``, ``"min"``, or ``"policy"`` for values of policies that are given later.
      nature: of an IntervalMDP, ``"adversarial"`` (default) or ``"cooperative"``.

    Returns:
      A pytree of arrays. The support and the rewards that are zero are fixed. Not differentiable;
      :func:`solve_prepared` is.

    Raises:
      ValueError: a shape or the objective is wrong, a reward is negative or not finite, there is
        `stay` with a reward, or something is traced.

    Example:
      >>> from jaxltl import make_sparse, solve_prepared
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> prepared = prepare(coin, [False, True, False])
      >>> solve = jax.jit(lambda p: solve_prepared(prepared, probability=p).value[0])
      >>> round(solve(jnp.array([0.25, 0.75, 1, 1])).item(), 3)
      0.25
    """
    refuse_sharded(model)
    if stay is not None and reward is not None:
        raise ValueError("expected rewards are until the target alone: leave stay out.")
    if is_traced((model, target, stay, reward, policy)):
        raise ValueError(
            "prepare reads its model, so it works on concrete arrays only; call it "
            "before jit, and solve_prepared inside."
        )
    form = row_form(model)
    if form.interval is not None:
        return prepare_interval(
            form.interval,
            form.states("target", target),
            stay=None if stay is None else form.states("stay", stay),
            reward=None if reward is None else form.reward(reward),
            policy=None if policy is None else np.ravel(policy) if form.shape[1:] else policy,
            objective=objective,
            nature=nature,
        )
    refuse_nature(nature)
    if policy is not None:
        raise ValueError(
            'policy is for models with intervals; prepare with objective="policy" and give the '
            "policy to solve_prepared."
        )
    validation.choice("objective", objective, ("max", "min", "policy"))
    sparse, host, target = form.sparse, form.host, form.states("target", target)
    if stay is not None:
        stay = form.states("stay", stay)
    cost = (
        None
        if reward is None
        else nonnegative_reward(sparse, form.reward(reward), "prepared solves")
    )
    if objective == "policy":
        plan = plan_policy(host, target, stay, cost)
    elif cost is None:
        plan = plan_optimum(
            reduce_reachability(host, target, maximize=objective == "max", stay=stay), None
        )
    else:
        earning = host.over_choices(np.maximum, cost) > 0
        plan = plan_optimum(
            reduce_total_reward(host, cost, target, maximize=objective == "max", kept=earning), cost
        )
    return _prepared(sparse, plan, cost, objective)


def _prepared(sparse: SparseMDP, plan: Plan, cost: np.ndarray | None, objective: str) -> Prepared:
    """The arrays of a plan; solves fill in the weights of its blocks."""
    host = sparse.host
    dtype = jnp.zeros(()).dtype
    refuse_underflow(host.row_start, host.entry_start, host.probability, dtype)
    nothing = host.num_transitions + host.num_rows + 1
    blocks, nodes, first = [], [], 0
    for part in plan.schedule.segments:
        full = (part.source != nothing).any((1, 2)).ravel()
        nodes.append(first + np.flatnonzero(full))
        blocks.append(Blocks(part.target, part.source, None, part.name, first))
        first = blocks[-1].last
    loops = None if plan.loops is None else tuple(x.astype(np.int32) for x in plan.loops[:4])
    cycles = None if plan.cycles is None else tuple(x.astype(np.int32) for x in plan.cycles)
    arrays: dict[str, PyTree] = {
        "segments": tuple(blocks),
        "place": plan.place,
        "nodes": np.concatenate(nodes).astype(np.int32),
        "own": plan.own,
        "row": plan.row,
        "entry_row": host.row.astype(np.int32),
        "row_state": host.state.astype(np.int32),
        "action": row_actions(sparse).astype(np.int32),
        "probability": host.probability.astype(dtype),
        "reward": None if cost is None else cost.astype(dtype),
        "loops": loops,
        "cycles": cycles,
    }
    return Prepared(
        **to_jax(arrays),
        question="probability" if cost is None else "reward",
        objective=objective,
        cyclic=plan.schedule.segments[1].target.size > 0,
        levels=plan.schedule.levels,
        choices=plan.schedule.choices,
        terms=plan.terms + blocks[0].target.shape[2],
        groups=0 if plan.loops is None else plan.loops.groups,
    )
