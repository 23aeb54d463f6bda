"""All environments that a package registers, by its adapter and by its own functions.

``python -m tests.envs.adapters.sweep [package ...] [name ...]`` prints a line for each.
"""

import sys
import time
import traceback
import warnings

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl as jl
from jaxltl.core.environments.episodes import auto_reset_step
from tests.envs.adapters.harness import keys_of, own_walk, walk
from tests.support import random_action

LIMIT, STEPS, WALKS = 20, 50, 3  # an episode's steps, a walk's, and how many walks are one vmap


def of_gymnax():
    """`MNISTBandit` with noise for pictures, which it would load from the network."""
    import gymnax
    from gymnax.environments.bsuite import mnist

    noise = np.random.default_rng(0).random((50, 28, 28), np.float32), np.arange(50) % 10
    mnist.load_mnist.load_mnist = lambda: (noise, noise)
    for name in gymnax.registered_envs:

        def make(name=name):
            own, params = gymnax.make(name)
            if hasattr(params, "max_steps_in_episode"):
                params = params.replace(max_steps_in_episode=LIMIT)

            def step(state, action, key):
                seen, after, reward, terminated, _ = own.step_env(key, state, action, params)
                return after, seen, reward, terminated | own.is_truncated(after, params)

            return (
                jl.envs.from_gymnax(own, params),
                lambda key: own.reset_env(key, params)[::-1],
                step,
            )

        yield name, make


def of_navix():
    import navix

    for name in navix.registry():

        def make(name=name):
            own = navix.make(name, max_steps=LIMIT)

            def reset(key):
                start = own.reset(key)
                return start, start.observation

            def step(state, action, key):
                after = own.step(state, action)
                return after, after.observation, after.reward, after.is_done()

            return jl.envs.from_navix(own), reset, step

        yield name, make


def of_xminigrid():
    import xminigrid

    for name in xminigrid.registered_environments():

        def make(name=name):
            own, params = xminigrid.make(name, max_steps=LIMIT)

            def reset(key):
                start = own.reset(params, key)
                return start, start.observation

            def step(state, action, key):
                after = own.step(params, state, action)
                return after, after.observation, after.reward, after.last()

            return jl.envs.from_xminigrid(own, params), reset, step

        yield name, make


def of_jumanji():
    import jumanji
    from jumanji.environments.packing.job_shop import generator as shop
    from jumanji.environments.routing.connector import generator as pairs
    from jumanji.environments.routing.sokoban import generator as boxes
    from jumanji.wrappers import MultiToSingleWrapper

    special = {  # fewer agents, and no files from the network
        "Connector-v3": lambda: jumanji.environments.Connector(
            pairs.UniformRandomGenerator(grid_size=5, num_agents=3)
        ),
        "JobShop-v0": lambda: jumanji.environments.JobShop(
            shop.RandomGenerator(num_jobs=4, num_machines=3, max_num_ops=3, max_op_duration=3)
        ),
        "Sokoban-v0": lambda: jumanji.environments.Sokoban(boxes.ToyGenerator()),
    }
    for name in sorted(jumanji.registered_environments()):

        def make(name=name):
            own = special[name]() if name in special else jumanji.make(name)
            if own.reward_spec.shape:
                own = MultiToSingleWrapper(own)
            inner = own
            while "_env" in vars(inner):
                inner = inner._env
            if "time_limit" in vars(inner):
                inner.time_limit = LIMIT
            env = jl.envs.from_jumanji(own)

            def reset(key):
                state, start = own.reset(key)
                return state, start.observation

            def step(state, action, key):
                if isinstance(env.actions, jl.environments.Finite) and own.action_spec.shape:
                    spec = own.action_spec
                    if hasattr(spec, "num_values"):
                        parts = np.ravel(spec.num_values).tolist()
                    else:  # its specification counts one value too many
                        parts = own.reset(jax.random.key(0))[1].observation.action_mask.shape
                        parts = [parts[1]] * parts[0]
                    action = jnp.stack(jnp.unravel_index(action, parts)).reshape(spec.shape)
                after, found = own.step(state, action.astype(own.action_spec.dtype))
                return after, found.observation, found.reward, found.last()

            return env, reset, step

        yield name, make


def of_brax():
    import brax.envs

    for name in brax.envs._envs:

        def make(name=name):
            own = brax.envs.training.EpisodeWrapper(brax.envs.get_environment(name), LIMIT, 1)

            def reset(key):
                start = own.reset(key)
                return start.replace(info={**start.info}), start.obs

            def step(state, action, key):
                after = own.step(state.replace(info={**state.info}), action)
                return after, after.obs, after.reward, after.done > 0

            return jl.envs.from_brax(own), reset, step

        yield name, make


def of_craftax():
    from craftax.craftax_env import make_craftax_env_from_name

    for name in (
        "Craftax-Classic-Symbolic-v1",
        "Craftax-Classic-Pixels-v1",
        "Craftax-Symbolic-v1",
        "Craftax-Pixels-v1",
    ):

        def make(name=name):
            own = make_craftax_env_from_name(name, auto_reset=False)
            params = own.default_params.replace(max_timesteps=LIMIT)

            def step(state, action, key):
                seen, after, reward, done, _ = own.step_env(key, state, action, params)
                return after, seen, reward, done

            return (
                jl.envs.from_craftax(own, params),
                lambda key: own.reset_env(key, params)[::-1],
                step,
            )

        yield name, make


def of_pgx():
    """Of several players each is asked for a legal move in turn, by the same policy."""
    import pgx

    def anyone(state, key):
        return jax.random.categorical(key, jnp.log(state.legal_action_mask)).astype(jnp.int32)

    for name in pgx.available_envs():

        def make(name=name):
            own = pgx.make(name)
            others = None if own.num_players == 1 else anyone

            def await_turn(state, earned, key):
                def move(carry):
                    state, earned, key = carry
                    key, choose, go = jax.random.split(key, 3)
                    state = own.step(state, anyone(state, choose), go)
                    return state, earned + state.rewards[0], key

                if others is None:
                    return state, earned
                return jax.lax.while_loop(
                    lambda x: ~(x[0].terminated | x[0].truncated) & (x[0].current_player != 0),
                    move,
                    (state, earned, key),
                )[:2]

            def reset(key):
                start, wait = jax.random.split(key)
                state, earned = await_turn(own.init(start), jnp.float32(0), wait)
                return (state, earned), own.observe(state, 0)

            def step(pair, action, key):
                state, owed = pair
                go, wait = jax.random.split(key)
                state = own.step(state, action, go)
                state, earned = await_turn(state, owed + state.rewards[0], wait)
                return (
                    (state, jnp.float32(0)),
                    own.observe(state, 0),
                    earned,
                    state.terminated | state.truncated,
                )

            return jl.envs.from_pgx(own, others), reset, step

        yield name, make


PACKAGES = {
    "gymnax": of_gymnax,
    "navix": of_navix,
    "xminigrid": of_xminigrid,
    "jumanji": of_jumanji,
    "brax": of_brax,
    "craftax": of_craftax,
    "pgx": of_pgx,
}


def of_contacts(env, reset, step, steps=STEPS, walks=WALKS):
    """As :func:`differences`, step by step from the adapter's own worlds, which are the package's.

    Where bodies touch, what two programs round differently is soon another walk.
    """
    keys = jax.random.split(jax.random.key(7), walks)

    def go(world, key):
        choose, at = jax.random.split(key)
        action = random_action(choose, env.actions)
        after, found = auto_reset_step(at, env, world, action)
        return after, (world, action, found._replace(world=env.observe(found.world)))

    def walked(key):
        first, rest = keys_of(key, steps)
        return jax.lax.scan(go, env.reset(first), rest)[1]

    world, action, found = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:]), jax.jit(jax.vmap(walked))(keys)
    )
    told = jax.jit(jax.vmap(lambda *pair: step(*pair, None)[1:]))(world, action)
    pairs = {
        "last observations": (found.world, told[0]),
        "rewards": (found.reward, told[1]),
        "ends": (found.terminated | found.truncated, told[2]),
    }
    pairs["first observations"] = (
        jax.tree.map(lambda x: x[::steps], env.observe(world)),
        jax.jit(jax.vmap(lambda key: reset(keys_of(key, steps)[0])[1]))(keys),
    )
    wrong = [
        f"{name}: {text}"
        for name, pair in pairs.items()
        if (text := unlike(*pair, 1e-3, scaled=True))
    ]
    for row in np.asarray(found.terminated | found.truncated).reshape(walks, -1):
        if (lengths(row) > env.horizon).any():
            wrong.append(f"an episode goes on after {env.horizon} steps")
    return (
        "; ".join(wrong),
        int((found.terminated | found.truncated).sum()),
        int((found.truncated & ~found.terminated).sum()),
    )


def differences(env, reset, step, steps=STEPS, walks=WALKS):
    """Where the walks of an adapter are not the package's own: a text, empty if they are.

    Those of the adapter are one program, jitted and vmapped; the package's one after the other.

    Returns:
      The text, how many episodes ended, and how many of them at their limit alone.
    """
    keys = jax.random.split(jax.random.key(7), walks)
    found = jax.jit(jax.vmap(lambda key: walk(env, key, steps)))(keys)

    def theirs(state, action, key):
        return (*step(state, action, key), False)

    own = jax.jit(lambda key, actions: own_walk(reset, theirs, key, actions))
    wrong, least = [], env.horizon or steps + 1
    for row, key in enumerate(keys):
        seen, action, reward, terminated, truncated, last = jax.tree.map(
            lambda x, row=row: np.asarray(x[row]), found
        )
        told = own(key, action)
        pairs = {
            "observations": (seen, told[0]),
            "rewards": (reward, told[2]),
            "ends": (terminated | truncated, told[3]),
            "last observations": (last, told[5]),
        }
        wrong += [
            f"{name} of walk {row}: {text}"
            for name, pair in pairs.items()
            if (text := unlike(*pair))
        ]
        ages = lengths(terminated | truncated)
        if (ages[truncated] != least).any() and env.horizon:
            wrong.append(f"walk {row} is cut off after {ages[truncated]} steps")
        if not terminated[(ages < least) & (terminated | truncated)].all():
            wrong.append(f"walk {row} ends without being over")
        if (ages > least).any():
            wrong.append(f"walk {row} goes on after {least} steps")
    return "; ".join(wrong), int((found[3] | found[4]).sum()), int((found[4] & ~found[3]).sum())


def lengths(ended):
    """How many steps each episode has after each step."""
    age, ages = 0, []
    for over in ended:
        age += 1
        ages.append(age)
        age = 0 if over else age
    return np.array(ages)


def unlike(mine, theirs, most=1e-4, scaled=False):
    """Where two trees differ; of vectors of forces and places, as parts of the largest number."""
    if jax.tree.structure(mine) != jax.tree.structure(theirs):
        return "another structure"
    for x, y in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        if x.shape != y.shape:
            return f"{x.shape} for {y.shape}"
        size = np.abs(y).max(-1, keepdims=True, initial=0.1) if scaled and y.ndim > 1 else 0.1
        close = (
            np.isclose(x, y, rtol=most, atol=most * size, equal_nan=True)
            if (y.dtype.kind == "f")
            else x == y
        )
        if not close.all():
            return f"{(~close).sum()} of {close.size} numbers, first at {np.argwhere(~close)[0]}"
    return ""


def sweep(package, names=(), steps=STEPS, walks=WALKS):
    """Each environment's name, and "" or what is wrong, with a few words beside."""
    warnings.simplefilter("ignore")
    for name, make in PACKAGES[package]():
        if names and name not in names:
            continue
        begin = time.process_time()
        try:
            env, *own = make()
            look = of_contacts if package == "brax" else differences
            wrong, ended, cut = look(env, *own, steps=steps, walks=walks)
            said = f"{ended} ends, {cut} cut off"
        except Exception as problem:
            wrong, said = f"{type(problem).__name__}: {problem}", ""
            if not isinstance(problem, ValueError):
                wrong += " | " + traceback.format_exc().splitlines()[-2].strip()
        yield name, wrong, f"{said} ({time.process_time() - begin:.0f} s)"
        jax.clear_caches()


def main(words):
    packages = [x for x in words if x in PACKAGES] or list(PACKAGES)
    names = [x for x in words if x not in PACKAGES]
    for package in packages:
        for name, wrong, said in sweep(package, names):
            print(
                f"{package:10} {name:34} {'WRONG ' + wrong if wrong else 'same'}  {said}",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:])
