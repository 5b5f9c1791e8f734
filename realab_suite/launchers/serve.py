r"""Serves a world to an agent in another process, and evaluates the agent.

The agent needs dm_env_rpc and nothing of this package (docs/doors.md):

  python -m realab_suite.launchers.serve --task=unlock_door.near \
    --design=instantaneous_reward --seed=1 --episodes=5 \
    --address=unix:/tmp/realab/socket --output=results/mine

With --agent_command the program also starts the agent, and stops it at the end.
The environment of the agent contains the address and little else:

  python -m realab_suite.launchers.serve --task=unlock_door.near \
    --agent_command='python /path/to/agent.py' --output=results/mine

Each run draws a secret salt, so its episodes cannot be predicted from the seed.
--repeat=results/mine/run.json serves the same episodes again. The rows contain
the stakes of the design, which are measured while the agent starts.
"""

import os

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(*flags.WORLD, flags.SEED, flags.EPISODES, flags.IMPORT, flags.OUTPUT)
_MOST_SECONDS = 1e6
# Settings that the record of a run determines.
_RECORDED = [
    flag for flag in (*flags.WORLD, flags.SEED) if flag is not flags.SET
]
_NAME = absl_flags.DEFINE_string(
    'name', 'agent', 'Name of the agent in the results.'
)
_ADDRESS = absl_flags.DEFINE_string(
    'address',
    None,
    'Address to listen on: unix:/folder/name, in a folder of mode 0700, or'
    ' host:port for programs on this machine. Default: a socket in a new'
    ' folder.',
)
_REPEAT = absl_flags.DEFINE_string(
    'repeat',
    None,
    'File run.json of a served run, whose episodes are served again, with the'
    ' same design or, with --set, a twin of it.',
)
_IDLE_SECONDS = absl_flags.DEFINE_float(
    'idle_seconds',
    60.0,
    'Time without a request after which an agent is disconnected, in seconds.',
)
_PROVIDER_SECONDS = absl_flags.DEFINE_float(
    'provider_seconds',
    60.0,
    'Time limit of a provider for one step, in seconds. The episode fails if it'
    ' is exceeded.',
)
_AGENT_COMMAND = absl_flags.DEFINE_string(
    'agent_command',
    None,
    'Command that starts the agent. The address is in the environment variable'
    ' REALAB_ADDRESS.',
)
_AGENT_FOLDER = absl_flags.DEFINE_string(
    'agent_folder',
    None,
    'Working directory of the agent. Default: a new, empty folder.',
)
_AGENT_USER = absl_flags.DEFINE_string(
    'agent_user',
    None,
    'User that the agent runs as; no other user may connect. Needs root.',
)


def main() -> None:
  """Serves the world that the flags describe."""
  output = flags.required(flags.OUTPUT, '; name a folder for the results')
  if _AGENT_FOLDER.present and not _AGENT_COMMAND.present:
    raise errors.SpecError('--agent_folder has no effect here')
  for flag in _RECORDED:
    if _REPEAT.present and flag.present:
      raise errors.SpecError(
          f'--{flag.name} has no effect with --repeat, whose file sets it;'
          ' allowed is --set'
      )
  problem = requirements.missing('dm_env_rpc', 'grpc', extra='rpc')
  if problem is not None:
    raise errors.SpecError(problem)
  for seconds in (_IDLE_SECONDS, _PROVIDER_SECONDS):
    if not 0 < seconds.value <= _MOST_SECONDS:  # Rejects NaN as well.
      raise errors.SpecError(
          f'--{seconds.name}={seconds.value:g}; allowed is more than 0, and at'
          f' most {_MOST_SECONDS:g}'
      )
  flags.domain_and_task()  # Raises errors before slow imports.
  renderers.render_on_demand()
  # gRPC reads this once. The server never forks without executing another
  # program at once.
  os.environ['GRPC_ENABLE_FORK_SUPPORT'] = '0'
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.experiments import served_evaluation

  flags.load_imports()
  settings = served_evaluation.Settings(
      world=flags.world(),
      design=flags.DESIGN.value,
      overrides=tuple(flags.SET.value),
      seed=flags.SEED.value,
      repeat=_REPEAT.value,
      num_episodes=flags.num_episodes(),
      name=_NAME.value,
      address=_ADDRESS.value,
      idle_seconds=_IDLE_SECONDS.value,
      provider_seconds=_PROVIDER_SECONDS.value,
      agent_command=_AGENT_COMMAND.value,
      agent_folder=_AGENT_FOLDER.value,
      agent_user=_AGENT_USER.value,
      output=output,
  )
  served_evaluation.serve(settings, program.say)


if __name__ == '__main__':
  program.start(main)
