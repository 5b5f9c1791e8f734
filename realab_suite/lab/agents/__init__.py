"""Learners: agents that receive time steps and specs, and nothing else.

`make` makes the learner of a design. It runs in any environment whose time
steps have a leading axis of worlds and whose observations contain the reading
to learn from under `registers/<name>` or `<name>`.

On two cores, two single-threaded processes give the highest throughput. XLA
reads its flags when jax is imported, so set them before:

    XLA_FLAGS="--xla_cpu_multi_thread_eigen=false"
"""

from realab_suite.lab.agents.approval import DecoupledApproval
from realab_suite.lab.agents.approval import ValueAdvice
from realab_suite.lab.agents.base import LEARNERS
from realab_suite.lab.agents.base import Learner
from realab_suite.lab.agents.behavioural_cloning import BehaviouralCloning
from realab_suite.lab.agents.factory import check
from realab_suite.lab.agents.factory import is_of_package
from realab_suite.lab.agents.factory import make
from realab_suite.lab.agents.factory import options_of
from realab_suite.lab.agents.policy_gradient import PolicyGradient
from realab_suite.lab.agents.q_learning import QLearning
