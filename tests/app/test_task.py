"""Task files: what is read, and that every mistake is named with its place and fix."""

import io
import json
import re
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxltl
from jaxltl.app import run_job
from jaxltl.app.files.schema import File
from jaxltl.app.files.task_irl import MlirlFile
from jaxltl.app.files.worlds import load_demonstrations, load_world, synthetic_demonstrations
from jaxltl.app.processes import ProcessGroup
from jaxltl.core.models.product import product
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from tests.support import replaced

TASK = """
[world]
map = '''
. . r
b . y
'''
absorbing = ["y"]
initial = "!r & !y"

[task]
formula = "!r U y"

[demonstrations]
file = "shown.json"

[learner]
method = "mlirl"
discount = 0.9
"""
SHOWN = {"demonstrations": [{"cells": [[2, 1], [2, 2], [2, 3]], "actions": ["right", "right"]}]}


@pytest.fixture
def write(tmp_path):
    """Writes a task, after replacing parts of it, and its demonstrations."""

    def write(*replacements, shown=SHOWN):
        (tmp_path / "task.toml").write_text(replaced(TASK, *replacements))
        if shown is not None:
            text = shown if isinstance(shown, str) else json.dumps(shown)
            (tmp_path / "shown.json").write_text(text)
        return tmp_path / "task.toml"

    return write


def test_a_task_is_read(write):
    task = MlirlFile.read(write())
    world = load_world(task.path, task.world)
    assert task.name == "task" and task.label_on == "entry"
    assert world.cells.shape == (2, 3) and world.position_text(5) == "row 2, column 3"
    shown = load_demonstrations(task, world)
    assert shown.state.tolist() == [[3, 4]] and shown.action.tolist() == [[3, 3]]


def test_states_and_action_numbers_from_zero(write):
    shown = {"demonstrations": [{"states": [3, 4], "actions": [3, "right"]}]}
    task = MlirlFile.read(write(shown=shown))
    assert load_demonstrations(task, load_world(task.path, task.world)).state.tolist() == [[3, 4]]


def test_a_map_and_legend_from_a_file(write, tmp_path):
    (tmp_path / "map.txt").write_text("a b\nb a\n")
    task = MlirlFile.read(
        write(
            (
                "map = '''\n. . r\nb . y\n'''",
                'map = { file = "map.txt" }\nlegend = { a = [], b = ["r", "y"] }\nslip = 0.2',
            )
        )
    )
    mdp = load_world(task.path, task.world).mdp
    assert mdp.propositions == ("r", "y") and mdp.num_successors == 3
    assert np.asarray(mdp.initial).tolist() == [0.5, 0, 0, 0.5]


def test_the_digest_covers_named_files(write):
    first = MlirlFile.read(write()).digest
    other = {"demonstrations": [{"cells": [[2, 2]], "actions": ["right"]}]}
    assert MlirlFile.read(write(shown=other)).digest != first
    assert MlirlFile.read(write(("0.9", "0.8"))).digest != first
    assert MlirlFile.read(write()).digest == first


@pytest.mark.parametrize(
    ("replacement", "message"),
    [
        (("discount = 0.9", "discount = "), r"task\.toml: this is not TOML: .*line 18"),
        (("[learner]", "[learnt]"), r"has no key 'learnt'; did you mean 'learner'\?"),
        (("discount", "discnt"), r"\[learner\] has no key 'discnt'; did you mean 'discount'\?"),
        (("absorbing", "absorb"), r"\[world\] has no key 'absorb'; did you mean 'absorbing'\?"),
        (("discount = 0.9", ""), r"\[learner\] lacks discount, a finite number in \[0, 1\)"),
        (("discount = 0.9", "discount = 1.0"), r"discount = 1\.0; it must be a finite number in"),
        (("discount = 0.9", "discount = true"), r"discount = True; it must be"),
        (("discount = 0.9", "discount = nan"), r"discount = nan; it must be a finite number"),
        (("discount = 0.9", "discount = 0.9\nsteps = 0"), r"steps = 0; it must be a whole number"),
        (("discount = 0.9", "discount = 0.9\nmu = -1"), r"must be a number, at least 0 and finite"),
        (
            ("discount = 0.9", "discount = 0.9\nmu = inf"),
            r"mu = inf; it must be a number, at least 0 and finite",
        ),
        (
            ("discount = 0.9", "discount = 0.9\nl2 = nan"),
            r"l2 = nan; it must be a number, at least 0 and finite",
        ),
        (
            ("discount = 0.9", "discount = 0.9\nmu = 1" + 400 * "0"),
            r"it must be a number, at least 0 and finite",
        ),
        (
            ("discount = 0.9", "discount = 0.9\nguess = [1, inf]"),
            r"a list of finite numbers, one per",
        ),
        (
            ("discount = 0.9", "discount = 0.9\nlearning_rate = 0.1"),
            r'learning_rate belongs to another optimizer, such as "adam"; "lbfgs", the default, searches',
        ),
        (
            ("discount = 0.9", 'discount = 0.9\noptimizer = "lbfgs"\nlearning_rate = 0.1'),
            r"learning_rate belongs to another optimizer",
        ),
        (("[task]", "[task]\nguarantee = nan"), r"a probability in \(0, 1\]"),
        (("discount = 0.9", 'discount = 0.9\nin = "world"'), r"lacks goal"),
        (("discount = 0.9", 'discount = 0.9\nin = "world"\ngoal = ["y"]\nmu = 1'), r"mu weighs"),
        (("discount = 0.9", 'discount = 0.9\ngoal = ["y"]'), r'goal belongs to in = "world"'),
        (("discount = 0.9", 'discount = 0.9\nprogress = ["y"]'), r"a list of automaton states"),
        (('"mlirl"', '"irl"'), r'method = \'irl\'; it must be "mlirl"'),
        (('formula = "!r U y"', ""), r"\[task\] lacks formula"),
        (("[task]", "[tsk]"), r"has no key 'tsk'; did you mean 'task'\?"),
        (('file = "shown.json"', ""), r"either file"),
        (("[task]", '[task]\nguarantee = "all"'), r'"best", "none", a probability in \(0, 1\]'),
        (("[task]", "[task]\nguarantee = 0"), r"a probability in \(0, 1\]"),
        (
            ("[task]", '[task]\nover = "worst"'),
            r"over belongs to a guarantee that is a probability",
        ),
        (
            ('file = "shown.json"', 'file = "shown.json"\nlength = 3'),
            r"length belongs to synthetic",
        ),
        (('file = "shown.json"', 'file = "gone.json"'), r"gone\.json': No such file"),
        (("map = '''\n. . r\nb . y\n'''", ""), r"\[world\] must have either a map, a model"),
        (("map = '''\n. . r\nb . y\n'''", 'model = "m.npz"'), r"absorbing belongs to a map"),
        (("map = '''\n. . r\nb . y\n'''", "map = { name = 'x' }"), r'or \{ file = "map\.txt" \}'),
    ],
)
def test_mistakes_in_the_task_file(write, replacement, message):
    with pytest.raises(ValueError, match=message):
        MlirlFile.read(write(replacement))


@pytest.mark.parametrize(
    "name", ["../../evil", "/tmp/evil", "a/b", "a\\\\b", ".hidden", "..", " a", "", "a\\nb", "a:b"]
)
def test_names_are_plain(write, name):
    with pytest.raises(ValueError, match=r"name = .*; it must be a plain name of letters, digits"):
        MlirlFile.read(write(("\n[world]", f'name = "{name}"\n[world]')))


@pytest.mark.parametrize("name", ["two goals", "-1_a.b", "Größe 3"])
def test_plain_names_are_taken(write, name):
    assert MlirlFile.read(write(("\n[world]", f'name = "{name}"\n[world]'))).name == name


def test_a_learning_rate_of_an_optimizer_that_takes_one(write):
    given = 'discount = 0.9\noptimizer = "adam"\nlearning_rate = 0.1'
    assert MlirlFile.read(write(("discount = 0.9", given))).learner.learning_rate == 0.1


def test_a_missing_task_file(tmp_path):
    with pytest.raises(ValueError, match=r"the task file cannot be read: '.*none\.toml'"):
        MlirlFile.read(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("replacement", "message"),
    [
        ((". . r\n", ". . .\n"), r"\[world\] initial: .* mentions the proposition 'r'"),
        (("b . y", "b y"), r"\[world\] map row 2 has 2 cells, row 1 has 3"),
        (
            ('absorbing = ["y"]', "slip = 0.1\nlegend = { b = [] }"),
            r"\(row 1, column 1\) is not in",
        ),
    ],
)
def test_mistakes_in_the_world(write, replacement, message):
    with pytest.raises(ValueError, match=message):
        task = MlirlFile.read(write(replacement))
        load_world(task.path, task.world)


@pytest.mark.parametrize(
    ("shown", "message"),
    [
        ("{", r"shown\.json: this is not JSON: .*line 1 column 2"),
        ([], r"expected \{\"demonstrations\": \[\.\.\.\]\}"),
        ({"demonstrations": []}, r"at least one demonstration"),
        ({"demonstrations": [[1, 2]]}, r"demonstration 1: expected .* got \[1, 2\]"),
        ({"demonstrations": [{"cells": [[1, 1]], "action": []}]}, r"it has 'action', 'cells'"),
        ({"demonstrations": [{"cells": [[1, 1]], "actions": []}]}, r"at least one action"),
        (
            {"demonstrations": [{"cells": [[1, 1]], "actions": ["up"] * 3}]},
            r"1 cells and 3 actions",
        ),
        (
            {
                "demonstrations": [
                    *SHOWN["demonstrations"],
                    {"cells": [[2, 1], [1, 2]], "actions": ["right", "up"]},
                ]
            },
            r"demonstration 2, step 1: 'right' in row 2, column 1 cannot lead to row 1, column 2, "
            r"which comes next; it leads to row 2, column 2\.",
        ),
        (
            {"demonstrations": [{"cells": [[2, 1], [2, 3]], "actions": ["right"]}]},
            r"demonstration 1, step 1: .* cannot lead to row 2, column 3",
        ),
        (
            {"demonstrations": [{"cells": [[2, 1], [3, 1]], "actions": ["up", "up"]}]},
            r"demonstration 1, step 2: the cell \[3, 1\] is off the map, which has rows 1 to 2",
        ),
        ({"demonstrations": [{"cells": [[2, 0]], "actions": ["up"]}]}, r"\[2, 0\] is off the map"),
        ({"demonstrations": [{"cells": [[2]], "actions": ["up"]}]}, r"must be \[row, column\]"),
        (
            {"demonstrations": [{"cells": [[2, 1]], "actions": ["jump"]}]},
            r"step 1: the action 'jump' is unknown; the actions are up, down, left, right",
        ),
        ({"demonstrations": [{"states": [6], "actions": [0]}]}, r"state is 6; states are 0 to 5"),
    ],
)
def test_mistakes_in_demonstrations(write, shown, message):
    task = MlirlFile.read(write(shown=shown))
    with pytest.raises(ValueError, match=message):
        load_demonstrations(task, load_world(task.path, task.world))


def _model_task(write, *more, **arrays):
    path = write(
        ("map = '''\n. . r\nb . y\n'''", 'model = "m.npz"'),
        ('absorbing = ["y"]\ninitial = "!r & !y"', ""),
        *more,
    )
    np.savez(path.parent / "m.npz", **arrays)
    return MlirlFile.read(path)


CHAIN = np.array([[[0.5, 0.5], [1, 0]], [[0, 1], [0, 1]]])


def test_a_model_from_arrays(write):
    task = _model_task(
        write, transition=CHAIN, label=[[False], [True]], propositions=["y"], actions=["go", "wait"]
    )
    world = load_world(task.path, task.world)
    assert world.actions == ("go", "wait") and world.cells is None
    assert world.position_text(1) == "state 1"
    path = task.path.parent / "shown.json"
    path.write_text('{"demonstrations": [{"states": [0, 0, 1], "actions": ["go", "go"]}]}')
    assert load_demonstrations(task, world).state.tolist() == [[0, 0]]
    path.write_text('{"demonstrations": [{"states": [0, 1], "actions": ["wait"]}]}')
    with pytest.raises(ValueError, match=r"'wait' in state 0 cannot lead to state 1"):
        load_demonstrations(task, world)
    path.write_text('{"demonstrations": [{"cells": [[1, 1]], "actions": ["wait"]}]}')
    with pytest.raises(ValueError, match=r"the model has no map"):
        load_demonstrations(task, world)


def test_a_model_from_successor_lists_with_initial_formula(write):
    task = _model_task(
        write,
        ("[task]", 'initial = "!y"\n[task]'),
        successor=[[[0, 1]], [[1, 0]]],
        probability=[[[0.5, 0.5]], [[1.0, 0]]],
        label=[[False], [True]],
        propositions=["y"],
    )
    world = load_world(task.path, task.world)
    assert np.asarray(world.mdp.initial).tolist() == [1, 0]
    assert world.actions == ("action 0",)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"transition": CHAIN * 1.1}, r"m\.npz': state 0, action 0: the probabilities sum to 1\.1"),
        ({"transition": CHAIN, "labels": [1]}, r"holds an array 'labels'; it may hold"),
        ({"successor": [[[0]]]}, r"needs the array transition, or successor and probability"),
        ({"transition": CHAIN, "actions": ["a"]}, r"1 distinct names; the model has 2 actions"),
        ({"successor": [[[2]]], "probability": [[[1.0]]]}, r"successor 2 is out of range"),
        (
            {"transition": CHAIN, "propositions": ["y"]},
            r"m\.npz': there are propositions \('y',\) but no label, .*; give label as bool\[2, 1\]",
        ),
    ],
)
def test_mistakes_in_a_model(write, arrays, message):
    with pytest.raises(ValueError, match=message):
        task = _model_task(write, **arrays)
        load_world(task.path, task.world)


def _broken(name, good):
    if name == "nonsense":
        return b"nonsense"
    if name == "cut":
        return good[: len(good) // 2]
    if name == "no array":
        return good.replace(b"\x93NUMPY", b"\x93NOMPY")
    if name == "header":
        return good.replace(b"'descr'", b"'desrc'")
    file = io.BytesIO()
    if name == "single":
        np.save(file, CHAIN)
    else:
        np.savez(file, transition=np.array([None, {}]))
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nonsense", "it is damaged, or not written by numpy"),
        ("cut", "it is damaged, or not written by numpy"),
        ("no array", "its array 'transition' is damaged, or not"),
        ("header", "its array 'transition' is damaged, or not"),
        ("single", "it holds a single array; numpy.savez"),
        ("objects", "its array 'transition' holds Python objects, such as None; save numbers"),
    ],
)
def test_a_model_that_is_no_npz(write, tmp_path, name, message):
    task = _model_task(write, transition=CHAIN)
    path = tmp_path / "m.npz"
    path.write_bytes(_broken(name, path.read_bytes()))
    with pytest.raises(ValueError, match=rf"is not an \.npz of plain arrays: {message}") as raised:
        load_world(task.path, task.world)
    assert "pickle" not in str(raised.value)


def test_an_unknown_proposition_in_a_models_initial(write):
    task = _model_task(write, ("[task]", 'initial = "!q"\n[task]'), transition=CHAIN)
    with pytest.raises(ValueError, match=r"initial: '!q' mentions the proposition 'q'"):
        load_world(task.path, task.world)


def simulate(task, model, key, best):
    return synthetic_demonstrations(key, task.path, task.demonstrations, model, best)


@pytest.mark.slow
@pytest.mark.parametrize("discount", ["discount = 0.9", ""])
def test_synthetic_demonstrations_do_the_task(write, discount):
    synthetic = ('file = "shown.json"', f"synthetic = 5\n{discount}\nlength = 9")
    task = MlirlFile.read(write(synthetic))
    world = load_world(task.path, task.world)
    model = product(world.mdp, task.formula)
    shown, dropped = simulate(task, model, jax.random.key(0), optimal_satisfaction(model))
    lengths = np.asarray(shown.length)
    assert len(lengths) + dropped == 5 and dropped == 0
    for states, actions, n in zip(shown.state, shown.action, lengths, strict=True):
        last = int(world.mdp.successor[states[n - 1], actions[n - 1], 0])
        assert last == 5 and 2 not in states[:n].tolist()


@pytest.mark.slow
def test_synthetic_demonstrations_need_a_task_that_can_be_done(write):
    synthetic = ('file = "shown.json"', "synthetic = 5\ndiscount = 0.9\nlength = 1")
    task = MlirlFile.read(write(synthetic, ('initial = "!r & !y"', 'initial = "b"')))
    model = product(load_world(task.path, task.world).mdp, task.formula)
    with pytest.raises(
        ValueError, match=r"none of 5 synthetic rollouts satisfies the formula within 1 steps"
    ):
        simulate(task, model, jax.random.key(0), optimal_satisfaction(model))
    safety = product(load_world(task.path, task.world).mdp, "G !r")
    with pytest.raises(ValueError, match=re.escape("takes a co-safe formula")):
        simulate(task, safety, jax.random.key(0), optimal_satisfaction(safety))


@pytest.mark.parametrize("runs", ["synthetic = 2000000000", "synthetic = 20\nlength = 2000000000"])
def test_more_runs_than_memory_holds_are_refused(write, runs):
    task = MlirlFile.read(write(('file = "shown.json"', runs)))
    model = product(load_world(task.path, task.world).mdp, task.formula)
    with pytest.raises(ValueError, match=r"would take about .* GB; ask for fewer or shorter ones"):
        simulate(task, model, jax.random.key(0), optimal_satisfaction(model))


def test_synthetic_runs_of_a_task_without_end(write):
    """They have the asked length, and what they have to visit they visit again and again."""
    task = MlirlFile.read(
        write(
            ('file = "shown.json"', "synthetic = 4\nlength = 12"),
            ('absorbing = ["y"]', "absorbing = []"),
        )
    )
    model = product(load_world(task.path, task.world).mdp, "G F b & G F y & G !r")
    shown, dropped = simulate(task, model, jax.random.key(0), optimal_satisfaction(model))
    assert dropped + len(shown.length) == 4 and (np.asarray(shown.length) == 12).all()
    for states in np.asarray(shown.state):
        assert 2 not in states and {3, 5} <= set(states.tolist())


def files_that_handle(action, held, error):
    """Modules of the package with functions that take or return a value, until an error."""
    files = set()

    def note(frame, event, arg):
        if event == "call":
            names = frame.f_code.co_varnames[: frame.f_code.co_argcount]
            values = [frame.f_locals.get(name) for name in names]
        else:
            values = [arg] if event == "return" else []
        if any(map(held, values)):
            files.add(frame.f_code.co_filename)

    sys.setprofile(note)
    try:
        with pytest.raises(error):
            action()
    finally:
        sys.setprofile(None)
    return {Path(x).stem for x in files if Path(x).is_relative_to(Path(jaxltl.__file__).parent)}


def test_at_most_eight_files_pass_the_formula_on(write, tmp_path, monkeypatch):
    """The text of the formula, or a task with it, from the file to the translation."""
    path = write()
    formula = MlirlFile.read(path).formula
    console = run_job.Console(None, lambda line: None, ProcessGroup())

    class Translated(Exception):
        pass

    def translate(*args, **options):
        raise Translated

    monkeypatch.setattr(sys.modules[product.__module__], "to_automaton", translate)
    package = files_that_handle(
        lambda: run_job.learn(path, run_job.RunOptions(tmp_path / "out", 0, 1), console),
        lambda x: isinstance(x, File) or (isinstance(x, str) and x == formula),
        Translated,
    )
    read = {"schema", "task", "task_irl"}
    assert package | {"translate"} == read | {"run_job", "learn", "product", "ltl", "translate"}
