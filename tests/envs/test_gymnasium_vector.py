"""Vector environments of gymnasium: jaxltl's environments as such, and policies on them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.environments.environment import Timestep, make_box
from jaxltl.envs.gymnasium_runner import run_policy
from jaxltl.envs.gymnasium_vector import gymnasium_vector

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv  # noqa: E402


def corridor(limit=12):
    """Six places; the number of steps is part of the world, and a key is drawn from in each step."""

    def reset(key):
        return {"place": jax.random.randint(key, (), 1, 5), "time": jnp.int32(0)}

    def step(world, action, key):
        slips = jax.random.bernoulli(key, 0.2)
        place = jnp.clip(world["place"] + jnp.where(slips, 0, 2 * action - 1), 0, 5)
        after = {"place": place, "time": world["time"] + 1}
        return Timestep(after, place / 8.0, place == 5, after["time"] >= limit)

    return jl.make_environment(
        reset,
        step,
        lambda world: {"where": world["place"] / 5.0, "time": world["time"]},
        actions=2,
        labels=lambda world: jnp.array([world["place"] == 5]),
        propositions=["goal"],
        allowed=lambda world: jnp.array([world["place"] > 1, True]),
        observations={"where": make_box(0.0, 1.0, ()), "time": make_box(0, 99, (), "int32")},
        horizon=limit,
    )


def test_lanes_are_a_vector_environment():
    lanes = gymnasium_vector(corridor(), 5)
    assert (
        isinstance(lanes, VectorEnv) and lanes.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    )
    seen, info = lanes.reset(seed=3)
    assert lanes.observation_space.contains(seen), seen
    assert info["allowed"].shape == (5, 2) and info["labels"].shape == (5, 1)
    with pytest.raises(ValueError, match="actions"):
        lanes.step(np.zeros(4, int))
    again, _ = gymnasium_vector(corridor(), 5).reset(seed=3)
    np.testing.assert_array_equal(seen["where"], again["where"])
    assert len(set(seen["where"].tolist())) > 1  # lanes have draws of their own
    with pytest.raises(ValueError, match="num_envs"):
        gymnasium_vector(corridor(), 0)
    with pytest.raises(ValueError, match="resets"):
        gymnasium_vector(corridor(), 1, resets="never")


@pytest.mark.parametrize("resets", ["next_step", "same_step"])
def test_thousands_of_steps_follow_the_rules_of_the_environment(resets):
    lanes, rng = gymnasium_vector(corridor(), 8, resets=resets), np.random.default_rng(0)
    seen, _ = lanes.reset(seed=0)
    place, time, over = np.rint(seen["where"] * 5), seen["time"].copy(), np.zeros(8, bool)
    ends = 0
    for _ in range(400):
        action = rng.integers(2, size=8)
        seen, reward, ended, cut, info = lanes.step(action)
        last = seen
        if resets == "same_step" and (ended | cut).any():
            done = info["_final_obs"]
            np.testing.assert_array_equal(done, ended | cut)
            last = {k: np.where(done, info["final_obs"][k], seen[k]) for k in seen}
            assert (seen["time"][done] == 0).all()
        after, ran = np.rint(last["where"] * 5), ~over
        moved = after - place
        assert (np.isin(moved, (0, 1)) | (action == 0))[ran].all()
        assert (np.isin(moved, (0, -1)) | (action == 1))[ran].all()
        assert (last["time"] == time + 1)[ran].all() and (reward == after / 8)[ran].all()
        np.testing.assert_array_equal(ended[ran], (after == 5)[ran])
        np.testing.assert_array_equal(cut[ran], (last["time"] >= 12)[ran])
        assert (last["time"] == 0)[over].all() and not (reward[over].any() or ended[over].any())
        np.testing.assert_array_equal(info["labels"][:, 0], np.rint(seen["where"] * 5) == 5)
        place, time, ends = np.rint(seen["where"] * 5), seen["time"], ends + (ended | cut).sum()
        over = (ended | cut) & (resets == "next_step")
    assert ends > 200


def lake(limit=400):
    return gymnasium.make("FrozenLake-v1", max_episode_steps=limit)


def task():
    places = {15: {"goal"}, **{s: {"hole"} for s in (5, 7, 11, 12)}}
    return jl.envs.gymnasium_task(lake(), "!hole U goal", lambda s, info: places.get(int(s), set()))


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_policy_runs_on_lanes_as_on_one_environment(mode):
    model = jl.envs.from_gymnasium(lake(), labels={"goal": [15], "hole": [5, 7, 11, 12]})
    best = jl.optimal_satisfaction(model, "!hole U goal")
    policy = jl.project_policy(model, best)
    lanes = SyncVectorEnv([lake] * 7, autoreset_mode=mode)
    found = run_policy(lanes, policy, num_episodes=100, seed=1)
    assert found.num_episodes == 100
    assert found.success.lower <= float(best.at_initial.value) <= found.success.upper
    number = run_policy(
        SyncVectorEnv([task] * 3, autoreset_mode=mode),
        lambda seen: int(policy.action[seen // 3, 0]),
        num_episodes=30,
    )
    assert number.success is not None and number.success.mean > 0.5


def test_policies_run_on_lanes_of_our_own_environments():
    found = run_policy(gymnasium_vector(corridor(), 4), lambda seen: 1, num_episodes=50)
    assert found.num_episodes == 50 and found.success is None and found.terminated > 45
    with pytest.raises(ValueError, match="autoreset_mode"):
        run_policy(SyncVectorEnv([lake], autoreset_mode=AutoresetMode.DISABLED), lambda seen: 1)
