"""Policies in gymnasium's environments, and products of these with tasks."""

import subprocess
import sys

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.automata.runs import Verdict, verdict
from jaxltl.envs.gymnasium_runner import run_policy
from jaxltl.envs.gymnasium_task import gymnasium_task

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

PLACES = {3: {"corner"}, 15: {"goal"}, **{s: {"hole"} for s in (5, 7, 11, 12)}}
LABELS = {"corner": [3], "goal": [15], "hole": [5, 7, 11, 12]}


def places(seen, info):
    return PLACES.get(int(seen), set())


def lake(slippery=True, limit=400):
    return gymnasium.make("FrozenLake-v1", is_slippery=slippery, max_episode_steps=limit)


class Pairs(gymnasium.Env):
    """A world with observations in a Dict, or in a Tuple."""

    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, named):
        parts = {"x": gymnasium.spaces.Box(-1, 1, (2,)), "n": gymnasium.spaces.Discrete(3)}
        self.named = named
        kinds = gymnasium.spaces
        self.observation_space = kinds.Dict(parts) if named else kinds.Tuple(parts.values())

    def seen(self):
        x = np.clip(self.np_random.normal(size=2), -1, 1).astype(np.float32)
        return {"x": x, "n": self.time} if self.named else (x, self.time)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.seen(), {}

    def step(self, action):
        self.time = min(self.time + 1, 2)
        return self.seen(), 0.0, False, False, {}


PRODUCTS = {
    "Discrete": lambda: gymnasium_task(lake(), "!hole U (corner & F goal)", places),
    "Box": lambda: gymnasium_task(
        gymnasium.make("CartPole-v1"), "G !left", lambda x, info: {"left"} if x[0] < -1 else set()
    ),
    "Dict": lambda: gymnasium_task(Pairs(True), "F a", lambda x, info: {"a"} if x["n"] else set()),
    "Tuple": lambda: gymnasium_task(Pairs(False), "F a", lambda x, info: {"a"} if x[1] else set()),
}


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("kind", PRODUCTS)
def test_products_pass_gymnasiums_checks(kind):
    product = PRODUCTS[kind]()
    check_env(product, skip_render_check=True)
    seen, info = product.reset(seed=1)
    assert isinstance(product, gymnasium.Env) and product.observation_space.contains(seen)
    if kind == "Box":
        assert seen[-2:].sum() == 1 and seen.dtype == np.float32
    if kind in ("Dict", "Tuple"):
        assert seen["memory"].tolist() == [1, 0]
        seen, reward, ended, _, info = product.step(0)
        assert seen["memory"].tolist() == [0, 1] and (reward, ended) == (1.0, True)
        assert info["verdict"] == Verdict.SATISFIED


@pytest.mark.parametrize(
    ("formula", "options"),
    [
        ("!hole U (corner & F goal)", {"shaping": "distance", "discount": 0.9}),
        ("G !hole", {}),
        ("G F corner & G F !corner", {"reward": "two-discount", "discount": 0.8}),
        ("F corner", {"ending": "violated"}),
    ],
)
def test_the_product_is_that_of_task_environment(formula, options):
    model = jl.to_padded(jl.envs.from_gymnasium(lake(False), labels=LABELS))
    world = jl.environments.model_environment(model)
    here = jl.task_environment(world, formula, **options)
    there = gymnasium_task(lake(False), formula, places, propositions=list(LABELS), **options)
    step = jax.jit(here.step)
    rng = np.random.default_rng(0)
    compared = 0
    for episode in range(12):
        seen, info = there.reset(seed=episode)
        state = here.reset(jax.random.key(0))
        for _ in range(40):
            action = int(rng.integers(4))
            ended = False
            seen, reward, ended, _, info = there.step(action)
            found = step(state, action, jax.random.key(0))
            state = found.world
            assert info["memory"] == int(state.memory)
            size = there.observation_space.n // 16
            assert seen % size == info["memory"]
            original = seen // size
            holed = original in (5, 7, 11, 12, 15)
            if holed:  # an episode ends there; the model has one more step, to the same label
                assert ended
                break
            assert reward == pytest.approx(float(found.reward), abs=1e-6)
            assert info["verdict"] == int(state.verdict) and ended == bool(found.terminated)
            assert info["discount"] == pytest.approx(float(found.discount))
            compared += 1
            if ended:
                break
    assert compared > 40


def test_verdicts_are_those_of_the_trace():
    task = "!hole U (corner & F goal)"
    product = gymnasium_task(lake(limit=60), task, places)
    automaton = jl.to_automaton(task)
    size = len(automaton.delta)
    rng, met = np.random.default_rng(1), set()
    for episode in range(60):
        seen, info = product.reset(seed=episode)
        word, ended, cut = [places(seen // size, info)], False, False
        while not (ended or cut):
            seen, reward, ended, cut, info = product.step(int(rng.integers(4)))
            word.append(places(seen // size, info))
            expected = verdict(automaton, word)
            if not ended or expected != Verdict.UNDECIDED:
                assert info["verdict"] == expected
        assert reward == (info["verdict"] == Verdict.SATISFIED)
        met.add(info["verdict"])
    assert Verdict.VIOLATED in met


def best_policy(formula="!hole U (corner & F goal)", slippery=True):
    model = jl.envs.from_gymnasium(lake(slippery), labels=LABELS)
    found = jl.optimal_satisfaction(model, jl.to_automaton(formula))
    return jl.project_policy(model, found), found


def test_policies_succeed_as_often_as_certified():
    policy, solution = best_policy()
    found = run_policy(lake(limit=2000), policy, num_episodes=120, seed=5, confidence=0.999)
    assert found.success.lower <= solution.upper[0] and solution.lower[0] <= found.success.upper
    assert found.num_episodes == 120 and 0.05 < found.success.mean < 0.95
    again = run_policy(lake(limit=2000), policy, num_episodes=120, seed=5, confidence=0.999)
    assert again == found
    product = gymnasium_task(lake(limit=2000), policy.automaton, places)
    size = len(policy.automaton.delta)
    table = np.asarray(policy.action)
    same = run_policy(
        product,
        lambda x: int(table[x // size, x % size]),
        num_episodes=120,
        seed=5,
        confidence=0.999,
    )
    for name in ("success", "violation", "undecided", "length", "terminated"):
        assert getattr(same, name) == getattr(found, name), name
    cut = run_policy(lake(limit=3), policy, num_episodes=20)
    assert cut.undecided.mean == 1 and cut.truncated == 20


def test_the_end_of_an_episode_is_a_label():
    policy, solution = best_policy("!terminated U (goal & !terminated)", slippery=False)
    assert float(solution.value[0]) == 0  # it ends in the goal
    policy, solution = best_policy("!terminated U (goal & corner)", slippery=False)
    assert run_policy(lake(False, 9), policy, num_episodes=2).success.mean == 0
    policy, solution = best_policy("F (goal & terminated)", slippery=False)
    found = run_policy(lake(False), policy, num_episodes=5)
    assert float(solution.value[0]) == 1 and found.success.mean == 1
    policy, solution = best_policy("F G goal", slippery=False)  # repeated for ever at the end
    found = run_policy(lake(False), policy, num_episodes=5)
    assert float(solution.value[0]) == 1 and found.success.mean == 1


def test_labels_come_from_the_world_if_given():
    policy, _ = best_policy("F goal", slippery=False)
    nowhere = run_policy(
        lake(False, 30), policy, num_episodes=3, observe=lambda x, info: (int(x), set())
    )
    assert nowhere.violation.mean == 1 and nowhere.reward.mean == 1


def test_refusals():
    policy, _ = best_policy("F goal", slippery=False)
    unlimited = lake(False).unwrapped
    unlimited.spec = None
    with pytest.raises(ValueError, match="no limit of steps"):
        run_policy(unlimited, policy)
    with pytest.raises(ValueError, match="state 16 does not exist"):
        run_policy(
            gymnasium.make("Taxi-v4"),
            policy.replace(next_memory=policy.next_memory[:16], letter=policy.letter[:16]),
            num_episodes=50,
            observe=lambda seen, info: (16, None),
        )
    with pytest.raises(ValueError, match=r"labels returned 'goals'; expected .* among goal"):
        gymnasium_task(lake(), "F goal", lambda x, info: {"goals"}).reset()
    with pytest.raises(ValueError, match="labels returned 'goal'"):
        gymnasium_task(lake(), "F goal", lambda x, info: "goal").reset()
    with pytest.raises(TypeError, match="embedding"):
        gymnasium_task(lake(), "F goal", places, embedding=np.eye(2))


RUN_ALONE = """
import sys
for name in ("jax", "jaxlib", "flax", "optax", "chex"):
    sys.modules[name] = None
import gymnasium, jaxltl as jl
env = gymnasium.make("FrozenLake-v1", max_episode_steps=2000)
policy = jl.io.load_policy(sys.argv[1])
print(jl.envs.run_policy(env, policy, num_episodes=40, seed=5).success.mean)
"""


def test_a_saved_policy_runs_in_gymnasium_without_jax(tmp_path):
    policy, _ = best_policy()
    jl.io.save_policy(tmp_path / "p.npz", policy)
    done = subprocess.run(
        [sys.executable, "-c", RUN_ALONE, tmp_path / "p.npz"],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    here = run_policy(lake(limit=2000), policy, num_episodes=40, seed=5)
    assert float(done.stdout) == here.success.mean
