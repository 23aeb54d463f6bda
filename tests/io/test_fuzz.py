"""Damaged files: an error of ours, or a model, soon."""

import pytest

from tests.io.fuzz import READERS, try_damaged


@pytest.mark.few(4)
@pytest.mark.parametrize("name", READERS)
def test_damaged_files(name, tmp_path):
    assert try_damaged(name, 150, 0, tmp_path) < 150
