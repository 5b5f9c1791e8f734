"""Learners: agents that receive time steps and specs, and nothing else.

The launcher builds the environment, and passes its specs to the learner:

    env = suite.load_batch('unlock_door', 'near', num_envs=256, design=design)
    learner = agents.make(
        env.mechanism.design.learner,
        env.observation_spec(),
        env.action_spec(),
        num_envs=256,
        seed=1,
    )
    time_step = env.reset()
    while learner.num_steps < 1_000_000:
      time_step = env.step(learner.step(time_step))

Learners also run in other environments, if time steps have a leading axis of
worlds and observations contain the reading to learn from under
`registers/<name>` or `<name>`.

On two cores, two single-threaded processes give the highest throughput. XLA
reads its flags when jax is imported, so set them before:

    XLA_FLAGS="--xla_cpu_multi_thread_eigen=false"

Global JAX settings that change results, such as `jax_enable_x64`, do not affect
learners (`jax_settings.py`).
"""

from realab_suite.agents.approval import DecoupledApproval
from realab_suite.agents.approval import ValueAdvice
from realab_suite.agents.base import LEARNERS
from realab_suite.agents.base import Learner
from realab_suite.agents.base import make
from realab_suite.agents.base import options_of
from realab_suite.agents.behavioural_cloning import BehaviouralCloning
from realab_suite.agents.policy_gradient import PolicyGradient
from realab_suite.agents.q_learning import QLearning
