"""Robot navigation with point sensors: four constrained tasks (Wen 2019, section 4.5.2).

The state is ``(x, y, heading)``, the action a speed and a turn: a step moves by
``speed * time_step`` along the heading, up to the bounds of the map, and then turns. Obstacles do
not stop the robot. Observations are labels of points on circles around it (1 in the goal, -1 in the
obstacle, else 0), in its own frame, and the direction of the goal's centre.

A trajectory has N states, of which the first is the initial one, and N actions, of which the last
has no effect. Table 4 has four tasks with objectives J, to be maximised, and costs Z:

====  =========================================  ==================================  =====
task  J                                          Z                                   limit
====  =========================================  ==================================  =====
1     1 for each state in the goal, and 2 abs y  -1 if the goal is reached, where    -0.5
      for each in the strip -2 <= y <= -0.2      the robot then stays
2     30 times the least signed distance         -1 if the goal is visited           -0.5
      from the obstacle
3     as 2                                       -1 for each state in the goal       -5
4     as 1, without staying in the goal          -1 if the goal is visited and the   -0.5
                                                 obstacle is not
====  =========================================  ==================================  =====

The dissertation gives the geometry only in figure 9, from which these numbers are read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import ArrayLike

from jaxltl.core import struct, validation
from jaxltl.core.environments.environment import as_partial
from jaxltl.core.models.protocols import Array, Key
from jaxltl.core.pretty_print import brief
from jaxltl.envs.networks import Network, apply_layers, layers, make_network, padded

TASKS = (1, 2, 3, 4)
LIMITS = {1: -0.5, 2: -0.5, 3: -5.0, 4: -0.5}
PROPOSITIONS = ("goal", "obstacle")

Scores = Callable[..., tuple[jax.Array, jax.Array]]


@struct.dataclass
class Navigation:
    """A map, a robot and its sensors, see :func:`navigation`.

    Boxes are ``float[2, 2]``: the lower left corner ``(x, y)``, then the upper right one.

    Attributes:
      goal, obstacle, bounds: boxes.
      initial: the box of the initial positions; headings are uniform.
      speed, turn, time_step: the largest speed and turn (radians) of a step, and its duration.
      offset: ``float[M, 2]``, the sensor's points, ahead being (1, 0).
      strip: ``float[2]``, the least and largest y that earn ``2 |y|``.
      weight: of the distance in tasks 2 and 3.
      horizon: N, the states of a trajectory; static.
    """

    goal: Array
    obstacle: Array
    bounds: Array
    initial: Array
    speed: Array
    turn: Array
    time_step: Array
    offset: Array
    strip: Array
    weight: Array
    horizon: int = struct.field(pytree_node=False)

    @property
    def num_observations(self) -> int:
        """M + 2."""
        return self.offset.shape[-2] + 2


@brief
class State(NamedTuple):
    """Positions `x`, `y` and `heading` (radians in [-pi, pi)), in arrays of one shape."""

    x: jax.Array
    y: jax.Array
    heading: jax.Array


@brief
class NavigationRun(NamedTuple):
    """Trajectories: `state`, and `action` ``float[M, N, 2]``, speed and turn as shares of the largest."""

    state: State
    action: jax.Array


def navigation(
    *,
    goal: ArrayLike = ((1.5, 1.0), (2.5, 2.0)),
    obstacle: ArrayLike = ((-1.0, 0.2), (1.0, 2.0)),
    bounds: ArrayLike = ((-4.0, -4.0), (4.0, 4.0)),
    initial: ArrayLike = ((-3.0, -2.5), (-1.5, -0.5)),
    horizon: int = 30,
    speed: float = 1.0,
    turn: float = np.pi / 6,
    time_step: float = 0.5,
    radii: Sequence[float] = (0.5, 1.0, 1.5, 2.0, 2.5),
    num_directions: int = 12,
    strip: ArrayLike = (-2.0, -0.2),
    weight: float = 30.0,
) -> Navigation:
    """A map with a goal and an obstacle, and a robot.

    Args:
      goal, obstacle, bounds, initial: boxes, each the lower left and the upper right corner.
      horizon: N.
      speed, turn, time_step, strip, weight: see :class:`Navigation`.
      radii: of the sensor's circles.
      num_directions: points on each circle, evenly spaced, the first ahead.

    Raises:
      ValueError: an empty box or range, or a size that is not positive.

    >>> world = navigation()
    >>> world.num_observations, policy_network(world).num_parameters
    (62, 2882)
    >>> navigation(speed=0.5, radii=[1.0]).num_observations
    14
    """
    boxes = {"goal": goal, "obstacle": obstacle, "bounds": bounds, "initial": initial}
    corners = {name: _box(name, box) for name, box in boxes.items()}
    numbers = {"speed": speed, "turn": turn, "time_step": time_step}
    sizes = numbers | {
        "num_directions": num_directions,
        "horizon": horizon,
        "the least of radii": min(radii, default=0),
    }
    for name, size in sizes.items():
        if not size > 0:
            raise ValueError(f"{name} is {size}; it must be positive.")
    low_high = np.asarray(strip, float)
    if low_high.shape != (2,) or low_high[0] > low_high[1]:
        raise ValueError(f"strip={strip!r}; give the least and the largest y.")
    angle = 2 * np.pi * np.arange(num_directions) / num_directions
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    offset = (np.asarray(radii, float)[:, None, None] * circle).reshape(-1, 2)
    # NumPy's, so that a computation in either precision starts from the exact numbers.
    numbers["weight"] = weight
    arrays = {name: np.asarray(x, float) for name, x in numbers.items()}
    return Navigation(**corners, **arrays, offset=offset, strip=low_high, horizon=int(horizon))


def _box(name: str, corners: ArrayLike) -> np.ndarray:
    box = np.asarray(corners, float)
    if box.shape != (2, 2) or not (box[0] <= box[1]).all():
        raise ValueError(
            f"{name}={corners!r}; give the corners ((x, y), (x, y)), the lower left one first."
        )
    return box


def policy_network(world: Navigation, hidden: Sequence[int] = (30, 30)) -> Network:
    """The policy network for a `world`: ReLU layers of widths `hidden`, and tanh to speed and turn.

    >>> policy_network(navigation()).sizes
    (62, 30, 30, 2)
    """
    return make_network((world.num_observations, *hidden, 2), output="tanh")


# --- the robot --------------------------------------------------------------------------------


def initial_states(
    key: Key, world: Navigation, shape: tuple[int, ...] = (), dtype: np.dtype | type | None = None
) -> State:
    """The initial states, uniform in the initial box of `world` and in the heading, drawn from `key`.

    They are arrays of a `shape` and a `dtype` (default: JAX's).

    >>> drawn = jax.eval_shape(
    ...     lambda key: initial_states(key, navigation(), (5,)), jax.random.key(0))
    >>> drawn.x.shape
    (5,)
    """
    dtype = dtype or jnp.result_type(float)
    low, high = jnp.asarray(world.initial, dtype)
    u = jax.random.uniform(key, (3, *shape), dtype)
    x, y = (low[i] + (high[i] - low[i]) * u[i] for i in range(2))
    return State(x, y, (2 * u[2] - 1) * jnp.asarray(np.pi, dtype))


def move(world: Navigation, state: State, action: jax.Array) -> State:
    """The next `state` in a `world`: forward along the heading, then the turn.

    The `action` is ``float[..., 2]``, speed and turn as shares of the largest, clipped to [-1, 1].

    >>> state = move(navigation(), State(*jnp.array([3.75, 0.0, 0.0])), jnp.array([1.0, -3.0]))
    >>> [round(float(v), 4) for v in state]
    [4.0, 0.0, -0.5236]
    """
    world = _as(world, state.x)
    share = jnp.clip(action, -1, 1)
    way = world.speed * world.time_step * share[..., 0]
    x = state.x + way * jnp.cos(state.heading)
    y = state.y + way * jnp.sin(state.heading)
    (left, bottom), (right, top) = world.bounds
    return State(
        jnp.clip(x, left, right),
        jnp.clip(y, bottom, top),
        _wrapped(state.heading + world.turn * share[..., 1]),
    )


def _wrapped(angle: jax.Array) -> jax.Array:
    """Into [-pi, pi), for angles of less than two turns; ``%`` would be slow."""
    angle = jnp.where(angle >= np.pi, angle - 2 * np.pi, angle)
    return jnp.where(angle < -np.pi, angle + 2 * np.pi, angle)


def observe(world: Navigation, state: State) -> jax.Array:
    """The sensor readings of the robot in a `state` of a `world`, ``float[..., M + 2]``.

    The labels of the M points, circle by circle, then the unit vector to the goal's centre (ahead, to
    the left), zero in the centre. Differentiable in the direction.

    >>> seen = observe(navigation(), State(*jnp.array([1.0, 1.5, 0.0])))
    >>> seen[:12].astype(int).tolist(), seen[-2:].tolist()
    ([1, 0, 0, -1, -1, -1, -1, -1, -1, -1, 0, 0], [1.0, 0.0])
    """
    world = _as(world, state.x)
    x, y = state.x[..., None], state.y[..., None]
    cos, sin = jnp.cos(state.heading)[..., None], jnp.sin(state.heading)[..., None]
    # Two more points, so that all columns are made in one pass.
    ahead, left = jnp.pad(world.offset, ((0, 2), (0, 0))).T
    px, py = x + (cos * ahead - sin * left), y + (sin * ahead + cos * left)
    label = _inside(world.goal, px, py).astype(x.dtype) - _inside(world.obstacle, px, py)
    dx, dy = (world.goal[0, i] + world.goal[1, i] - 2 * p for i, p in enumerate((x, y)))
    square = dx * dx + dy * dy
    # The inner choice keeps a division by 0 out of the derivatives.
    scale = jnp.where(square > 0, 1 / jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    column, count = np.arange(len(ahead)), len(ahead) - 2
    toward = jnp.where(column == count, cos * dx + sin * dy, cos * dy - sin * dx) * scale
    return jnp.where(column < count, label, toward)


def _inside(box: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    (left, bottom), (right, top) = box
    return (x >= left) & (x <= right) & (y >= bottom) & (y <= top)


def _as(world: Navigation, like: jax.Array) -> Navigation:
    dtype = jnp.promote_types(jnp.asarray(like).dtype, jnp.float32)
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), world)


# --- tasks ------------------------------------------------------------------------------------


def labels(world: Navigation, state: State) -> jax.Array:
    """The labels :data:`PROPOSITIONS` of a `state` of a `world`, ``bool[..., 2]``; boxes are closed.

    >>> labels(navigation(), State(*jnp.array([2.0, 1.5, 0.0]))).tolist()
    [True, False]
    """
    world = _as(world, state.x)
    return jnp.stack(
        [_inside(box, state.x, state.y) for box in (world.goal, world.obstacle)], axis=-1
    )


def obstacle_distance(world: Navigation, state: State) -> jax.Array:
    """The signed distance of a `state` from the obstacle of a `world`, negative inside; differentiable.

    >>> x, y = jnp.array([4.0, -3.0, 0.5]), jnp.array([6.0, 1.0, 1.0])
    >>> obstacle_distance(navigation(), State(x, y, x)).tolist()
    [5.0, 2.0, -0.5]
    """
    world = _as(world, state.x)
    (left, bottom), (right, top) = world.obstacle
    dx = jnp.maximum(left - state.x, state.x - right)
    dy = jnp.maximum(bottom - state.y, state.y - top)
    square = jnp.maximum(dx, 0) ** 2 + jnp.maximum(dy, 0) ** 2
    # The inner choice keeps the slope of the root at 0 out of the derivatives.
    outside = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    return outside + jnp.minimum(jnp.maximum(dx, dy), 0)


def reward(world: Navigation, state: State) -> jax.Array:
    """The contribution of a `state` to J in tasks 1 and 4 of a `world`, ``float[...]``.

    >>> x = jnp.array([2.0, 0.0, 0.0])
    >>> reward(navigation(), State(x, jnp.array([1.5, -1.5, 0.0]), x)).tolist()
    [1.0, 3.0, 0.0]
    """
    low, high = jnp.asarray(world.strip, state.y.dtype)
    strip = jnp.where((state.y >= low) & (state.y <= high), 2 * jnp.abs(state.y), 0)
    return jnp.where(labels(world, state)[..., 0], 1, strip)


def check_task(task: object) -> None:
    """Check of the number of a task.

    Raises:
      ValueError: the task is not 1, 2, 3 or 4.

    >>> check_task(3)
    """
    if np.ndim(task) or task not in TASKS:  # type: ignore[arg-type]
        raise ValueError(f"task={task!r}; choose 1, 2, 3 or 4, or give a function.")


def scores(world: Navigation, state: State, task: int) -> tuple[jax.Array, jax.Array]:
    """The objective J and cost Z of trajectories in one of the four tasks, ``float[...]`` each.

    Args:
      world, task: the map, and 1 to 4, static.
      state: arrays ``float[..., N]``; of task 1 with the goal absorbing.

    Raises:
      ValueError: an unknown task.

    >>> x = jnp.array([[2.0, 2.0]])
    >>> both = jax.jit(scores, static_argnums=2)(navigation(), State(x, x - 0.5, x), 3)
    >>> [v.tolist() for v in both]  # a distance of 1, and twice in the goal
    [[30.0], [-2.0]]
    """
    check_task(task)
    goal, obstacle = jnp.moveaxis(labels(world, state), -1, 0)
    visited = goal.any(-1)
    if task in (1, 4):
        objective = reward(world, state).sum(-1)
    else:
        weight = jnp.asarray(world.weight, state.x.dtype)
        objective = weight * obstacle_distance(world, state).min(-1)
    cost = {1: visited, 2: visited, 3: goal.sum(-1), 4: visited & ~obstacle.any(-1)}[task]
    return objective, 0 - cost.astype(objective.dtype)


# --- trajectories and their evaluation --------------------------------------------------------


def simulate(
    key: Key,
    world: Navigation,
    network: Network,
    parameters: jax.Array,
    *,
    num_trajectories: int = 10,
    absorbing: bool = False,
) -> NavigationRun:
    """The trajectories of a policy; differentiable in its parameters.

    Args:
      key: of the initial states.
      world, network: as of :func:`navigation` and :func:`policy_network`.
      parameters: ``float[D]``, in the precision of the simulation.
      num_trajectories: M, static.
      absorbing: make the goal absorbing; static.

    >>> world = navigation()
    >>> network = policy_network(world)
    >>> run = simulate(jax.random.key(0), world, network, jnp.zeros(network.num_parameters))
    >>> run.state.x.shape, run.action.shape
    ((10, 30), (10, 30, 2))
    """
    _check_fits(world, network)
    settings = struct.Static((num_trajectories, validation.boolean("absorbing", absorbing)))
    return _simulate(network, settings, world, jnp.asarray(parameters), key)


@jax.jit  # so that calls outside of jit share one compilation
def _simulate(
    network: Network, settings: struct.Static, world: Navigation, parameters: jax.Array, key: Key
) -> NavigationRun:
    num_trajectories, absorbing = settings.value
    dtype = jnp.promote_types(parameters.dtype, jnp.float32)
    world, parameters = jax.tree.map(lambda x: jnp.asarray(x, dtype), (world, parameters))
    parts = padded(layers(network, parameters))

    def step(state: State, _: None) -> tuple[State, tuple[State, jax.Array]]:
        action = apply_layers(network, parts, observe(world, state))
        following = move(world, state, action)
        if absorbing:
            stays = _inside(world.goal, state.x, state.y)
            following = jax.tree.map(lambda x, y: jnp.where(stays, x, y), state, following)
        return following, (state, action)

    first = initial_states(key, world, (num_trajectories,), dtype)
    _, (states, actions) = lax.scan(step, first, None, length=world.horizon)
    return NavigationRun(jax.tree.map(lambda x: x.T, states), jnp.moveaxis(actions, 0, 1))


def evaluator(
    world: Navigation,
    task: int | Scores = 1,
    network: Network | None = None,
    *,
    num_trajectories: int = 10,
    absorbing: bool | None = None,
) -> jax.tree_util.Partial:
    """The function ``evaluate(parameters, key) -> (objective, cost)``, means over trajectories.

    The objective is the mean of J = log G, since ``exp(J)`` overflows in float32.

    Args:
      world, network: as of :func:`navigation` and :func:`policy_network`.
      task: 1 to 4; or a function ``(world, run) -> (J float[M], Z float[M] or [M, C])``, which may be a
        ``jax.tree_util.Partial`` with arrays.
      num_trajectories: M.
      absorbing: make the goal absorbing; default: only in task 1.

    Raises:
      ValueError: an unknown task, a network of other sizes, or no trajectories.

    >>> world = navigation()
    >>> evaluate = evaluator(world, 2)
    >>> objective, cost = evaluate(jnp.zeros(2882), jax.random.key(0))
    >>> 30 * 0.7 < objective < 30 * 4, float(cost)
    (Array(True, dtype=bool), 0.0)
    """
    network = policy_network(world) if network is None else network
    _check_fits(world, network)
    num_trajectories = validation.integer("num_trajectories", num_trajectories, least=1)
    if callable(task):
        score = as_partial(task)
    else:
        check_task(task)
        absorbing = task == 1 if absorbing is None else absorbing
        score = jax.tree_util.Partial(_table_4, struct.Static(int(task)))
    absorbing = absorbing is not None and validation.boolean("absorbing", absorbing)
    settings = struct.Static((num_trajectories, absorbing))
    return jax.tree_util.Partial(_evaluate, network, settings, world, score)


def _check_fits(world: Navigation, network: Network) -> None:
    if (network.sizes[0], network.sizes[-1]) != (world.num_observations, 2):
        raise ValueError(
            f"the network has the sizes {network.sizes}; the world has {world.num_observations} "
            "observations, its inputs, and speed and turn, its 2 outputs."
        )


def _table_4(
    task: struct.Static, world: Navigation, run: NavigationRun
) -> tuple[jax.Array, jax.Array]:
    return scores(world, run.state, task.value)


@jax.jit
def _evaluate(
    network: Network,
    settings: struct.Static,
    world: Navigation,
    score: Scores,
    parameters: jax.Array,
    key: Key,
) -> tuple[jax.Array, jax.Array]:
    num_trajectories, absorbing = settings.value
    run = simulate(
        key, world, network, parameters, num_trajectories=num_trajectories, absorbing=absorbing
    )
    objective, cost = score(world, run)
    return objective.mean(axis=0), cost.mean(axis=0)
