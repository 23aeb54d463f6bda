"""Stochastic dynamics in continuous spaces: ``x' = step(x, u, w)`` in a box, with labelled regions.

The same object is the model of proofs (:mod:`jaxltl.core.continuous`) and, by
:func:`to_environment`, an environment of every learner.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import validation
from jaxltl.core.continuous.noise import Distribution
from jaxltl.core.continuous.regions import Region, UndefinedError, as_region, box, extended
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Finite,
    Timestep,
    make_box,
    make_environment,
    traced,
)
from jaxltl.core.pretty_print import brief

Floats = NDArray[np.float64]
Bounds = tuple[Floats, Floats]
Step = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]

OUTSIDE = ("violates", "clip")


@brief
@dataclass(frozen=True, eq=False)
class Dynamics:
    """Stochastic dynamics in a box; :func:`make_dynamics` builds checked ones.

    Attributes:
      step: ``(float[n], float[m], float[k]) -> float[n]``, the successor of a state.
      domain: ``(low, high)``, ``float64[n]`` each; a closed box.
      noise: distributions of the first coordinates of the third argument.
      disturbance: ``(low, high)`` of its other coordinates, chosen by an adversary, or None.
      actions: ``(low, high)``, ``float64[m]`` each; ``float64[A, m]``, a grid; or None for m = 0.
      labels: regions by proposition; box edges at the domain's edges are at infinity.
      outside: ``"violates"``, ``"clip"``, or the proposition that holds forever outside.
      initial: boxes of the initial states, inside the domain.

    Example:
      >>> from jaxltl.core.continuous.noise import gaussian
      >>> walk = make_dynamics(
      ...     lambda x, u, w: x + u + w, domain=([-2.0], [2.0]), noise=gaussian(0.1),
      ...     actions=([-0.5], [0.5]), labels={"goal": ([1.0], [2.0])})
      >>> walk.num_states, walk.num_actions, walk.num_noise, walk.propositions
      (1, 1, 1, ('goal',))
    """

    step: Step
    domain: Bounds
    noise: tuple[Distribution, ...]
    disturbance: Bounds | None
    actions: Bounds | Floats | None
    labels: Mapping[str, Region]
    outside: str
    initial: Region

    @property
    def num_states(self) -> int:
        """n, the number of state coordinates."""
        return len(self.domain[0])

    @property
    def num_actions(self) -> int:
        """m, the number of action coordinates."""
        if isinstance(self.actions, np.ndarray):
            return int(self.actions.shape[1])
        return 0 if self.actions is None else len(self.actions[0])

    @property
    def num_noise(self) -> int:
        """k, the number of coordinates of noise and disturbance together."""
        return len(self.noise) + (0 if self.disturbance is None else len(self.disturbance[0]))

    @property
    def propositions(self) -> tuple[str, ...]:
        """Names of the labels; with that of the outside, last, if no region has it."""
        own = self.outside not in (*OUTSIDE, *self.labels)
        return (*self.labels, self.outside) if own else tuple(self.labels)

    @cached_property
    def environment(self) -> Environment:
        """The result of :func:`to_environment`, by which every learner accepts the dynamics."""
        return to_environment(self)

    def inside(self, state: jax.Array) -> jax.Array:
        """``bool[]``: the state ``float[n]`` lies in the domain; no derivative."""
        low, high = (jnp.asarray(x, state.dtype) for x in self.domain)
        return ((low <= state) & (state <= high)).all(-1)

    def label(self, state: jax.Array) -> jax.Array:
        """``bool[P]``: the propositions that hold in a state ``float[n]``; no derivative."""
        inside = self.inside(state)
        held = [
            (self.labels[name].contains(state) & inside if name in self.labels else False)
            | (~inside if name == self.outside else False)
            for name in self.propositions
        ]
        return jnp.stack(held) if held else jnp.zeros(0, bool)

    def sample_noise(self, key: chex.PRNGKey, disturbance: ArrayLike | None = None) -> jax.Array:
        """``float[k]``: a sample of the noise, with a given or a uniform disturbance; differentiable
        in the disturbance."""
        first, *keys = jax.random.split(key, len(self.noise) + 1)
        drawn = [one.sample(each) for one, each in zip(self.noise, keys, strict=True)]
        random = jnp.stack(drawn) if drawn else jnp.zeros(0)
        if self.disturbance is None:
            return random
        low, high = (jnp.asarray(x, random.dtype) for x in self.disturbance)
        if disturbance is None:
            chosen = jax.random.uniform(first, low.shape, random.dtype, low, high)
        else:
            chosen = jnp.clip(jnp.asarray(disturbance, random.dtype), low, high)
        return jnp.concatenate([random, chosen])

    def next_state(
        self,
        key: chex.PRNGKey,
        state: jax.Array,
        action: jax.Array,
        disturbance: ArrayLike | None = None,
    ) -> jax.Array:
        """``float[n]``: a sampled successor; clipped to the domain if `outside` is ``"clip"``.

        Differentiable in state, action and disturbance; the latter is uniform by default.
        """
        noise = self.sample_noise(key, disturbance).astype(state.dtype)
        successor = jnp.asarray(self.step(state, action, noise), state.dtype)
        if self.outside != "clip":
            return successor
        return jnp.clip(successor, *(jnp.asarray(x, state.dtype) for x in self.domain))

    def sample_initial(self, key: chex.PRNGKey) -> jax.Array:
        """``float[n]``: an initial state, uniform in a box that is chosen by its volume."""
        low, high = self.initial.low, self.initial.high
        which, place = jax.random.split(key)
        volume = np.log(high - low).sum(axis=1)
        i = jax.random.categorical(which, jnp.asarray(volume, float))
        first, last = jnp.asarray(low, float)[i], jnp.asarray(high, float)[i]
        return first + (last - first) * jax.random.uniform(place, first.shape, first.dtype)


def make_dynamics(
    step: Step,
    *,
    domain: tuple[ArrayLike, ArrayLike],
    labels: Mapping[str, Region | tuple[ArrayLike, ArrayLike]],
    noise: Distribution | Sequence[Distribution] = (),
    disturbance: tuple[ArrayLike, ArrayLike] | None = None,
    actions: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    outside: str = "violates",
    initial: Region | tuple[ArrayLike, ArrayLike] | None = None,
) -> Dynamics:
    """Checked stochastic dynamics ``x' = step(x, u, w)`` in a box.

    Args:
      step: JAX function ``(state float[n], action float[m], noise float[k]) -> float[n]``; noise
        holds the random coordinates, then those of the disturbance.
      domain: ``(low, high)``, finite.
      labels: by proposition, a :class:`~jaxltl.core.continuous.regions.Region` or ``(low, high)``. A
        box edge at or beyond the domain's edge includes the domain's closed boundary.
      noise: a :class:`~jaxltl.core.continuous.noise.Distribution`, or one for each random coordinate.
      disturbance: ``(low, high)`` of a bounded disturbance, chosen by an adversary.
      actions: ``(low, high)``, a tuple, for a box of actions; an array ``float[A, m]`` for a grid.
      outside: ``"violates"``: leaving the domain violates every task that the labels of the run have
        not satisfied before, whatever their continuation; ``"clip"``: successors are clipped; or the
        name of a label that holds forever outside, where no other label holds.
      initial: a :class:`~jaxltl.core.continuous.regions.Region` of boxes, or ``(low, high)``; default:
        the domain.

    Returns:
      :class:`Dynamics`.

    Raises:
      ValueError: a step that cannot be traced, has a result of another shape, or is NaN in the
        domain; bounds that cross or of other shapes; a label without states in the domain.

    Example:
      >>> from jaxltl import task_environment
      >>> lake = make_dynamics(
      ...     lambda x, u, w: x + 0.1 * u, domain=([0.0], [1.0]), actions=[[-1.0], [1.0]],
      ...     labels={"shore": ([0.9], [1.0])}, initial=([0.0], [0.5]))
      >>> task_environment(lake, "F shore").actions.num
      2
    """
    validation.function("step", step)
    low, high = _bounds("domain", domain)
    outside = validation.instance("outside", outside, str, "a name")
    if not isinstance(labels, Mapping):
        raise ValueError(f"labels is {validation.shorten(labels)}; give a dictionary of regions.")
    regions = {}
    for name in validation.distinct_names("labels", labels):
        if name in OUTSIDE:
            raise ValueError(f"labels: {name!r} is an option of outside; choose another name.")
        region = extended(as_region(f"label {name!r}", labels[name], len(low)), low, high)
        with validation.errors_in(f"label {name!r}: "):
            _check_functions(region, len(low))
            if _is_outside(region, low, high):
                raise ValueError("no state of the domain belongs to it; give a set that meets it.")
        regions[name] = region
    noises = [noise] if isinstance(noise, Distribution) else validation.sequence("noise", noise)
    for i, one in enumerate(noises):
        validation.instance(f"noise[{i}]", one, Distribution, "gaussian(scale) or another one")
    dynamics = Dynamics(
        step,
        (low, high),
        tuple(noises),
        None if disturbance is None else _bounds("disturbance", disturbance),
        _actions(actions),
        regions,
        outside,
        _initial(initial, low, high),
    )
    _check_step(dynamics)
    return dynamics


def to_environment(dynamics: Dynamics) -> Environment:
    """The dynamics as an environment.

    Its states and observations are ``float[n]``. Actions are those of the box, or indices of the grid;
    disturbances are uniform. An episode terminates when the state leaves the domain: with
    ``outside="violates"`` the task is violated, whatever its formula, unless the run has satisfied it
    before; with a label it repeats forever.

    Args:
      dynamics: dynamics; learners call this themselves.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`, without rewards.

    Raises:
      ValueError: anything but :class:`Dynamics`.

    Example:
      >>> still = make_dynamics(lambda x, u, w: x, domain=([0.0], [1.0]), labels={})
      >>> to_environment(still).actions
      Finite(num=1)
    """
    validation.instance("dynamics", dynamics, Dynamics, "those of make_dynamics")
    dtype = jnp.result_type(float)
    choices, actions = dynamics.actions, cast(Finite | Box, Finite(1))
    if isinstance(choices, np.ndarray):
        choices, actions = choices.astype(dtype), Finite(len(choices))
    elif choices is not None:
        actions = make_box(*choices, dtype=dtype)
        choices = (actions.low, actions.high)
    domain = dynamics.domain if dynamics.outside == "clip" else np.array([-np.inf, np.inf])
    low, high = (np.broadcast_to(x, dynamics.num_states) for x in domain)
    return make_environment(
        dynamics.sample_initial,
        Partial(_environment_step, Partial(dynamics.next_state), Partial(dynamics.inside), choices),
        _observed,
        actions=actions,
        labels=dynamics.label,
        propositions=dynamics.propositions,
        observations=make_box(low, high, dtype=dtype),
        ending="rejected" if dynamics.outside == "violates" else "repeat",
    )


def _environment_step(
    next_state: Callable[..., jax.Array],
    inside: Callable[..., jax.Array],
    choices: object,
    state: jax.Array,
    action: jax.Array,
    key: chex.PRNGKey,
) -> Timestep:
    """A step; `choices` are the rows of a grid of actions, the bounds of a box, or None."""
    if choices is None:
        action = jnp.zeros(0, state.dtype)
    elif isinstance(choices, tuple):
        action = jnp.clip(action, *choices)
    else:
        action = jnp.asarray(choices)[action]
    successor = next_state(key, state, action)
    return Timestep(successor, jnp.zeros((), state.dtype), ~inside(successor))


def _observed(state: jax.Array) -> jax.Array:
    return state


# --- checks ---------------------------------------------------------------------------------------


def _bounds(name: str, value: tuple[ArrayLike, ArrayLike]) -> Bounds:
    """A pair of finite vectors, the first at most the second."""
    pair = value if isinstance(value, tuple | list) else ()
    if len(pair) != 2:
        raise ValueError(f"{name} is {validation.shorten(value)}; give (low, high).")
    low, high = (validation.float_array(name, x) for x in pair)
    if low.ndim != 1 or low.shape != high.shape or not len(low):
        raise ValueError(
            f"{name}: low and high have shapes {list(low.shape)} and {list(high.shape)}; give two "
            "vectors of one length."
        )
    valid = np.isfinite(low) & np.isfinite(high) & (low < high)
    if not valid.all():
        place = int(np.argmin(valid))
        raise ValueError(
            f"{name}: low={low[place]:g} and high={high[place]:g} in coordinate {place}; give finite "
            "bounds with low < high."
        )
    return low, high


def _actions(value: object) -> Bounds | Floats | None:
    """The box, the grid, or None."""
    if value is None:
        return None
    if isinstance(value, tuple):
        return _bounds("actions", value)
    grid = validation.float_array("actions", value)
    if grid.ndim != 2 or not grid.size or not np.isfinite(grid).all():
        raise ValueError(
            f"actions is an array of shape {list(grid.shape)}; give finite numbers [A, m], an action "
            "a row, or a tuple (low, high) for a box."
        )
    return grid


def _initial(value: Region | Sequence[ArrayLike] | None, low: Floats, high: Floats) -> Region:
    """The boxes of initial states, intersected with the domain."""
    if value is None:
        return box(low, high)
    region = as_region("initial", value, len(low))
    if len(region.offset) or region.functions:
        raise ValueError("initial: give boxes alone, of which initial states are sampled.")
    first, last = np.maximum(region.low, low), np.minimum(region.high, high)
    if not (first < last).all():
        i = int(np.argmax(~(first < last).all(axis=1)))
        raise ValueError(
            f"initial: box {i}, {region.low[i].tolist()} to {region.high[i].tolist()}, lies outside "
            "the domain; give boxes that meet it."
        )
    return box(first, last)


def _check_step(dynamics: Dynamics) -> None:
    """Traces the step in both precisions that JAX has, and evaluates it at random states."""
    n, m, k = dynamics.num_states, dynamics.num_actions, dynamics.num_noise
    shapes = f"state float[{n}], action float[{m}], noise float[{k}]"
    for dtype in sorted({jnp.dtype(np.float32), jnp.result_type(float)}, key=str):
        specs = [jax.ShapeDtypeStruct((size,), dtype) for size in (n, m, k)]
        try:
            successor = traced("step", dynamics.step, *specs)
        except Exception as error:
            message = f"step fails with {shapes}: {error}; accept arrays of these shapes."
            if isinstance(error, ValueError):
                message = f"{error} Its arguments are {shapes}."
            raise ValueError(" ".join(message.split())) from error
        if getattr(successor, "shape", None) != (n,) or not jnp.issubdtype(
            successor.dtype, jnp.floating
        ):
            array = hasattr(successor, "dtype")
            kind = (
                f"{successor.dtype}{list(successor.shape)}" if array else type(successor).__name__
            )
            raise ValueError(f"step returns {kind}; return float[{n}], a state.")
    _check_finite(dynamics)


def _is_outside(region: Region, low: Floats, high: Floats) -> bool:
    """True if no state of the domain belongs to a region."""
    try:
        return not region.membership(low[None], np.nextafter(high, np.inf)[None])[1][0]
    except UndefinedError:  # on the domain as one cell
        return False


def _check_functions(region: Region, num_states: int) -> None:
    """Raises ValueError for a function of a region without a scalar value."""
    state = jax.ShapeDtypeStruct((num_states,), jnp.result_type(float))
    for function in region.functions:
        shape = getattr(traced("its function", function, state), "shape", None)
        if shape != ():
            raise ValueError(f"its function returns shape {shape}; return a number.")


def _check_finite(dynamics: Dynamics, num_samples: int = 64) -> None:
    """Raises ValueError if a successor of a random state of the domain is not a number."""
    low, high = dynamics.domain
    draw = np.random.default_rng(0)
    state = draw.uniform(low, high, (num_samples, len(low)))
    actions = (np.zeros(0), np.zeros(0)) if dynamics.actions is None else dynamics.actions
    if isinstance(actions, tuple):
        action = draw.uniform(*actions, (num_samples, dynamics.num_actions))
    else:
        action = actions[draw.integers(len(actions), size=num_samples)]
    keys = jax.random.split(jax.random.key(0), num_samples)
    samples = (jnp.asarray(x, jnp.result_type(float)) for x in (state, action))
    successor = np.asarray(jax.vmap(dynamics.next_state)(keys, *samples))
    if np.isnan(successor).any():
        i = int(np.argmax(np.isnan(successor).any(axis=1)))
        raise ValueError(
            f"step returns {successor[i].tolist()} in state {state[i].round(6).tolist()} with action "
            f"{action[i].tolist()}; define it in the whole domain."
        )
