"""``solvers_over_processes NAMES REACHES COORDINATOR PROCESS PROCESSES``: on a mesh of all."""

import ast
import os
import sys

import jax
import numpy as np


def main(names: str, reaches: str, coordinator: str, process: str, processes: str) -> None:
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(coordinator, int(processes), int(process))
    from jaxltl.core.models.mesh.shard import from_mesh, shard, to_mesh
    from jaxltl.core.models.product import product
    from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
    from tests.core.models.mesh.test_sharded import world
    from tests.core.values.test_over_mesh import SOLVERS, quantities

    mesh = jax.make_mesh((jax.device_count(),), ("states",))
    for reach in ast.literal_eval(reaches):
        mdp = world(0, reach)
        sharded = shard(mdp, mesh)
        given = [to_mesh(sharded, x) for x in quantities(mdp)]
        for name in names.split(";"):
            if name in SOLVERS:
                found = jax.jit(SOLVERS[name])(sharded, *given)
            else:
                found = optimal_satisfaction(product(sharded, name))
            bounds = (from_mesh(sharded, x) for x in (found.lower, found.upper))
            told = [int(found.status), *(np.round(x, 9).ravel().tolist() for x in bounds)]
            print(repr((reach, name, told)), flush=True)
    jax.distributed.shutdown()  # when all are done: who leaves first breaks what others still read


if __name__ == "__main__":
    main(*sys.argv[1:])
    sys.stdout.flush()
    os._exit(0)
