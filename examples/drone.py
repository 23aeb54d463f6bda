"""A custom environment: a drone with random gusts. `drone.toml` refers to the function `make`."""

import jax
import jax.numpy as jnp

import jaxltl as jl

REGIONS = {"base": (0.0, 0.0), "field": (0.7, 0.4), "well": (-0.6, 0.5)}
RADIUS = 0.35
LIMIT = 1.6


def make(wind: float = 0.01, horizon: int = 80) -> jl.Environment:
    """An environment of a point mass with friction and random wind in the plane.

    Args:
      wind: standard deviation of the gusts.
      horizon: number of steps after which an episode is truncated.
    """
    centers = jnp.array(list(REGIONS.values()))

    def reset(key):
        position = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return {"position": position, "velocity": jnp.zeros(2), "time": jnp.int32(0)}

    def step(world, force, key):
        gust = wind * jax.random.normal(key, (2,))
        velocity = 0.8 * world["velocity"] + 0.04 * jnp.clip(force, -1, 1) + gust
        position, time = world["position"] + velocity, world["time"] + 1
        outside = jnp.abs(position).max() > LIMIT
        after = {"position": position, "velocity": velocity, "time": time}
        return jl.environments.Timestep(
            after, reward=0.0, terminated=outside, truncated=time >= horizon
        )

    def observe(world):
        return jnp.concatenate([world["position"], 10 * world["velocity"]])

    def labels(world):
        near = jnp.linalg.norm(world["position"] - centers, axis=1) < RADIUS
        out = jnp.abs(world["position"]).max() > 1.3
        return jnp.append(near, out)

    return jl.make_environment(
        reset,
        step,
        observe,
        actions=jl.environments.make_box(-1.0, 1.0, (2,)),
        labels=labels,
        propositions=[*REGIONS, "out"],
        horizon=horizon,
    )
