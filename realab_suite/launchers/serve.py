r"""Serves a world to an agent in another process, and evaluates the agent.

The agent needs dm_env_rpc and nothing of this package (docs/doors.md):

  python -m realab_suite.launchers.serve --task=unlock_door.near \
    --design=instantaneous_reward --seed=1 --episodes=5 \
    --address=unix:/tmp/realab/socket --output=results/mine

With --agent_command the program also starts the agent, and stops it at the end.
The environment of the agent contains the address and little else:

  python -m realab_suite.launchers.serve --task=unlock_door.near \
    --agent_command='python /path/to/agent.py' --output=results/mine

The same flags serve the same episodes. Episodes that an agent must not predict
need a secret seed, such as a random number of 128 bits in a --flagfile that the
agent cannot read. The rows contain the stakes of the design, which are measured
while the agent starts.
"""

import math
import os

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(*flags.WORLD, flags.SEED, flags.EPISODES, flags.IMPORT, flags.OUTPUT)
_ADDRESS = absl_flags.DEFINE_string(
    'address',
    None,
    'Address to listen on: unix:/folder/name, or host:port for programs on this'
    ' machine. Default: a socket in a new folder.',
)
_IDLE_SECONDS = absl_flags.DEFINE_float(
    'idle_seconds',
    60.0,
    'Time without a request after which an agent is disconnected, in seconds.',
    lower_bound=0.1,
    upper_bound=1e6,
)
_AGENT_COMMAND = absl_flags.DEFINE_string(
    'agent_command',
    None,
    'Command that starts the agent. The address is in the environment variable'
    ' REALAB_ADDRESS.',
)


def main() -> None:
  """Serves the world that the flags describe."""
  output = flags.required(flags.OUTPUT, '; name a folder for the results')
  problem = requirements.missing('dm_env_rpc', 'grpc', extra='rpc')
  if problem is not None:
    raise errors.SpecError(problem)
  if math.isnan(_IDLE_SECONDS.value):  # It is within any bounds.
    raise errors.SpecError(f'--{_IDLE_SECONDS.name}=nan; must be a number')
  flags.prepare()
  # gRPC reads this once. The server never forks without executing another
  # program at once.
  os.environ['GRPC_ENABLE_FORK_SUPPORT'] = '0'
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.doors.served import served_evaluation

  flags.design()  # Refuses a wrong one before anything is served.
  settings = served_evaluation.Settings(
      world=flags.world(),
      design=flags.DESIGN.value or flags.DEFAULT_DESIGN,
      overrides=tuple(flags.SET.value),
      seed=flags.SEED.value,
      num_episodes=flags.num_episodes(),
      address=_ADDRESS.value,
      idle_seconds=_IDLE_SECONDS.value,
      agent_command=_AGENT_COMMAND.value,
      output=output,
  )
  served_evaluation.serve(settings, program.say)


if __name__ == '__main__':
  program.start(main)
