"""Logs of transitions, against a slow reader, and what is refused by line."""

import collections
import gzip
import lzma
import os
import threading
import tracemalloc

import numpy as np
import pytest

from jaxltl.core.models.construct.counts import align_counts
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.sparse import make_sparse
from jaxltl.io import files
from jaxltl.io.log import read_labels, read_log

NAMES = ("hall", "kitchen, lower", " hall", "hall ", "bath", 'the "den"', "Büro", "0", "1", "x y")


def split(line):
    """The fields of a line, letter by letter: blanks count inside quotes only."""
    fields, letters, quoted, inside, i = [], "", False, False, 0
    while i <= len(line):
        letter = line[i] if i < len(line) else ","
        if inside:
            if line[i : i + 2] == '""':
                letters, i = letters + '"', i + 1
            elif letter == '"':
                inside = False
            else:
                letters += letter
        elif letter == ",":
            fields.append(letters if quoted else letters.strip())
            letters, quoted = "", False
        elif letter == '"' and not letters.strip():
            letters, quoted, inside = "", True, True
        else:
            letters += letter
        i += 1
    return fields


def slowly(text, count="count"):
    """How often each transition stands in a text, by name."""
    found = collections.Counter()
    header, *lines = map(split, text.split("\r\n" if "\r" in text else "\n"))
    for row in (dict(zip(header, x, strict=True)) for x in lines if x != [""]):
        found[row["state"], row["action"], row["next"]] += int(row.get(count, 1))
    return dict(found)


def by_name(counts):
    columns = counts.state, counts.action, counts.successor, counts.count
    return {
        (counts.states[s], counts.actions[a], counts.states[t]): n
        for s, a, t, n in zip(*(x.tolist() for x in columns), strict=True)
    }


def random_log(rng, num_lines):
    """A text with columns in any order, quotes, blanks, and at times counts and a time."""
    columns = ["state", "action", "next"]
    columns += [x for x in ("time", "count", "reward") if rng.random() < 0.5]
    rng.shuffle(columns)
    style = rng.integers(4)
    names = NAMES if style else NAMES[-3:-1]

    def written(name):
        if style == 1 or "," in name or '"' in name or name != name.strip():
            return '"' + name.replace('"', '""') + '"'
        return f" {name} " if style == 2 else name

    lines = [",".join(columns)]
    for i in range(num_lines):
        values = {
            "time": str(i),
            "count": str(rng.integers(5)),
            "reward": "",
            "action": ("left", "right")[rng.integers(2)],
        }
        values |= {x: names[rng.integers(len(names))] for x in ("state", "next")}
        lines.append(",".join(written(values[x]) for x in columns))
    end = ("\n", "\r\n")[rng.integers(2)]
    return end.join(lines) + end * int(rng.integers(3))


@pytest.mark.parametrize("step", [7, 100, 2**13])
def test_logs_as_a_slow_reader_has_them(tmp_path, monkeypatch, step):
    monkeypatch.setattr(files, "_STEP", step)
    rng, path = np.random.default_rng(step), tmp_path / "log.csv"
    for i in range(60):
        text = random_log(rng, int(rng.integers(1, 40)))
        data = text.encode()
        if i % 3 == 0:
            data = b"\xef\xbb\xbf" + data
        path.write_bytes((gzip.compress, lzma.compress, bytes, bytes)[i % 4](data))
        found = read_log(path)
        assert by_name(found) == slowly(text)
        key = np.stack([found.state, found.action, found.successor])
        assert (np.lexsort(key[::-1]) == np.arange(key.shape[1])).all()
        assert list(found.states) == sorted(found.states)


def test_numbers_are_in_their_order(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("next,state,action\n10,9,2\n-1,10,2\n")
    found = read_log(path)
    assert found.states == ("-1", "9", "10") and found.actions == ("2",)
    path.write_text("next,state,action\n10,09,2\n9,10,2\n")
    assert read_log(path).states == ("09", "10", "9"), "texts, of which two are different"


def test_other_names_of_columns(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("s,a,s2,n\nx,go,y,3\ny,go,y,0\n")
    found = read_log(path, columns=("s", "a", "s2"), count="n", states=["y", "x", "z"])
    assert found.states == ("y", "x", "z") and found.actions == ("go",)
    assert by_name(found) == {("x", "go", "y"): 3, ("y", "go", "y"): 0}
    assert found.num_samples == 3


HEAD = b"state,action,next\n"
GOOD = b"a,b,c\n" * 3000


@pytest.mark.parametrize(
    ("data", "line", "message"),
    [
        (b"", 1, "the file is empty"),
        (b"\n", 1, "the header has no column 'state'"),
        (b"\n" + HEAD + GOOD, 1, "the header has no column 'state'"),
        (HEAD, 2, "no transition after the header"),
        (HEAD + b"\n\n", 2, "no transition"),
        (b"a,b,c\n", 1, "it must name state, action, next, separated by commas, and has 'a', 'b'"),
        (b"state;action;next\na;b;c\n", 1, "has 'state;action;next'"),
        (b"state,action,state\na,b,c\n", 1, "has the column 'state' twice"),
        (b"state,action,next,x,x\na,b,c,,\n", 1, "has the column 'x' twice"),
        (HEAD + GOOD + b"a,b\n", 3002, "has 2 fields, and the header 3"),
        (HEAD + GOOD + b"a,b,c,d\n" + GOOD, 3002, "has 4 fields"),
        (HEAD + GOOD + b"a,,c\n" + GOOD, 3002, "the field of column 'action' is empty"),
        (HEAD + GOOD + b"a,b, \n", 3002, "the field of column 'next' is empty"),
        (HEAD + GOOD + b"\n" + GOOD, 3002, "is empty; remove it"),
        (HEAD + GOOD + b" \n\n" + GOOD, 3002, "is empty; remove it"),
        (HEAD + GOOD + HEAD + GOOD, 3002, "this line repeats the header"),
        (HEAD + GOOD + b"a,\xff,c\n", 3002, "byte 0xff is not UTF-8 text"),
        (HEAD + b"a,b,c\n" + b"a,b\x00,c\n", 3, "byte 0x0 is not text"),
        (HEAD + b"a,b,c\r" * 4, 2, "byte 0xd is not text"),
        (HEAD.decode().encode("utf-16"), 1, "byte 0x0 is not text"),
        (HEAD + b'a,b,"c\nd"\n' + GOOD, 2, "a quote is not closed on its line"),
        (HEAD + GOOD + b'a,b,"c', 3002, "unexpected end of data"),
        (HEAD + b'a,"b"x,c\n', 2, "expected after"),
        (HEAD + GOOD + b"a" * 10**5, 3002, "is longer than 65536 bytes"),
        (HEAD + b"a,b," + b"c" * 10**6 + b"\n", 2, "is longer than 65536 bytes"),
        (b"state,action,next,count\na,b,c,1\na,b,c,-2\n", 3, "the count is '-2'"),
        (b"state,action,next,count\na,b,c,1\na,b,c,1.0\n", 3, "the count is '1.0'"),
        (b"state,action,next,count\na,b,c,\n", 2, "the field of column 'count' is empty"),
        (b"state,action,next,count\na,b,c,9007199254740993\n", 2, "expected an integer from 0"),
        (b"state,action,next,count\na,b,c,9007199254740992\na,b,c,1\n", 3, "add up to more than 2"),
        (bytes(range(1, 256)) * 50, 1, "is not text"),
    ],
)
def test_what_is_refused(tmp_path, data, line, message):
    path = tmp_path / "a log.csv"
    path.write_bytes(data)
    with pytest.raises(ValueError) as caught:
        read_log(path)
    text = str(caught.value)
    assert text.startswith(f"{str(path)!r}, line {line}: ") and message in text, text
    path.write_bytes(gzip.compress(data))
    with pytest.raises(ValueError, match=f"line {line}: "):
        read_log(path)


@pytest.mark.parametrize("step", range(1, 12))
def test_empty_lines_wherever_the_parts_end(tmp_path, monkeypatch, step):
    monkeypatch.setattr(files, "_STEP", step)
    path = tmp_path / "log.csv"
    path.write_bytes(HEAD + b"a,b,c\n" + b"\n" * 5)
    assert read_log(path).num_samples == 1
    path.write_bytes(HEAD + b"a,b,c\n" + b"\n" * 5 + b"a,b,c\n")
    with pytest.raises(ValueError, match="line 3: is empty; remove it"):
        read_log(path)


def test_names_that_do_not_tell(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(HEAD + b"a,b,c\n")
    for columns in (("state", "action"), ("state", "state", "next"), "abc"):
        with pytest.raises(ValueError, match="give 3 names, all different"):
            read_log(path, columns=columns)
    with pytest.raises(ValueError, match="give 2 names"):
        read_labels(path, columns=("state", "action", "next"))
    with pytest.raises(ValueError, match="the name 'a' stands twice"):
        read_log(path, states=["a", "a", "c"])


def test_files_that_cannot_be_read(tmp_path):
    path = tmp_path / "log.csv"
    for bad in (path, tmp_path, f"{path}\0"):
        with pytest.raises(ValueError, match="cannot read"):
            read_log(bad)
    path.write_bytes(gzip.compress(HEAD + GOOD)[:-9])
    with pytest.raises(ValueError, match="has the header of gzip and is damaged"):
        read_log(path)


def test_from_a_pipe(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    writer = threading.Thread(target=path.write_bytes, args=(HEAD + GOOD,))
    writer.start()
    assert by_name(read_log(path)) == {("a", "b", "c"): 3000}
    writer.join()


def test_logs_that_fit_a_model(tmp_path):
    path = tmp_path / "log.csv"
    room = make_sparse(
        [0, 2, 3, 4],
        [0, 2, 3, 4, 5],
        [0, 1, 2, 1, 2],
        [0.5, 0.5, 1, 1, 1],
        action=[0, 1, 0, 1],
        action_names=["left", "right"],
        valuation={"state": np.array(["hall", "bath", "den"], object)},
    )
    path.write_text("state,action,next\nhall,left,bath\nhall,right,den\nhall,left,bath\n")
    found = read_log(path, room)
    assert found.states == ("hall", "bath", "den") and found.actions == ("left", "right")
    assert align_counts(room, found).tolist() == [0, 2, 1, 0, 0]
    for line, message in (
        ("hall,left,attic", "there is no state 'attic'; there are 3: 'hall', 'bath', 'den'"),
        ("attic,left,hall", "there is no state 'attic'"),
        ("hall,up,bath", "there is no action 'up'; there are 2: 'left', 'right'"),
        ("bath,right,bath", "does not have it: state 'bath' has no action 'right'"),
        ("hall,right,bath", "does not have it: action 'right' in state 'hall' cannot lead to"),
    ):
        path.write_text(f"state,action,next\nhall,left,bath\n{line}\n{line}\n")
        with pytest.raises(ValueError, match=f"line 3: .*{message}"):
            read_log(path, room)
    with pytest.raises(ValueError, match="model and names are both given"):
        read_log(path, room, states=["hall"])
    # Without names, numbers are names.
    mdp = make_mdp([[[0, 1], [1, 0]], [[1, 0], [0, 0]]], [[[0.5, 0.5], [1, 0]], [[1, 0], [0, 0]]])
    path.write_text("state,action,next,count\n0,0,1,5\n1,0,1,2\n0,1,1,3\n")
    assert align_counts(mdp, read_log(path, mdp)).tolist() == [[[0, 5], [3, 0]], [[2, 0], [0, 0]]]
    path.write_text("state,action,next\n1,1,0\n")
    with pytest.raises(ValueError, match="line 2: the model does not have it: state '1' has no"):
        read_log(path, mdp)


def test_labels(tmp_path):
    path = tmp_path / "labels.csv"
    path.write_text("note,label,state\n,goal,den\n,wet,bath\nx,goal,hall\n,goal,den\n")
    assert read_labels(path) == {"goal": ("den", "hall"), "wet": ("bath",)}
    with pytest.raises(ValueError, match="line 4: there is no state 'hall'; there are 2"):
        read_labels(path, ["den", "bath"])
    path.write_text("label,state\n")
    with pytest.raises(ValueError, match="line 2: there is no label"):
        read_labels(path)
    path.write_text("state\nden\n")
    with pytest.raises(ValueError, match="line 1: the header has no column 'label'"):
        read_labels(path)


@pytest.mark.exhaustive
def test_a_million_lines_in_little_memory(tmp_path):
    path, rng = tmp_path / "log.csv", np.random.default_rng(0)
    state = rng.integers(300, size=10**6).tolist()
    with open(path, "w") as file:
        file.write("time,state,action,next\n")
        file.writelines(f"{i},cell {s},go,cell {s + i % 3}\n" for i, s in enumerate(state))
    tracemalloc.start()
    found = read_log(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.num_samples == 10**6 and peak < 2**24 < path.stat().st_size
