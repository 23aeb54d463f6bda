"""A continuous world: a shuttle in the plane. `shuttle.toml` refers to the function `make`."""

import jax.numpy as jnp

from jaxltl.core.continuous import Dynamics, box, make_dynamics, triangular, union


def make(gust: float = 0.02) -> Dynamics:
    """A shuttle that is moved by its control and by gusts, between two rocks and a dock.

    Args:
      gust: greatest displacement by a gust in each coordinate.
    """

    def step(state, control, noise):
        drift = 0.02 * jnp.stack([jnp.sin(3 * state[1]), jnp.zeros_like(state[0])])
        return state + drift + 0.2 * jnp.tanh(control) + gust * noise

    return make_dynamics(
        step,
        domain=([-1.0, -1.0], [1.0, 1.0]),
        labels={
            "dock": ([-0.2, -0.2], [0.2, 0.2]),
            "rock": union(box([-0.3, 0.4], [0.3, 0.7]), box([-0.3, -0.7], [0.3, -0.4])),
        },
        noise=[triangular(), triangular()],
        actions=([-1.0, -1.0], [1.0, 1.0]),
        initial=([-0.9, -0.3], [-0.6, 0.3]),
    )
