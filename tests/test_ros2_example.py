"""The ROS 2 example: its logic, and its node with a stand-in for ROS."""

import importlib.util
import sys
import types
from pathlib import Path

import pytest

import jaxltl as jl

spec = importlib.util.spec_from_file_location(
    "ros2_policy", Path(__file__).parents[1] / "examples" / "ros2_policy.py"
)
example = importlib.util.module_from_spec(spec)
spec.loader.exec_module(example)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A robot that visits a, in the first row, and then b, in the second: a . / . b"""
    model = jl.product(jl.gridworld("a .\n. b", initial="b"), "F (a & F b)")
    names = ["up", "down", "left", "right"]
    policy = jl.project_policy(model, jl.optimal_satisfaction(model).policy, actions=names)
    path = tmp_path_factory.mktemp("ros") / "policy.npz"
    jl.io.save_policy(path, policy)
    return path


MOVES = {"up": (0, 1), "down": (0, -1), "left": (-1, 0), "right": (1, 0)}


def test_the_driver_visits_both_places(saved):
    driver, (x, y), seen = example.Driver(saved, 2, 0.5), (0.75, -0.75), []
    for _ in range(5):
        seen.append(driver.cell(x, y))
        dx, dy = MOVES[driver.arrived(x, y)]
        x, y = min(max(x + dx / 2, 0.25), 0.75), min(max(y + dy / 2, -0.75), -0.25)
    assert seen[0] == 3 and seen[2] == 0 and seen[4] == 3
    for wrong in ((-0.1, -0.1), (1.1, -0.1), (0.1, 0.1)):
        with pytest.raises(ValueError, match="not on the map"):
            driver.cell(*wrong)


def test_the_node_answers_each_arrival(saved, monkeypatch):
    sent, subscribed = [], {}
    node = types.SimpleNamespace(
        create_publisher=lambda kind, topic, depth: types.SimpleNamespace(
            publish=lambda message: sent.append((topic, message.data))
        ),
        create_subscription=lambda kind, topic, call, depth: subscribed.update({topic: call}),
    )

    def spin(given):
        position = types.SimpleNamespace(x=0.75, y=-0.75)
        pose = types.SimpleNamespace(pose=types.SimpleNamespace(position=position))
        subscribed["arrived"](pose)

    ros = types.SimpleNamespace(init=lambda: None, create_node=lambda name: node, spin=spin)
    messages = types.SimpleNamespace(String=types.SimpleNamespace, PoseStamped=object)
    for name, module in (
        ("rclpy", ros),
        ("geometry_msgs", messages),
        ("geometry_msgs.msg", messages),
        ("std_msgs", messages),
        ("std_msgs.msg", messages),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    example.main([str(saved), "2", "0.5"])
    assert len(sent) == 1 and sent[0][0] == "action" and sent[0][1] in ("up", "left")
