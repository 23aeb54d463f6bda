"""Section 3.5 in little: what ``reproduce todirl`` returns, prints and draws."""

import json

import numpy as np
import pytest

from jaxltl.reproduce import todirl


def check(methods):
    plan = todirl.TodirlExperimentPlan(
        methods=methods,
        demonstrations=(6,),
        curves=6,
        steps=20,
        cloning_steps=20,
        points=2,
        test_worlds=2,
    )
    result = todirl.measure(seeds=2, plan=plan)
    found = json.loads(json.dumps(result, allow_nan=False))
    assert [(x["demonstrations"], x["method"]) for x in found["by_demonstrations"]] == [
        (6, method) for method in methods
    ]
    for x in found["by_demonstrations"]:
        assert x["seeds"] == 2 == len(x["test_of_each_seed"])
        assert 0 <= x["test_worst"] <= x["test_mean"] <= 1 and 0 <= x["train_mean"] <= 1
        np.testing.assert_allclose(np.mean(x["test_of_each_seed"]), x["test_mean"], atol=1e-4)
        np.testing.assert_allclose(np.min(x["test_worst_of_each_seed"]), x["test_worst"], atol=1e-4)
        assert 0 <= x["half_width"] < 1e-3
    expert, chance = found["reference"]
    assert expert["test_worst"] > 0.999 and chance["test_mean"] < 0.1
    assert found["total_seconds"] > 0
    assert [x["method"] for x in found["figure6"]] == list(methods)
    text = todirl.table(result)
    assert all(method in text for method in methods)
    assert list(todirl.pictures(result)) == [
        "figure_7_demonstrations",
        "figure_6_learning",
        "training_world",
        "test_world",
        "another_test_world",
    ]
    return {x["method"]: x for x in found["by_demonstrations"]}


@pytest.mark.exhaustive
def test_section_3_5_in_little():
    rows = check(("todirl",))
    assert rows["todirl"]["test_mean"] > 0.3  # by chance .003


@pytest.mark.exhaustive
def test_all_methods_of_section_3_5():
    rows = check(todirl.METHODS)
    ahead = rows["todirl"]["test_mean"]
    assert all(ahead > 10 * rows[name]["test_mean"] for name in ("memoryless", "cloning"))
