"""Seeds of a job over the devices of a mesh: the runs that they are on one, saved and resumed."""

import jax
import numpy as np
import pytest

from jaxltl.algos.common.chunks import ChunkOptions
from jaxltl.algos.common.seeds import Training, run_seeds
from tests.algos.test_learner import case


def mesh_of(count):
    return jax.make_mesh((count,), ("devices",), devices=jax.devices()[:count])


def same(one, other):
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


@pytest.fixture(scope="module")
def seeds():
    module, problem, hparams, *_ = case("toy")

    def run(seeds=3, num_steps=6, **options):
        training = Training(3, seeds, **options)
        return run_seeds(
            module, problem, hparams, training, num_steps=num_steps, options=ChunkOptions(chunk=2)
        )

    return run


@pytest.mark.slow
def test_seeds_over_devices_are_the_seeds(seeds, tmp_path):
    """Also where they cannot be split evenly, and where a run resumes on other devices."""
    found, history = seeds()
    for count in (2, 3):
        path = tmp_path / f"{count}.npz"
        there, metrics = seeds(mesh=mesh_of(count), checkpoint=path)
        same(there, found)
        same(metrics, history)
        # The checkpoint after the last step has the final state.
        for elsewhere in (None, mesh_of(4)):
            again, _ = seeds(mesh=elsewhere, checkpoint=path)
            same(again, found)


def test_a_seed_alone_uses_one_device(seeds):
    same(seeds(1, 2, mesh=mesh_of(2))[0], seeds(1, 2)[0])


@pytest.mark.slow
def test_a_run_resumes_on_other_devices(seeds, tmp_path):
    def leave(step, figures):
        if step == 4:
            raise KeyboardInterrupt

    path = tmp_path / "run.npz"
    with pytest.raises(KeyboardInterrupt):
        seeds(report=leave, checkpoint=path, mesh=mesh_of(3))
    made = []
    found, _ = seeds(report=lambda step, _: made.append(step), checkpoint=path, mesh=mesh_of(2))
    assert made == [6]
    same(found, seeds()[0])
