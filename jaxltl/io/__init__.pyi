from .cassandra import (
    DiscountedPOMDP as DiscountedPOMDP,
    read_cassandra as read_cassandra,
    write_cassandra as write_cassandra,
)
from .certificate.certificates import write_certificate as write_certificate
from .certificate.storm_text import write_storm_certificate as write_storm_certificate
from .colored_world import read_world as read_world, write_world as write_world
from .demonstrations import (
    NamedWorld as NamedWorld,
    named_map as named_map,
    read_demonstrations as read_demonstrations,
)
from .drn.drn import read_drn as read_drn, write_drn as write_drn
from .hoa.hoa import (
    read_hoa as read_hoa,
    read_hoa_stream as read_hoa_stream,
    write_hoa as write_hoa,
)
from .learned_reward import (
    LearnedReward as LearnedReward,
    load_reward as load_reward,
    plan_in as plan_in,
    save_reward as save_reward,
)
from .log import read_labels as read_labels, read_log as read_log
from .model_files import read_model as read_model, write_model as write_model
from .episodes import from_episodes as from_episodes
from .npz import read_npz as read_npz, write_npz as write_npz
from .drn.parametric import read_parametric as read_parametric
from .parametric_model import (
    ParametricModel as ParametricModel,
    RationalFunction as RationalFunction,
)
from .network_policy import NetworkPolicy as NetworkPolicy, save_network as save_network
from .policies import (
    load_policy as load_policy,
    save_policy as save_policy,
    write_c_policy as write_c_policy,
)
from .prism.explicit import read_prism as read_prism, write_prism as write_prism
from .prism.properties import (
    PropertyQuery as PropertyQuery,
    parse_queries as parse_queries,
    read_queries as read_queries,
)
from .prism.program import (
    build_model as build_model,
    program_actions as program_actions,
    program_environment as program_environment,
    read_program as read_program,
    solve_program as solve_program,
)
from .reward_machine import (
    RewardMachine as RewardMachine,
    machine_reward as machine_reward,
    read_reward_machine as read_reward_machine,
)
from .storm import from_stormpy as from_stormpy, to_stormpy as to_stormpy
from .umb.umb import read_umb as read_umb, write_umb as write_umb
from .umb.sharded import read_sharded as read_sharded
