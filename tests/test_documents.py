"""What the README, the pages with examples and the notebooks show runs as it stands."""

import importlib.util
import os
import re
import shlex
import warnings
from pathlib import Path

import jax
import nbformat
import pytest
from click.testing import CliRunner
from nbclient import NotebookClient

from jaxltl.cli import main

ROOT = Path(__file__).parent.parent
ADAPTED = ("brax", "craftax", "gymnax", "jumanji", "navix", "pgx", "xminigrid")


def test_the_readme_example_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 6
    names: dict = {}
    for code in blocks:
        exec(compile(code, "README.md", "exec"), names)
    assert names["allowed"].maximal and not names["state"].violations
    assert names["model"].num_transitions == names["coin"].num_transitions == 6
    assert names["metrics"].loss.shape == (4, 20)
    assert (names["metrics"].loss[:, -1] < names["metrics"].loss[:, 0]).all()
    assert names["found"].decision is True
    printed = capsys.readouterr().out
    for told in ("P >= 0.938 with confidence 0.95\n", "no policy has more than 0.986", "\n0.8333"):
        assert told in printed


def test_the_page_on_evaluation_runs(capsys):
    page = (ROOT / "docs" / "evaluation.md").read_text()
    names: dict = {}
    first, second = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(compile(first, "evaluation.md", "exec"), names)
    jl, jnp = names["jl"], names["jnp"]
    product = jl.product(names["world"], "!trap U goal")
    policy = jnp.broadcast_to(jnp.array([0, 0.5, 0, 0.5]), (9, product.num_memory, 4))
    exact = float(jl.satisfaction_probability(product, policy).value[0, product.automaton.initial])
    found = names["found"]
    assert f"it is {exact:.4f}" in page and found.success.lower <= exact <= found.success.upper
    printed = capsys.readouterr().out.splitlines()
    shown = page.split("```\n2,000")[1].split("```")[0].splitlines()
    assert [row.split()[:1] for row in printed[1:]] == [row.split()[:1] for row in shown[1:]]
    exec(compile(second, "evaluation.md", "exec"), names)
    assert names["again"].decision is True


def test_the_page_on_worlds_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "worlds-of-the-literature.md").read_text()
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(code, "worlds-of-the-literature.md", "exec"), names)
    assert (tmp_path / "flat.png").read_bytes()[:4] == b"\x89PNG"
    assert "9800 keyless 75\n" in capsys.readouterr().out
    gap = names["gap"]
    assert gap.mean_optimum == (1.0, 1.0) and 0.2 < gap.mean_value[0] < 0.6
    assert 0 <= gap.mean[1] - gap.mean[0] < 1e-9


def devices_page(blocks):
    page = (ROOT / "docs" / "devices.md").read_text()
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL)[:blocks]:
        exec(compile(code, "devices.md", "exec"), names)
    return names


def test_the_page_on_devices_runs(capsys):
    states = devices_page(1)["states"]
    assert capsys.readouterr().out == f"{[40] * 8} 0\n".replace(",", "")
    assert len(states.q.sharding.device_set) == 4


@pytest.mark.exhaustive
def test_one_seed_over_several_devices_runs(capsys):
    devices_page(2)
    assert capsys.readouterr().out.splitlines()[1].split() == ["[0.5", "1.", "]"]


def test_models_over_a_mesh_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "devices.md").read_text().split("## Models over a mesh")[1]
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL)[:2]:
        exec(compile(code, "devices.md", "exec"), names)
        promised = re.findall(r"print\(.*\)\s+# (\([^)]*\)|[0-9.]+)", code)
        assert capsys.readouterr().out.splitlines() == promised
    model, again = names["model"], names["again"]
    assert again.num_given == model.num_given and again.rounds == model.rounds


NEEDS = {"08_from_a_simulator_to_an_interval": ["gymnax"]}  # by a notebook, beside the tests' own


@pytest.mark.notebook
@pytest.mark.parametrize("path", sorted(ROOT.glob("notebooks/*.ipynb")), ids=lambda p: p.stem)
def test_a_notebook_runs(path, tmp_path):
    for package in NEEDS.get(path.stem, ()):
        pytest.importorskip(package)
    notebook = nbformat.read(path, as_version=4)
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    for name in re.findall(rf"^\s*(?:import|from) ({'|'.join(ADAPTED)})\b", code, re.MULTILINE):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"{path.stem} needs the package {name}")
    client = NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}})
    client.execute(env={**os.environ, "XLA_FLAGS": ""})  # long enough to be compiled for speed
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", ())]
    assert not [o for o in outputs if o.output_type == "error"]
    assert sum("image/png" in o.get("data", {}) for o in outputs) >= 3


def test_the_page_on_intervals_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "intervals.md").read_text()
    (shell,) = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    text, command = shell.removeprefix("cat > rover.drn <<'END'\n").split("END\n")
    (tmp_path / "rover.drn").write_text(text)
    done = CliRunner().invoke(main, shlex.split(command.replace("\\\n", ""))[1:])
    assert done.exit_code == 0, done.output
    shown = re.search(r"\n```\n(imdp.*?)```", page, re.DOTALL)[1].split("\n\n")
    found = re.sub(r", read in [^\n]*|[0-9.]+ s, ", "", done.stdout).strip().split("\n\n")
    assert len(shown) == len(found)
    for promised, printed in zip(shown, found, strict=True):
        number = re.compile(r"\d\.\d+")
        # Digits beyond the tolerance depend on the machine.
        assert number.sub("", promised).split() == number.sub("", printed).split()
        for a, b in zip(number.findall(promised), number.findall(printed), strict=True):
            assert abs(float(a) - float(b)) <= 1e-6
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(compile(code, "intervals.md", "exec"), {})
    assert capsys.readouterr().out == "0.4 [0.4 0.6 1.  1. ]\n[0.7]\n0.3\n"


def test_the_page_on_tasks_in_environments_runs(capsys):
    page = (ROOT / "docs" / "tasks-in-environments.md").read_text()
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(code, "tasks-in-environments.md", "exec"), names)
    promised = re.findall(r"print\(.*\)\s+# ([^:\n]*)", page)
    assert len(promised) == 4 and capsys.readouterr().out.splitlines() == promised


def test_the_page_on_ppo_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "ppo.md").read_text()
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(code, "ppo.md", "exec"), names)
    best, found = float(names["best"]), names["found"].success
    (promised,) = re.findall(r"print\(.*\)  # (.*)", page)
    assert promised.endswith(f"at best {best:.3f}") and capsys.readouterr().out.endswith(
        f"at best {best:.3f}\n")
    assert found.lower <= best and found.mean > best - 0.1
    assert names["metrics"].episode_return.shape == (3, 4, 60)
    assert b"<svg" in (tmp_path / "rates.svg").read_bytes()


def test_the_page_on_many_formulas_runs(capsys):
    page = (ROOT / "docs" / "many-formulas.md").read_text()
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(code, "many-formulas.md", "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    (sequences,) = re.findall(r"```\n(3 steps.*?)```", page, re.DOTALL)
    assert printed[3:-1] == sequences.splitlines()
    assert names["found"].success.lower > 0.8 and len(names["formulas"]) == 3
    assert names["gap"].mean_optimum == (1.0, 1.0) and names["gap"].mean[1] < 0.2


@pytest.mark.parametrize("name", ADAPTED)
@pytest.mark.filterwarnings("ignore:Brax System:UserWarning")
def test_the_page_on_environments_runs(name, capsys):
    page = (ROOT / "docs" / "environments.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (code,) = (x for x in blocks if re.search(rf"^(import|from) {name}\b", x, re.MULTILINE))
    assert len(blocks) == 7
    with jax.enable_x64(False), warnings.catch_warnings():  # as the packages are imported
        warnings.simplefilter("ignore", DeprecationWarning)
        pytest.importorskip(name)
        capsys.readouterr()
        exec(compile(code, "environments.md", "exec"), {})
    (promised,) = re.findall(r"print\(.*\)\s+# (.*)", code)
    assert capsys.readouterr().out.splitlines() == [promised]


def test_the_page_on_data_shows_what_the_command_prints(tmp_path, monkeypatch):
    """And the log of the example is what the script on the page writes."""
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "data.md").read_text()
    (script,) = (x for x in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "WORLD" in x)
    exec(compile(script, "data.md", "exec"), {})
    log = (ROOT / "examples" / "log_patrol.csv").read_text()
    assert (tmp_path / "log_patrol.csv").read_text() == log
    monkeypatch.chdir(ROOT)
    (shell,) = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    done = CliRunner().invoke(main, shlex.split(shell.replace("\\\n", ""))[1:])
    assert done.exit_code == 0, done.output
    shown = re.search(r"\n```\n(P >= .*?)```", page, re.DOTALL)[1]
    assert re.sub(r"\n  [0-9.]+ s\n", "\n", done.stdout) == shown
