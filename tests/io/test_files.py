"""Files as bytes: compression by content, and bounds that hold."""

import gzip
import lzma

import numpy as np
import pytest

from jaxltl.io import files as _files
from jaxltl.io.files import read_bytes, write_bytes

TEXT = b"some text\n" * 1000


@pytest.mark.parametrize("name", ["a", "a.gz", "a.xz"])
def test_what_is_written_is_read(tmp_path, name):
    for data in (b"", TEXT, np.random.default_rng(0).bytes(2**20 + 9)):
        with write_bytes(tmp_path / name) as file:
            file.write(data)
        first = (tmp_path / name).read_bytes()
        assert read_bytes(tmp_path / name) == data
        assert (first != data) == (name != "a")
        with write_bytes(tmp_path / name) as file:
            file.write(data)
        assert (tmp_path / name).read_bytes() == first
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress])
def test_streams_may_follow_one_another_and_names_do_not_matter(tmp_path, pack):
    path = tmp_path / "model.txt"
    path.write_bytes(pack(TEXT) + pack(b"more") + b"\0" * 8)
    assert read_bytes(path) == TEXT + b"more"


@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress])
def test_damage_is_named(tmp_path, pack):
    path, packed = tmp_path / "model", pack(TEXT)
    for bad in (
        packed[:-1],
        packed[:20],
        packed[: len(packed) // 2],
        packed[:30] + b"?" + packed[31:],
    ):
        path.write_bytes(bad)
        with pytest.raises(
            ValueError, match=r"model': it has the header of (gzip|xz) and is damaged"
        ):
            read_bytes(path)
    path.write_bytes(packed + b"and more")
    with pytest.raises(ValueError, match="8 bytes follow the"):
        read_bytes(path)


@pytest.mark.few(1)
@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress])
def test_a_bomb_is_refused_before_it_grows(tmp_path, pack, monkeypatch):
    monkeypatch.setattr(_files, "ALWAYS_ALLOWED", 2**20)
    path = tmp_path / "model"
    path.write_bytes(pack(bytes(2**26)))
    with pytest.raises(ValueError, match=r"holds more than \d+ bytes; decompress it first"):
        read_bytes(path)
    path.write_bytes(pack(TEXT))
    assert read_bytes(path) == TEXT
    with pytest.raises(ValueError, match="holds more than 500 bytes"):
        read_bytes(path, limit=500)


def test_what_cannot_be_read_or_written_is_named(tmp_path):
    for path in (tmp_path / "none", tmp_path, "a\0b"):
        with pytest.raises(ValueError, match="cannot read"):
            read_bytes(path)
    (tmp_path / "long").write_bytes(TEXT)
    with pytest.raises(ValueError, match=r"long': it has more than 9999 bytes"):
        read_bytes(tmp_path / "long", limit=9999)
    with pytest.raises(ValueError, match="cannot write"), write_bytes(tmp_path / "no" / "x"):
        pass
