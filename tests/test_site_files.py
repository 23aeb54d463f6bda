"""The reference of task and game files states each key, with a default and a valid example."""

import importlib.util
import inspect
import itertools
import tomllib
from pathlib import Path

import pytest

from jaxltl.algos.common.demonstrations import sample_demonstrations
from jaxltl.app.files import (
    game,
    schema,
    task,
    task_irl,
    task_rl,
)
from jaxltl.app.files.schema import Count, TomlTable, table
from jaxltl.core.environments.task_environment import make_task_tables
from jaxltl.envs.gridworld import gridworld
from jaxltl.envs.robots import grid_game, places
from jaxltl.envs.temporal_gridworld import World, expert_reward, random_worlds

ROOT = Path(__file__).parent.parent
spec = importlib.util.spec_from_file_location("site_files", ROOT / "docs/site/site_files.py")
site_files = importlib.util.module_from_spec(spec)
spec.loader.exec_module(site_files)

FILES = {found.title: found.schema for found in site_files.PAGES.values()}
TABLES = list(
    dict.fromkeys(
        [*FILES.values()]
        + [kind for file in FILES.values() for kind, _ in site_files.tables(file).values()]
    )
)
# Keys that a file has together with others: names that complete a table, of which one is enough.
COMPLETIONS = {
    task_irl.ModelTable: (
        "map",
        "model",
        "transitions initial confidence graph",
        "transitions initial confidence least_probability",
    ),
    task_irl.FileOrSyntheticTable: ("file", "synthetic"),
    task_irl.MlirlTable: ("", "optimizer", "in goal"),
    task_irl.ScenesTable: ("", "legend"),
    task_irl.ExpertTable: ("files", "synthetic", "synthetic discount"),
    task_irl.TestScenesTable: ("maps", "generate"),
    task_irl.DemonstratorTable: ("files", "synthetic meaning"),
    task_rl.SimulatorTable: ("", "environment", "environment labels propositions"),
    task_rl.CceTable: ("", "cost limit"),
    game.GameTable: ("map", "model"),
    game.ObjectiveTable: ("", "formula", "guarantees"),
}


def id_of(kind):
    return f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}"


def keys_of(kind):
    is_file = issubclass(kind, schema.File)
    return site_files.file_keys(kind) if is_file else site_files.table_keys(kind)


def values(kind, names):
    """Keys of a table with the values of their examples."""
    entries = {key.name: site_files.entry(kind, key) for key in keys_of(kind)}
    return tomllib.loads("\n".join(f"{name} = {entries[name].example}" for name in names))


def converted(kind, names):
    """The table with the examples of some keys, or the error."""
    required = [key.name for key in keys_of(kind) if key.default is ...]
    data = values(kind, dict.fromkeys([*required, *names]))
    try:
        return schema.convert(Path("file.toml"), kind, data, "table")
    except ValueError as error:
        return error


@pytest.mark.parametrize("kind", TABLES, ids=id_of)
def test_every_key_has_a_meaning_a_default_and_an_example(kind):
    for key in keys_of(kind):
        found = site_files.entry(kind, key)
        assert all(found), found
        assert found.meaning[0].isupper() or found.meaning[0] == '"', found
        assert (found.default == "required") >= (key.default is ...)
        assert key.default is None or key.default is ... or found.default != "none"


@pytest.mark.parametrize("kind", [x for x in TABLES if not issubclass(x, schema.File)], ids=id_of)
def test_every_example_is_valid(kind):
    for key in keys_of(kind):
        tries = [
            converted(kind, [key.name, *names.split()]) for names in COMPLETIONS.get(kind, ("",))
        ]
        valid = [x for x in tries if isinstance(x, TomlTable)]
        assert valid, (key.name, tries)
        assert valid[0].specified()[key.name] is not None


def test_examples_of_names_of_files_are_valid():
    for file in FILES.values():
        for key, field in itertools.product(keys_of(file), schema._fields(file)):
            if schema.key_name(field) == key.name:
                (value,) = values(file, [key.name]).values()
                assert schema._converted(value, field.type) == value


def test_defaults_in_words_are_those_of_the_code():
    def stated(kind, name):
        key = next(key for key in keys_of(kind) if key.name == name)
        return site_files.entry(kind, key).default

    def default(function, name):
        return inspect.signature(function).parameters[name].default

    for kind, name, function in (
        (task.GridTable, "wall", gridworld),
        (task.GridTable, "slip", gridworld),
        (game.GameTable, "wall", places),
        (game.GameTable, "slip", grid_game),
        (game.GameTable, "system_stays", grid_game),
        (game.GameTable, "environment_stays", grid_game),
        (task_irl.ScenesTable, "margin", World),
        (task_irl.TestScenesTable, "min_distance", random_worlds),
        *((task_irl.ExpertTable, x, expert_reward) for x in task_irl.REWARDS),
    ):
        value = default(function, name)
        assert stated(kind, name) in (f"{value:g}" if type(value) is float else str(value).lower())
    assert stated(task.SyntheticTable, "length") == str(default(sample_demonstrations, "length"))
    ending = stated(task_rl.RewardTable, "ending")
    assert ending.partition(",")[0] == default(make_task_tables, "ending")


def test_pages_have_every_key_and_an_example_file():
    pages = site_files.pages()
    for slug, found in site_files.PAGES.items():
        for name, (kind, required) in site_files.tables(found.schema).items():
            head, _, rest = pages[slug].partition(f"\nTable [{name}]\n")
            part = rest.partition("\nTable [")[0]
            assert head and ("Required." in part) == required
            for key in keys_of(kind):
                assert f"``{key.name}``" in part and f"``{key.name} = {key.example}``" in part
        path = ROOT / "examples" / found.example
        assert f"literalinclude:: ../../examples/{found.example}" in pages[slug]
        schema.convert(path, found.schema, schema.read_toml(path, "the file")[0])


@pytest.mark.parametrize("text", ["Number of steps.", "", "Number of steps; default "])
def test_a_key_without_a_stated_default_is_an_error(text):
    @table
    class Training(TomlTable):
        steps: Count | None = schema.key(text)

    (key,) = site_files.keys_of(Training)
    with pytest.raises(ValueError, match="steps lacks a text, a default or an example"):
        site_files.entry(Training, key)


def test_the_example_of_a_type():
    @table
    class Training(TomlTable):
        rate: schema.Confidence = schema.key("Rate.")
        own: Count = schema.key("Own.", "7", default=3)
        nothing: str | None = schema.key("Nothing.")

    assert [key.example for key in site_files.keys_of(Training)] == ["0.95", "7", ""]
