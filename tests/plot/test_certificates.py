"""Maps of certificates."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.continuous import certify_policy, make_dynamics
from jaxltl.plot.certificates import certificate


def world(n):
    return make_dynamics(
        lambda x, u, w: x / 2,
        domain=([-1.0] * n, [1.0] * n),
        labels={"pit": ([0.5] * n, [1.0] * n)},
        initial=([-0.5] * n, [0.25] * n),
    )


def proven(n):
    return certify_policy(world(n), lambda x: jnp.zeros(0), "G !pit", cells=[8] * n)


def test_colours_are_the_least_lower_bounds_and_boxes_have_names():
    found = proven(3)
    figure = certificate(found, world(3), axes=(2, 0), runs=[np.zeros((4, 3))])
    panel = figure.axes[0]
    shown = (
        panel.collections[0]
        .get_array()
        .reshape(len(found.grid.edges[0]) - 1, len(found.grid.edges[2]) - 1)
    )
    np.testing.assert_array_equal(shown, found.lower.reshape(found.grid.shape).min(axis=1))
    assert 0 < shown.min() + shown.max() < 2
    assert "pit" in [text.get_text() for text in panel.texts]
    corners = [(p.get_xy(), p.get_width()) for p in panel.patches]
    assert ((0.5, 0.5), 0.5) in corners and ((-0.5, -0.5), 0.75) in corners


def test_one_coordinate_has_two_curves_and_axes_are_checked():
    assert len(certificate(proven(1), world(1)).axes[0].patches) == 2
    with pytest.raises(ValueError, match="two distinct coordinates"):
        certificate(proven(2), world(2), axes=(1, 1))
