"""The shape of the package: which way imports flow, what is public, and what importing does."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxltl

ROOT = Path(jaxltl.__file__).parent
MODULES = {
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts): path
    for path in sorted(ROOT.rglob("*.py")) if path.name != "__init__.py"
}
NO_JAX = tuple(
    f"jaxltl.core.{name}" for name in (
        "ltl", "diagram", "emerson_lei", "automaton", "simplify", "normal_form", "progression",
        "parity", "trackers", "language", "translate",
    )
)

# Lower rooms first: a module of the core imports only from rows above its own.
LAYERS = [
    {"types", "ltl", "diagram", "emerson_lei"},
    {"mdp", "automaton", "simplify", "progression", "labels", "exponential_family"},
    {"operators", "parity", "normal_form"},
    {"game", "rollout", "language", "trackers"},
    {"translate", "graph", "fixed_point", "objective"},
    {"product", "monitor"},
    {"flat", "stack"},
    {"acceptance", "stiff", "bellman", "occupancy", "gr1", "pac", "span_iteration",
     "finite_task"},
    {"reachability", "winning", "game_value", "mean_payoff"},
    {"verify", "permissive", "task_performance"},
]

PUBLIC = [
    "GR1", "MDP", "Automaton", "DenseMDP", "FiniteMemoryPolicy", "Formula", "Game", "Monitor",
    "NotConverged", "Parity", "Permissive", "Product", "Solution", "Status", "Trajectories",
    "Verdict", "Verification", "Winning", "almost_sure_buchi", "almost_surely_reaching",
    "apply_strategy", "attractor", "avoidable", "boltzmann_fixed_points", "boltzmann_value",
    "buchi", "check", "cobuchi", "complement", "end_components", "exists_successor", "expectation",
    "feature_expectation", "find_difference", "forall_successor", "from_dense",
    "generalized_buchi", "gr1", "grid_game", "gridworld", "holds_on_lasso", "is_equivalent",
    "letters", "lift_memory", "lift_policy", "lift_trajectories", "make_automaton", "make_game",
    "make_mdp", "make_monitor", "make_trajectories", "mean_payoff", "minimax_value",
    "monitor_step", "occupancy_measure", "optimal_satisfaction", "optimal_value", "parity",
    "parse_ltl", "permissive_strategy", "policy_value", "product", "project_policy", "pushforward",
    "reach", "reachability_probability", "read_hoa", "restrict", "rollout", "safety",
    "sample_successor", "satisfaction_probability", "shield", "soft_value", "stack_products",
    "states_where", "strategy_value", "synchronize", "task_performance", "task_performances",
    "to_automaton", "to_dense", "verdict", "verify", "winning_region", "write_hoa",
]


def imports(name: str) -> set[str]:
    """Everything that a module imports anywhere in its text, as dotted names."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import in line {node.lineno}"
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def imports_any(name: str, roots: tuple[str, ...]) -> list[str]:
    return sorted(
        found for found in imports(name)
        if any(found == root or found.startswith(f"{root}.") for root in roots)
    )


@pytest.mark.parametrize("name", [n for n in MODULES if n.startswith("jaxltl.core.")])
def test_the_core_stands_alone(name):
    forbidden = (
        "optax", "flax.linen", "flax.nnx", "matplotlib", "click", "tqdm", "jaxltl.algos",
        "jaxltl.envs", "jaxltl.io", "jaxltl.plot", "jaxltl.cli", "jaxltl.reproduce",
    )
    assert not imports_any(name, forbidden)


@pytest.mark.parametrize("name", NO_JAX)
def test_logic_never_imports_jax(name):
    assert not imports_any(name, ("jax", "jaxlib", "flax", "chex"))
    others = {found for found in imports(name) if found in MODULES}
    assert others <= set(NO_JAX), "a module that imports JAX itself"


def test_imports_of_the_core_flow_one_way():
    level = {module: i for i, layer in enumerate(LAYERS) for module in layer}
    for name in MODULES:
        if not name.startswith("jaxltl.core."):
            continue
        own = name.removeprefix("jaxltl.core.")
        assert own in level, f"{own} has no place in LAYERS; give it one"
        for found in imports(name):
            other = found.removeprefix("jaxltl.core.").split(".")[0]
            if found.startswith("jaxltl.core.") and other in level:
                assert level[other] < level[own], f"{own} imports {other}"


@pytest.mark.parametrize("name", [n for n in MODULES if n.startswith("jaxltl.algos.")])
def test_learners_never_import_one_another(name):
    shared = ("jaxltl.algos.learner", "jaxltl.algos.play")
    others = [
        found for found in imports_any(name, ("jaxltl.algos",))
        if found != "jaxltl.algos" and not f"{found}.".startswith(tuple(f"{n}." for n in shared))
    ]
    assert not others
    assert not imports_any(name, ("jaxltl.cli", "jaxltl.plot", "jaxltl.reproduce", "matplotlib"))


@pytest.mark.parametrize("name", [n for n in MODULES if n.startswith("jaxltl.envs.")])
def test_worlds_import_the_core_alone(name):
    outside = [n for n in imports_any(name, ("jaxltl",))
               if not n.startswith(("jaxltl.core", "jaxltl.envs"))]
    assert not outside


def test_public_names_are_as_agreed():
    assert jaxltl.__all__ == PUBLIC


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_are_documented(name):
    assert (getattr(jaxltl, name).__doc__ or "").strip()
    assert not getattr(jaxltl, name).__doc__.startswith(f"{name}("), "a generated docstring"


def test_importing_changes_no_setting_and_stays_light():
    heavy = ("matplotlib", "click", "optax", "scipy", "tqdm")
    show = f"print(*[name for name in {heavy} if name in sys.modules])"
    program = f"""
import sys, jax
before = dict(jax.config.values)
import jaxltl
after = {{name: jax.config.values[name] for name in before}}  # flax may register others
assert after == before, "a setting of JAX was changed"
{show}"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False,
        cwd=ROOT.parent,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stdout.split()
