from .construct.batch import (
    lift_memory_policy as lift_memory_policy,
    stack_products as stack_products,
)
from .construct.convert import to_sparse as to_sparse
from .construct.padded import to_padded as to_padded
from .construct.counts import (
    TransitionCounts as TransitionCounts,
    model_from_counts as model_from_counts,
    align_counts as align_counts,
    make_counts as make_counts,
)
from .construct.lifting import (
    Controller as Controller,
    FiniteMemoryPolicy as FiniteMemoryPolicy,
    Policy as Policy,
    Progress as Progress,
    lift_policy as lift_policy,
    lift_trajectories as lift_trajectories,
    project_policy as project_policy,
    project_trajectories as project_trajectories,
)
from .construct.restrict import (
    Restriction as Restriction,
    restrict as restrict,
    with_allowed as with_allowed,
)
from .game import Game as Game, make_game as make_game
from .multiplayer import (
    MultiplayerGame as MultiplayerGame,
    make_multiplayer_game as make_multiplayer_game,
)
from .interval import (
    IntervalMDP as IntervalMDP,
    interval_rows as interval_rows,
    make_interval as make_interval,
)
from .mdp import (
    DenseMDP as DenseMDP,
    MDP as MDP,
    from_dense as from_dense,
    make_mdp as make_mdp,
    to_dense as to_dense,
)
from .mesh.lanes import on_host as on_host, vmap_over_mesh as vmap_over_mesh
from .mesh.shard import (
    ModelPart as ModelPart,
    from_mesh as from_mesh,
    model_from_parts as model_from_parts,
    shard as shard,
    to_mesh as to_mesh,
)
from .mesh.sharded import ShardedMDP as ShardedMDP
from .ops.operators import (
    exists_successor as exists_successor,
    expectation as expectation,
    forall_successor as forall_successor,
    pushforward as pushforward,
    sample_successor as sample_successor,
)
from .parametric import (
    ParametricMDP as ParametricMDP,
    make_parametric as make_parametric,
)
from .pomdp import POMDP as POMDP, belief_filter as belief_filter, make_pomdp as make_pomdp
from .product import Product as Product, occurring_letters as occurring_letters, product as product
from .sparse import (
    Rewards as Rewards,
    SparseMDP as SparseMDP,
    make_sparse as make_sparse,
    choice_reward as choice_reward,
)
from .trajectories import (
    Trajectories as Trajectories,
    make_trajectories as make_trajectories,
    rollout as rollout,
)
