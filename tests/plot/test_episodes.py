"""Pictures and pages of episodes: what they show is what happened."""

import json
import re
from html.parser import HTMLParser

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.environment import Timestep as Step
from jaxltl.core.environments.environment import make_environment
from jaxltl.core.environments.episodes import Agent, make_agent, run_episode
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.envs.flat_world import flat_world
from jaxltl.envs.letter_world import letter_world
from jaxltl.envs.zone_world import zone_world
from jaxltl.plot.episodes import (
    _segments,
    draw_episode,
    draw_episodes,
    play_episode,
    scene_of,
)
from jaxltl.plot.style import to_bytes

KEY = jax.random.key(0)


def episode(world, action, num_steps=6):
    return run_episode(KEY, world, make_agent(lambda seen, key: action), num_steps=num_steps)


def letters():
    return letter_world(layout="a . b\n. . .\n. c .", letters=3, initial=1, horizon=4)


class Tags(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))


def frames(page):
    return json.loads(re.search(r'id="frames">(.*?)</script>', page).group(1))


def test_letters_across_a_side():
    world = letters()
    run = episode(world, jnp.int32(0))  # up: from the first row to the last one
    scene = scene_of(world, run)
    assert scene.track.tolist() == [[1.5, 0.5], [1.5, 2.5], [1.5, 1.5], [1.5, 0.5], [1.5, 2.5]]
    assert scene.labels == ["", "c", "", "", "c"] and scene.joined
    assert sorted(scene.letters) == [(0, 0, "a"), (1, 2, "c"), (2, 0, "b")]
    lines = _segments(scene._replace(cells=0))
    assert [x.round(9).tolist() for x in lines] == [
        [[1.5, 0.5], [1.5, -0.05]],
        [[1.5, 3.05], [1.5, 2.5]],
        [[1.5, 2.5], [1.5, 1.5], [1.5, 0.5], [1.5, -0.05]],
        [[1.5, 3.05], [1.5, 2.5]],
    ]
    assert draw_episode(world, run).axes[0].get_title(loc="left") == "c → c"
    page = play_episode(world, run, title="<up>")
    assert "<h1>&lt;up&gt;</h1>" in page and frames(page)["labels"] == scene.labels
    steps = [a["data-step"] for tag, a in Tags(page).found if tag == "polyline"]
    assert steps == ["1", "1", "2", "3", "4", "4"]


def test_a_task_is_looked_through_and_what_comes_after_the_end_is_not_shown():
    world = task_environment(letters(), "F c")
    run = run_episode(
        KEY, world, Agent(lambda memory, seen, allowed, key: (jnp.int32(1), memory)), num_steps=6
    )
    scene = scene_of(world, run)
    assert scene.track.tolist() == [[1.5, 0.5], [1.5, 1.5], [1.5, 2.5]]
    assert "ends after 2 steps" in to_bytes(draw_episode(world, run)).decode()


@pytest.mark.slow
def test_discs_and_zones_stand_upright():
    flat = flat_world(initial=(1.0, 1.5), horizon=8)
    scene = scene_of(flat, episode(flat, jnp.array([0.0, 1.0]), 8))
    assert len(scene.track) == 8  # it leaves the square by the seventh step
    np.testing.assert_allclose(scene.track[:2], [[3.0, 0.5], [3.0, 0.42]], atol=1e-5)
    assert len(scene.discs) == 9
    np.testing.assert_allclose(scene.discs[0][:3], (0.6, 1.45, 0.4), atol=1e-5)
    assert scene.discs[0][3] == "red" and scene.size == 4
    zones = zone_world(num_maps=4, horizon=5)
    run = episode(zones, jnp.array([1.0, 0.1]))
    page, scene = play_episode(zones, run), scene_of(zones, run)
    assert sorted(x[3] for x in scene.discs) == sorted(2 * zones.propositions)
    turn = np.array(frames(page)["turn"])
    np.testing.assert_allclose(turn, -np.degrees(np.asarray(run.world[0].heading)[:6]), atol=0.06)
    circles = [a for tag, a in Tags(page).found if tag == "circle"]
    assert len(circles) == 9
    assert np.allclose([float(c["r"]) for c in circles[:8]], 0.4 * 440 / 5)
    assert to_bytes(draw_episode(zones, run), "png")[:4] == b"\x89PNG"


def test_a_world_with_a_place_is_a_line_with_marks_where_something_begins_to_hold():
    def walk(world, action, key):
        place = world["place"] + jnp.array([1.0, 0.5])
        return Step({"place": place}, 0.0, False)

    far = make_environment(
        lambda key: {"place": jnp.zeros(2)},
        walk,
        lambda world: world["place"],
        actions=1,
        labels=lambda world: world["place"][:1] > 1.5,
        propositions=["far"],
    )
    scene = scene_of(far, episode(far, jnp.int32(0), 4))
    assert scene.size == pytest.approx(4 * 1.16)
    middle = scene.size / 2
    np.testing.assert_allclose(
        scene.track - middle, [[-2, 1], [-1, 0.5], [0, 0], [1, -0.5], [2, -1]], atol=1e-6
    )
    ((x, y, _, name),) = scene.discs
    assert (x, y) == pytest.approx((middle, middle)) and name == "far"
    both = draw_episodes(far, [episode(far, jnp.int32(0), 4)] * 2, titles=["one", "two"])
    assert [axes.get_title("left") or axes.get_title() for axes in both.axes] == ["one", "two"]
    with pytest.raises(ValueError, match="there is no episode"):
        draw_episodes(far, [])


def test_what_has_no_picture_is_named():
    other = make_environment(
        lambda key: jnp.int32(0), lambda x, a, key: Step(x, 0.0, False), lambda x: x / 2, actions=1
    )
    with pytest.raises(ValueError, match="has no picture; give an episode of a letter_world"):
        draw_episode(other, episode(other, jnp.int32(0)))
    world = letters()
    many = jax.vmap(
        lambda key: run_episode(key, world, make_agent(lambda seen, key: jnp.int32(0)), num_steps=2)
    )(jax.random.split(KEY, 2))
    with pytest.raises(ValueError, match="take one trajectory of many"):
        play_episode(world, many)
