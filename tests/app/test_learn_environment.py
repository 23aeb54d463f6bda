"""`jaxltl learn` in simulated worlds: what is written is true of what was learned."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from click.testing import CliRunner

import jaxltl as jl
from jaxltl.algos.common import chunks
from jaxltl.app import learn_environment as job
from jaxltl.app.environment_setup import load_environment
from jaxltl.app.files.task import kind_of
from jaxltl.app.files.task_rl import EnvironmentFile
from jaxltl.cli import main
from jaxltl.core.environments.task_environment import task_tables
from jaxltl.core.values.evaluation.evaluation import evaluate
from jaxltl.core.values.evaluation.selection import without_shaping
from tests.app.test_report import browser  # noqa: F401

EXAMPLES = Path(__file__).parents[2] / "examples"
WORLD = """
import jax
import jax.numpy as jnp
from jaxltl import make_environment
from jaxltl.core.environments import Timestep, make_box


def corridor(length=3, boxed=False, horizon=8, ends=True):
    def step(place, action, key):
        move = jnp.where(action[0] > 0, 1, -1) if boxed else 2 * action - 1
        place = jnp.clip(place + move, -length, length).astype(jnp.int32)
        return Timestep(place, reward=0.0, terminated=jnp.bool_(False))

    return make_environment(
        lambda key: jnp.int32(0), step, lambda place: place[None] / length,
        actions=make_box(-1.0, 1.0, (1,)) if boxed else 2, horizon=horizon if ends else None,
        labels=lambda place: jnp.array([place == length, place == -length]),
        propositions=["goal", "pit"])


def bare():
    world = corridor()
    return make_environment(
        world.reset, world.step, world.observe, actions=2, horizon=8)


def at_goal(place):
    return (place == 3)[None]


def two_labels(place):
    return jnp.stack([place == 3, place == 1])


def number():
    return 3


def breaks():
    return {}["no"]


def says_nothing():
    raise ValueError


nothing = 3
"""
TASK = """
[world]
environment = "own.py:corridor"
[world.arguments]
boxed = false
[task]
formula = "!pit U goal"
[learner]
method = "ppo"
steps = 20
[ppo]
num_envs = 8
num_steps = 8
num_minibatches = 2
learning_rate = [0.01, 0.0]
hidden = [8]
[evaluation]
episodes = 200
"""
CCE = (
    "[ppo]\nnum_envs = 8\nnum_steps = 8\nnum_minibatches = 2\nlearning_rate = [0.01, 0.0]\n"
    "hidden = [8]",
    "[cce]\npopulation = 20\nepisodes = 2\nhidden = [4]",
)
CPO = (
    CCE[0],
    '[cpo]\nlimit = 0.5\ncost = "violation"\nnum_trajectories = 32\nhidden = [4]\n'
    "value_hidden = [4]\nnum_value_batches = 2",
)


@pytest.fixture
def write(tmp_path):
    (tmp_path / "own.py").write_text(WORLD)

    def made(*changes):
        text = TASK
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "task.toml"
        path.write_text(text)
        return path

    return made


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def arrays_of(path):
    with np.load(path) as file:
        return dict(file)


def failure(*arguments):
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    return result.stderr.rpartition("error: ")[2]


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("learned")
    (folder / "own.py").write_text(WORLD)
    path = folder / "task.toml"
    path.write_text(TASK)
    told = run("learn", path, "--seeds", 2, "--out", folder / "out", "--json")
    assert told.exit_code == 0, told.output
    return path, folder / "out", told


@pytest.mark.slow
def test_learn_says_and_writes_what_it_found(learned):
    _, out, told = learned
    assert told.stderr.startswith("jaxltl")
    result = json.loads((out / "result.json").read_text())
    assert json.loads(told.stdout.splitlines()[-1]) == result
    found = result["evaluation"]["success"]
    assert 0.9 < found["mean"] <= 1 and found["method"] == "Clopper-Pearson"
    assert found["lower"] < found["mean"] <= found["upper"]
    shares = [result["evaluation"][n]["mean"] for n in ("success", "violation", "undecided")]
    assert sum(shares) == pytest.approx(1)
    assert result["training"]["transitions"] == 20 * 8 * 8
    assert result["seeds"]["evaluations"][result["seeds"]["kept"]] == result["evaluation"]
    assert "success of 2 seeds" in told.stdout
    page = (out / "report.html").read_text()
    assert "Every seed" in page and f"{found['mean']:.4f}" in page
    assert not list(out.glob("checkpoint*"))


@pytest.mark.slow
def test_the_written_policy_does_what_the_result_says(learned):
    path, out, _ = learned
    result = json.loads((out / "result.json").read_text())
    environment, agent = job.load_agent(out / "policy.npz")
    keys = jax.random.split(jax.random.fold_in(jax.random.key(0), 2), 3)
    again = evaluate(keys[1], agent, environment, num_episodes=200)
    assert again.success.mean == result["evaluation"]["success"]["mean"]
    assert again.length.mean == pytest.approx(result["evaluation"]["length"]["mean"])
    deployed = jl.io.load_policy(out / "policy.npz")
    seen = environment.observe(environment.reset(jax.random.key(0)))
    for i in range(5):
        at = deployed.start(seen.world, set())
        assert seen.memory[at.memory] == 1
        key = jax.random.key(i)
        assert int(deployed.act(key, at)) == int(agent.act((), seen, None, key)[0])
    kept = {k: v for k, v in arrays_of(out / "policy.npz").items() if "parameters" not in k}
    np.savez(out / "other.npz", **kept)
    with pytest.raises(ValueError, match=r"other\.npz: parameters.* is missing"):
        job.load_agent(out / "other.npz", task_file=path)


@pytest.mark.slow
def test_a_written_policy_is_used_without_its_task_file(learned, tmp_path):
    path, out, _ = learned
    world = load_environment(EnvironmentFile.read(path))
    here = tmp_path / "policy.npz"
    arrays = arrays_of(out / "policy.npz")
    assert arrays["task"].item() == path.read_text()
    np.savez(here, **arrays | {"task_file": np.array("/nowhere/task.toml")})

    def act(**given):
        _, agent = job.load_agent(here, **given)
        seen = environment.observe(environment.reset(jax.random.key(0)))
        return np.asarray(
            jax.vmap(lambda key: agent.act((), seen, None, key)[0])(
                jax.random.split(jax.random.key(3), 20)
            )
        )

    environment, _ = job.load_agent(out / "policy.npz")
    with pytest.raises(ValueError, match=r"/nowhere/task.toml: \[world\] environment: there is no"):
        job.load_agent(here)
    wanted = act(task_file=path)
    np.testing.assert_array_equal(act(environment=world), wanted)
    shutil.copy(path.parent / "own.py", tmp_path)
    np.testing.assert_array_equal(act(), wanted)
    for given, message in (
        ({"environment": 3}, "environment is int; give one of make_environment"),
        (
            {
                "environment": load_environment(EnvironmentFile.read(path)).replace(
                    propositions=("a", "b")
                )
            },
            r"task.toml: \[task\] formula: .*'goal'",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            job.load_agent(here, **given)
    kept = {k: v for k, v in arrays.items() if k != "task"}
    np.savez(here, **kept)
    with pytest.raises(ValueError, match=r"policy\.npz: no task is kept with it"):
        job.load_agent(here)
    np.savez(here, next_memory=np.zeros(1))
    with pytest.raises(ValueError, match=r"policy\.npz: no format, version"):
        job.load_agent(here)
    with pytest.raises(ValueError, match=r"the policy cannot be read: .*No such file"):
        job.load_agent(tmp_path / "none.npz")


@pytest.mark.slow
def test_what_is_done_is_not_done_again(learned, monkeypatch):
    path, out, _ = learned
    monkeypatch.setattr(job, "learn", None)
    assert "finished before" in run("learn", path, "--seeds", 2, "--out", out).stdout


@pytest.mark.slow
def test_an_interrupted_run_goes_on_bitwise(learned, monkeypatch, tmp_path):
    path, out, _ = learned
    save, count = chunks.files.save, []

    def saved(*arguments):
        save(*arguments)
        count.append(1)
        if len(count) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(chunks.files, "save", saved)
    stopped = run("learn", path, "--seeds", 2, "--out", tmp_path)
    assert stopped.exit_code == 130 and "goes on from the last checkpoint" in stopped.stderr
    assert len(list(tmp_path.glob("checkpoint*"))) == 1
    went_on = run("learn", path, "--seeds", 2, "--out", tmp_path)
    assert "going on from" in went_on.stderr and went_on.exit_code == 0
    one, other = (arrays_of(folder / "policy.npz") for folder in (out, tmp_path))
    assert list(one) == list(other)
    for name in set(one) - {"stablehlo"}:  # which names the lines of the calls
        np.testing.assert_array_equal(one[name], other[name])


@pytest.mark.slow
def test_interrupted_before_it_learns(learned, monkeypatch, tmp_path):
    def interrupt(*given):
        raise KeyboardInterrupt

    for name in ("prepare", "task_pictures"):
        with monkeypatch.context() as patch:
            patch.setattr(job, name, interrupt)
            told = run("learn", learned[0], "--out", tmp_path / "out")
        assert told.exit_code == 130 and told.stderr.endswith("interrupted\n"), told.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "table", "boxed"),
    [
        ("cce", CCE, False),
        pytest.param(
            "cce",
            (CCE[0], CCE[1] + '\ncost = "violation"\nlimit = 0.2'),
            True,
            marks=pytest.mark.slow,
        ),
        pytest.param("cpo", CPO, True, marks=pytest.mark.slow),
    ],
)
def test_other_methods(write, tmp_path, method, table, boxed):
    path = write(
        table,
        ('"ppo"', f'"{method}"'),
        ("steps = 20", "steps = 10"),
        *([("boxed = false", "boxed = true")] if boxed else []),
    )
    told = run("learn", path, "--out", tmp_path / "out")
    assert told.exit_code == 0, told.output
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["method"] == method and result["evaluation"]["num_episodes"] == 200
    assert result["evaluation"]["success"]["mean"] > 0.9
    assert ("cost" in result["training"]["last"]) == ("cost" in path.read_text())
    environment, agent = job.load_agent(tmp_path / "out" / "policy.npz")
    again = evaluate(jax.random.key(5), agent, environment, num_episodes=200)
    assert again.success.mean > 0.9


@pytest.mark.slow
def test_tasks_without_end_are_told_by_visits(write, tmp_path):
    path = write(("!pit U goal", "G F goal & G F !goal"), ("steps = 20", "steps = 1"))
    told = run("learn", path, "--out", tmp_path / "out")
    assert "visits" in told.stdout and "accepting visits" in told.stdout
    page = (tmp_path / "out" / "report.html").read_text()
    assert "accepting visits" in page


def test_check_tells_the_sizes(write):
    told = run("check", write())
    assert told.exit_code == 0, told.output
    assert (
        "own.py:corridor: 2 actions, 4 numbers observed, 2 labels; 3 automaton states "
        "(cosafe); ppo with two networks with hidden layers [8]: 20 steps of at most 64 simulated "
        "steps, 1,280 in total per seed; evaluated by 200 fresh episodes of at most 8 steps"
    ) in told.stdout


@pytest.mark.parametrize("name", ["flat_world", "drone"])
def test_the_examples_are_sound(name):
    told = run("check", EXAMPLES / f"{name}.toml")
    assert told.exit_code == 0, told.output


WORLD_ = 'environment = "own.py:corridor"'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (WORLD_, 'environment = "no.such:thing"', "environment: there is no module 'no.such'"),
        (WORLD_, 'environment = "none.py:make"', "none.py"),
        (
            WORLD_,
            'environment = "own.py:make"',
            "'make' is not there in 'own.py'; its functions are ",
        ),
        (WORLD_, 'environment = "own.py:nothing"', "'nothing' is no function"),
        (WORLD_, 'environment = "nowhere"', "'nowhere' names no function; write"),
        (
            WORLD_ + "\n[world.arguments]\nboxed = false",
            'environment = "own.py:number"',
            "returns a int, no Environment",
        ),
        (
            WORLD_ + "\n[world.arguments]\nboxed = false",
            'environment = "own.py:breaks"',
            "'own.py:breaks' raises KeyError: 'no' (own.py, line ",
        ),
        (
            WORLD_ + "\n[world.arguments]\nboxed = false",
            'environment = "own.py:says_nothing"',
            "'own.py:says_nothing' raises ValueError (own.py, line ",
        ),
        ("boxed = false", "boxes = false", "does not take [world.arguments]: got an unexpected"),
        ("boxed = false", "ends = false", "[world] the environment has no horizon"),
        (
            WORLD_ + "\n[world.arguments]\nboxed = false",
            'environment = "own.py:bare"',
            "[world] environment 'own.py:bare' has no labels, and the formula mentions goal, pit",
        ),
        (WORLD_, WORLD_ + '\nlabels = "own.py:at_goal"', "[world] labels and propositions belong"),
        (
            WORLD_,
            WORLD_ + '\nlabels = "own.py:two_labels"\npropositions = ["goal"]',
            "[world] environment: 'labels': labels returns bool[2]; return bool[1]",
        ),
        (
            "!pit U goal",
            "!pit U gaol",
            "[task] formula: '!pit U gaol' mentions the proposition 'gaol'",
        ),
        ("!pit U goal", "goal & !goal", "[task] formula: nothing satisfies it"),
        ("!pit U goal", "(goal", "[task] formula: "),
        ('goal"', 'goal"\nreward = "keep"', "[task] "),
        ("hidden = [8]", "hiden = [8]", "[ppo] has no key 'hiden'; did you mean 'hidden'"),
        (
            "num_minibatches = 2",
            "num_minibatches = 5",
            "[ppo] num_minibatches=5 does not divide 64",
        ),
        ("num_envs = 8", "num_envs = 1000000000", "[ppo] a step of the learner would make 8,000"),
        ("[ppo]", "[cce]", "[cce] "),
        ('"ppo"', '"dqn"', '[learner] method = \'dqn\'; it must be "ppo" or "cce" or "cpo"'),
        ("episodes = 200", "episodes = 0", "[evaluation] episodes = 0; it must be a whole number"),
        ("episodes = 200", "confidence = 1", "[evaluation] confidence = 1; it must be a number"),
    ],
)
def test_mistakes_are_named_by_file_table_and_key(write, old, new, message):
    path = write((old, new))
    told = failure("check", path)
    assert "task.toml" in told and message in told, told


def test_mistakes_of_methods(write):
    cpo = (CPO, ('"ppo"', '"cpo"'))
    assert "[cpo] the environment has finitely many actions" in failure("check", write(*cpo))
    assert "[cpo] lacks limit" in failure("check", write(*cpo, ("limit = 0.5\n", "")))
    cce = (CCE, ('"ppo"', '"cce"'))
    assert "[cce] limit is that of a cost" in failure(
        "check", write(*cce, ("[cce]", "[cce]\nlimit = 0.1"))
    )
    assert "[cce] rho=0.01 of population=20 leaves no elite" in failure(
        "check", write(*cce, ("[cce]", "[cce]\nrho = 0.01"))
    )
    assert "[cce] a step of the learner would make 16,000,000,000 simulated steps" in failure(
        "check", write(*cce, ("population = 20", "population = 1000000000"))
    )


def test_labels_and_limits_of_the_file(write):
    path = write(
        (
            WORLD_,
            WORLD_ + '\nlabels = "own.py:two_labels"\npropositions = ["goal", "one"]\nhorizon = 5',
        ),
        ("!pit U goal", "F goal & F one"),
    )
    assert kind_of(path) == "environment"
    found = load_environment(EnvironmentFile.read(path))
    assert found.propositions == ("goal", "one") and found.horizon == 5


def test_a_fingerprint_changes_with_the_function(write, tmp_path):
    path = write()
    before = EnvironmentFile.read(path).digest
    (tmp_path / "own.py").write_text(WORLD + "\n")
    assert EnvironmentFile.read(path).digest != before


@pytest.mark.slow
def test_the_library_s_worlds_have_pictures(tmp_path):
    path = tmp_path / "letters.toml"
    path.write_text(
        '[world]\nenvironment = "letter_world"\narguments = { size = 3, letters = 2, num_copies = 1, '
        'horizon = 6, connected = false }\n[task]\nformula = "F a"\n[learner]\nmethod = "cce"\n'
        "steps = 1\n[cce]\npopulation = 5\nepisodes = 1\n[evaluation]\nepisodes = 20\n"
    )
    told = run("learn", path, "--out", tmp_path / "out")
    assert told.exit_code == 0, told.output
    assert b"<svg" in (tmp_path / "out" / "episodes.svg").read_bytes()
    assert "slider" not in told.stdout and (tmp_path / "out" / "episode.html").exists()
    assert "A few episodes" in (tmp_path / "out" / "report.html").read_text()


SIDES = """
<script>
window.addEventListener("load", () => {
  const found = {};
  document.querySelectorAll("details").forEach((x) => { x.open = true; });
  found.width = document.documentElement.scrollWidth;
  found.headings = [...document.querySelectorAll("h2")].map((x) => x.textContent);
  found.empty = [...document.querySelectorAll("img")].filter((x) => !x.naturalWidth).length;
  const verdict = document.createElement("pre");
  verdict.id = "verdict";
  verdict.textContent = JSON.stringify(found);
  document.body.append(verdict);
});
</script></body>"""


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_in_a_browser(learned, browser, tmp_path, width):  # noqa: F811
    _, out, _ = learned
    path = tmp_path / "report.html"
    shutil.copy(out / "report.html", path)
    path.write_text(path.read_text().replace("</body>", SIDES))
    found, said = browser(path, width)
    assert said == [] and found["width"] <= width and found["empty"] == 0
    assert found["headings"] == [
        "Evaluation",
        "Learning",
        "Automaton of the formula",
        "Task file",
    ]


@pytest.mark.parametrize(
    ("task", "learner", "shaped", "discounts"),
    [
        ("", "", False, (1.0, 1.0)),  # undiscounted: shaping would change what is best
        ("discount = 0.9", "", True, (0.9, 1.0)),
        ("", "discount = 0.95", True, (1.0, 0.95)),
        ('discount = 0.9\nshaping = "none"', "discount = 0.95", False, (0.9, 1.0)),
        ('shaping = "distance"', "discount = 0.95", True, (0.99, 0.95)),
    ],
)
def test_rewards_are_shaped_where_it_changes_no_optimum(write, task, learner, shaped, discounts):
    formula = 'formula = "!pit U goal"'
    made = write((formula, f"{formula}\n{task}"), ("[ppo]", f"[ppo]\n{learner}"))
    setup = job.prepare(EnvironmentFile.read(made), 0)
    tables = task_tables(setup.environment)
    assert bool(np.any(tables.potential)) == shaped
    open_ = np.asarray(tables.verdict) == 0
    np.testing.assert_allclose(np.asarray(tables.discount)[open_], discounts[0], rtol=1e-6)
    expected = discounts[1] if shaped else 1.0  # without shaping it is not used
    np.testing.assert_allclose(tables.learner_discount, expected, rtol=1e-6)
    assert not np.any(task_tables(without_shaping(setup.environment)).potential)


def test_rewards_of_whole_episodes_are_not_shaped(write):
    formula = 'formula = "!pit U goal"'
    setup = job.prepare(
        EnvironmentFile.read(
            write(CCE, ('"ppo"', '"cce"'), (formula, f"{formula}\ndiscount = 0.9"))
        ),
        0,
    )
    assert not np.any(task_tables(setup.environment).potential)
