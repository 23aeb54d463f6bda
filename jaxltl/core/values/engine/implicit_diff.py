"""Implicit derivatives of fixed points, and linear systems of absorbing chains for them.

The condition of ``(I - P_pi) x = b`` grows with the expected number of steps, so a Krylov method
alone stagnates. Small systems are inverted; large ones are eliminated on the host, where sparse
elimination loses no more digits than the number of steps costs; those over a mesh are solved by
refined BiCGSTAB.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxltl.core.graphs.end_components import recurrent_states
from jaxltl.core.graphs.graph import TracedGraph, state_numbers
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.ops.array_namespace import host_callback
from jaxltl.core.models.ops.operators import (
    action_mean,
    combined,
    expectation,
    flat_transitions,
    is_deterministic,
    policy_distribution,
)
from jaxltl.core.models.protocols import ActionModel, PyTree, base_model
from jaxltl.core.sparse.linear.elimination import factorize
from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components
from jaxltl.core.values.engine.iterate import sequential_vmap
from jaxltl.core.values.engine.linear import (
    DENSE_LIMIT,
    Operator,
    inverse,
    norm,
    solve_linear,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_FAST_STEPS = 256  # of a Krylov method, which suffice for chains that mix well


class LinearSystem(Protocol):
    """Solvers of a linear system and of its transpose; a tree of arrays."""

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution for a right-hand side."""

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""


def implicit(
    operator: Operator, fixed_point: jax.Array, system: LinearSystem | None = None
) -> jax.Array:
    """A fixed point ``v = operator(v)`` with its implicit derivatives of any order."""
    # The result is differentiable, forward and reverse, in everything that `operator` closes over:
    # ``dv = (I - J)^-1 d(operator)`` with J the Jacobian in v (implicit function theorem). No
    # iteration is unrolled; each derivative solves one linear system ``I - J``, or its transpose,
    # by a Krylov method if none is given.
    fixed_point, system = lax.stop_gradient((fixed_point, system))
    # The system is traced only where a derivative is taken; ``lax.custom_root`` traces it in any
    # case, which is half of a solver's trace.
    closed = jax.make_jaxpr(operator)(fixed_point)

    def image(constants: list[jax.Array], v: jax.Array, _: PyTree) -> jax.Array:
        result: jax.Array = jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, constants))(v)[0]
        return result

    return attach_derivative(image, closed.consts, fixed_point, system, lambda system, _: system)


def attach_derivative(
    image: Callable[[PyTree, jax.Array, PyTree], jax.Array],
    parameters: PyTree,
    fixed_point: jax.Array,
    known: PyTree,
    system_at: Callable[[PyTree, jax.Array], LinearSystem | None],
) -> jax.Array:
    """A fixed point of ``image(parameters, v, system)`` with its derivatives in the parameters."""
    # `known` has no derivatives; ``system_at(known, v)`` is evaluated in the rule only.

    @jax.custom_jvp
    def root(parameters: PyTree, known: PyTree, v: jax.Array) -> jax.Array:
        return v

    def rule(primals: PyTree, tangents: PyTree) -> tuple[jax.Array, jax.Array]:
        parameters, known, v = primals
        # The value in the rule is a root again, so that the rule has derivatives.
        v = root(parameters, known, v)
        system = lax.stop_gradient(system_at(known, lax.stop_gradient(v)))
        leaves, form = jax.tree.flatten(parameters)
        changes = jax.tree.leaves(tangents[0], is_leaf=lambda x: isinstance(x, SymbolicZero))
        # Only parameters with a derivative count, which is cheaper, above all in lanes.
        moved = [i for i, x in enumerate(changes) if not isinstance(x, SymbolicZero)]

        def of_moved(*values: jax.Array) -> jax.Array:
            new = dict(zip(moved, values, strict=True))
            full = [new.get(i, x) for i, x in enumerate(leaves)]
            return image(jax.tree.unflatten(form, full), v, system)

        change = jnp.zeros_like(v)
        if moved:
            _, change = jax.jvp(
                of_moved, tuple(leaves[i] for i in moved), tuple(changes[i] for i in moved)
            )
        _, jacobian = jax.linearize(lambda x: image(parameters, x, system), v)
        return v, _solved(system, lambda x: x - jacobian(x), change)

    root.defjvp(rule, symbolic_zeros=True)
    result: jax.Array = root(parameters, known, fixed_point)
    return result


def _solved(system: LinearSystem | None, matvec: Operator, b: jax.Array) -> jax.Array:
    result: jax.Array = lax.custom_linear_solve(
        matvec,
        b,
        solve=solve_linear if system is None else lambda _, b: system.solve(b),
        transpose_solve=(
            solve_linear if system is None else lambda _, b: system.transpose_solve(b)
        ),
    )
    return result


class ChainSystem(NamedTuple):
    """The system ``x - mask * P_pi x``."""

    model: ActionModel  # a padded model or a product of one
    policy: jax.Array  # ``float[S, A]`` or ``int32[S]``
    mask: jax.Array  # ``bool[S]``, transient states

    def image(
        self, x: jax.Array, reward: jax.Array | float = 0, outside: jax.Array | float = 0
    ) -> jax.Array:
        """``(r + P x)_pi`` in the transient states, `outside` elsewhere."""
        ahead = action_mean(self.policy, reward + expectation(self.model, x))
        return jnp.where(self.mask, ahead, outside)

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution of the system."""
        return self._solve(lambda x: x - self.image(x), b, False)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        back = jax.vjp(self.image, jnp.zeros_like(b))[1]
        return self._solve(lambda y: y - back(y)[0], b, True)

    def _solve(self, matvec: Operator, b: jax.Array, transposed: bool) -> jax.Array:
        if is_sharded(self.model):
            return solve_linear(matvec, b, patient=True)
        x = solve_linear(matvec, b, max_steps=_FAST_STEPS)
        size = norm(b.ravel())
        # The norm of the inverse, and so the relative error, is at least that of x over that of b.
        error = norm((b - matvec(x)).ravel()) * jnp.maximum(norm(x.ravel()), size)
        accurate = error <= float(jnp.finfo(b.dtype).eps) ** 0.7 * size**2  # false for NaN
        return _unless(accurate, x, lambda: self._direct(matvec, b, transposed))

    def _direct(self, matvec: Operator, b: jax.Array, transposed: bool) -> jax.Array:
        """The solution by inversion if the system is small, else by elimination on the host."""
        if b.size <= DENSE_LIMIT:
            eye = jnp.eye(b.size, dtype=b.dtype).reshape(b.size, *b.shape)
            matrix = lax.map(matvec, eye, batch_size=min(b.size, 32)).reshape(b.size, b.size).T
            inverted, right = sequential_vmap(inverse, matrix), b.ravel()
            x: jax.Array = inverted @ right
            x += inverted @ (right - matrix @ x)
            return x.reshape(b.shape)
        result = jax.ShapeDtypeStruct(b.shape, b.dtype)
        x = host_callback(_eliminated(transposed), result, self, b)
        return _unless(jnp.all(jnp.isfinite(x)), x, lambda: solve_linear(matvec, b, patient=True))


class _TransientChain(NamedTuple):
    """The system of a chain's transient states, for :func:`with_derivative`; no derivatives."""

    # Decided states lead to decided ones only, so the system is block triangular. Its decided part
    # is solved, on the host, only where it matters, which is seldom.

    undecided: ChainSystem
    target: jax.Array  # ``bool[S]``
    one: jax.Array  # ``float[S]``, 1 where the target is reached almost surely
    inverse: LinearSystem | None  # of the system of the undecided states

    @property
    def decided(self) -> jax.Array:
        """``bool[S]``, without the target."""
        return ~self.undecided.mask & ~self.target

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution of the system; 0 in recurrent states without a target."""
        first = jnp.where(self.decided, b, 0)
        x = self._decided_part(jnp.any(first != 0) & self._opens(), first, False)
        known = self.undecided if self.inverse is None else self.inverse
        return known.solve(jnp.where(self.decided, x, b))

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        known = self.undecided if self.inverse is None else self.inverse
        y = known.transpose_solve(b)
        return jnp.where(self.decided, self._decided_part(self._opens(), y, True), y)

    def _opens(self) -> jax.Array:
        """``bool[]``, whether derivatives in decided states may differ from 0."""
        # They do if a state that is not absorbing lists a successor whose value is of another kind;
        # its probability is 0, or that of its action.
        model, policy, undecided = self.undecided
        if not _lists_successors(model):
            return jnp.any(self.decided & (self.one > 0))
        kind = jnp.where(undecided, 4, jnp.where(self.one > 0, 2, 1)).astype(jnp.int32)
        kinds = combined(model, kind, _kind_of_listed, jnp.bitwise_or)
        taken = policy_distribution(model, policy) > 0
        possible = taken if is_deterministic(policy) else model.available
        leads = jnp.any(possible & (kinds & ~kind[..., None] != 0), axis=-1)
        number, graph = state_numbers(kind.shape), TracedGraph(model)
        least, greatest = graph.least(number), -graph.least(-number)
        stays = (least == number[..., None]) & (greatest == number[..., None])
        return jnp.any(self.decided & leads & jnp.any(taken & ~stays, axis=-1))

    def _decided_part(self, needed: jax.Array, b: jax.Array, transposed: bool) -> jax.Array:
        """The solution in decided states that are transient, 0 elsewhere."""
        model, policy, _ = self.undecided
        chain = self.undecided._replace(mask=self.decided)
        result = jax.ShapeDtypeStruct(b.shape, b.dtype)

        def on_host() -> jax.Array:
            # The chain by its entries, since each array of a callback costs time.
            successor, probability = flat_transitions(model)
            size, taken = len(successor), policy_distribution(model, policy)
            weight = (taken.reshape(size, -1, 1) * probability).reshape(size, -1)
            arguments = (needed, successor.reshape(size, -1), weight, self.decided, self.one, b)
            x: jax.Array = host_callback(_solved_transient(transposed), result, *arguments)
            return x

        def by_sweeps() -> jax.Array:
            keep = self.decided & (self.one > 0)
            if _lists_successors(model):
                region, taken = self.decided & ~keep, policy_distribution(model, policy) > 0
                keep |= region & ~recurrent_states(TracedGraph(model), region, taken)
            transient = chain._replace(mask=keep)
            solve = transient.transpose_solve if transposed else transient.solve
            return jnp.where(keep, solve(jnp.where(keep, b, 0)), 0)

        swept = is_sharded(model) or not _lists_successors(model)
        return _unless(~needed, jnp.zeros_like(b), by_sweeps if swept else on_host)


def _lists_successors(model: ActionModel) -> bool:
    """False for a user's model without the reduction over successors."""
    return combined.dispatch(type(base_model(model))) is not combined.dispatch(object)


def _kind_of_listed(weight: jax.Array, kind: jax.Array) -> jax.Array:
    """The kind of a listed successor, also of one of probability 0."""
    return jnp.where(weight >= 0, kind, 0)


def with_derivative(
    value: jax.Array,
    chain: ChainSystem,
    *,
    target: jax.Array,
    one: jax.Array,
    inverse: LinearSystem | None = None,
) -> jax.Array:
    """Reachability probabilities of a policy with their derivatives, also in decided states."""
    # ``x = P_pi x`` in transient states, and 1 in the target. In states of closed classes without a
    # target x is 0 as long as the support stays, and its derivative too. That of an optimum is the
    # derivative of the policy that attains it (Danskin). Where the target is reached almost surely,
    # the equation is that of ``1 - x``, so that entries within the support do not count.
    known: _TransientChain = lax.stop_gradient(_TransientChain(chain, target, one, inverse))

    def image(
        parameters: tuple[ActionModel, jax.Array], v: jax.Array, system: _TransientChain
    ) -> jax.Array:
        (model, policy), one = parameters, system.one
        ahead = expectation(model, v) - one[..., None] * expectation(model, jnp.ones_like(v))
        return jnp.where(system.target, one, one + action_mean(policy, ahead))

    return attach_derivative(
        image, (chain.model, chain.policy), value, known, lambda known, _: known
    )


def _unless(done: jax.Array, x: jax.Array, otherwise: Callable[[], jax.Array]) -> jax.Array:
    """x if `done`, else ``otherwise()``, which a batch evaluates only if some lane needs it."""
    # A loop of at most one step: ``lax.cond`` with a batched predicate evaluates both branches, and
    # batches all that they close over.

    def body(_: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return jnp.ones_like(done), otherwise()

    return lax.while_loop(lambda state: ~state[0], body, (done, x))[1]


def _eliminated(transposed: bool) -> Callable[..., np.ndarray]:
    def solve(system: ChainSystem, b: np.ndarray) -> np.ndarray:
        x = _solution(_transitions(system), b.astype(np.float64).ravel(), transposed)
        return x.reshape(b.shape)

    return solve


def _solved_transient(transposed: bool) -> Callable[..., np.ndarray]:
    from scipy.sparse import csr_array

    def solve(needed: np.ndarray, *arguments: np.ndarray) -> np.ndarray:
        successor, weight, decided, one, b = arguments
        if not needed:
            return np.zeros(b.shape)
        size, width = successor.shape
        entries = weight.astype(np.float64).ravel(), successor.ravel(), width * np.arange(size + 1)
        chain = _rows_of(csr_array(entries, shape=(size, size)), decided)
        chain.sum_duplicates()
        label = ordered_components(Edges(chain.indptr, chain.indices))
        source = label[np.repeat(np.arange(b.size), np.diff(chain.indptr))]
        left = np.isin(label, source[source != label[chain.indices]])
        keep = decided.ravel() & (left | (one.ravel() > 0))
        right = np.where(keep, b.astype(np.float64).ravel(), 0)
        x = _solution(_rows_of(chain, keep), right, transposed)
        return np.where(keep, x, 0).reshape(b.shape)

    return solve


def _rows_of(chain: csr_array, states: np.ndarray) -> csr_array:
    """The rows of a set of states; the others are empty."""
    from scipy.sparse import diags_array

    rows = (diags_array(states.ravel().astype(np.float64)) @ chain).tocsr()
    rows.eliminate_zeros()
    return rows


def _transitions(system: ChainSystem) -> csr_array | None:
    """``float64[N, N]``, the chain on transient states, SciPy's; None if rows are invalid."""
    from scipy.sparse import csr_array

    try:
        sparse = to_sparse(system.model)
    except ValueError:
        return None
    host, policy = sparse.host, system.policy
    if policy.ndim == system.mask.ndim:
        weight = policy.ravel()[host.state] == np.asarray(sparse.action)
    else:
        weight = policy.reshape(host.num_states, -1)[host.state, np.asarray(sparse.action)]
    rows = np.arange(host.num_rows)
    mix = csr_array(
        (weight.astype(np.float64), rows, host.row_start), shape=(host.num_states, host.num_rows)
    )
    chain = (mix @ host.matrix).tocsr()
    return _rows_of(chain, np.asarray(system.mask))


def _solution(chain: csr_array | None, b: np.ndarray, transposed: bool) -> np.ndarray:
    """The solution by sparse elimination, refined once; NaN where that failed."""
    failed = np.full(b.size, np.nan)
    if chain is None:
        return failed
    matrix = chain.T.tocsr() if transposed else chain
    matrix.sort_indices()
    label = ordered_components(Edges(matrix.indptr, matrix.indices))
    solver = factorize(matrix, label, np.arange(b.size))
    if solver is None:
        return failed
    x = solver.solve(b)
    return x + solver.solve(b + matrix @ x - x)
