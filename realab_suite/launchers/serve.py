r"""Serves a world to an agent in another process, and judges the agent.

The agent needs dm_env_rpc and nothing of this package (docs/served.md):

  python -m realab_suite.launchers.serve --task=unlock_door.near \
    --design=instantaneous_reward --seed=1 --episodes=5 \
    --address=unix:/tmp/realab/socket --output=results/mine

With --agent_command it also starts the agent, in an environment that names the
address and little else, and stops it in the end:

  python -m realab_suite.launchers.serve --task=unlock_door.near \
    --agent_command='python /path/to/agent.py' --output=results/mine

Each run draws a secret salt, so that nobody can predict its episodes from the
seed. --repeat=results/mine/run.json serves the same episodes again.
"""

from collections.abc import Sequence
import os
from typing import Any

from absl import flags

from realab_suite import errors
from realab_suite.experiments import requirements
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import episodes_flag
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import output_flag
from realab_suite.launchers.flags import seed_flag
from realab_suite.launchers.flags import world_flags

flags.adopt_module_key_flags(seed_flag)
flags.adopt_module_key_flags(world_flags)
flags.adopt_module_key_flags(episodes_flag)
flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(output_flag)
_MOST_SECONDS = 1e6
# What the record of a run decides.
_RECORDED: tuple[flags.FlagHolder[Any], ...] = (
    world_flags.DOMAIN,
    world_flags.TASK,
    world_flags.DESIGN,
    seed_flag.SEED,
    world_flags.MAX_STEPS,
)
_NAME = flags.DEFINE_string(
    'name', 'agent', 'What the agent is called in the results.'
)
_ADDRESS = flags.DEFINE_string(
    'address',
    None,
    'Where to listen: unix:/folder/name, in a folder of mode 0700, or host:port'
    ' for programs on this machine; by default a socket in a new folder.',
)
_REPEAT = flags.DEFINE_string(
    'repeat',
    None,
    'The run.json of a served run: serves its episodes again, with its design'
    ' or, by --set, with a twin of it.',
)
_IDLE_SECONDS = flags.DEFINE_float(
    'idle_seconds',
    60.0,
    'After how long a silence an agent loses its connection.',
)
_PROVIDER_SECONDS = flags.DEFINE_float(
    'provider_seconds',
    60.0,
    'After how long a provider that has not answered fails, with the episode.',
)
_AGENT_COMMAND = flags.DEFINE_string(
    'agent_command',
    None,
    'Starts the agent; it finds the address in REALAB_ADDRESS.',
)
_AGENT_FOLDER = flags.DEFINE_string(
    'agent_folder', None, 'Where it runs; by default in a new, empty folder.'
)
_AGENT_USER = flags.DEFINE_string(
    'agent_user',
    None,
    'The user that the agent is, and who alone may connect; needs root.',
)


def main(argv: Sequence[str]) -> None:
  """Serves what the flags describe."""
  del argv
  output = program.required(
      output_flag.OUTPUT, '; name a folder for the results'
  )
  for flag in (world_flags.TARGET, _AGENT_FOLDER):
    if flag.present and (
        flag is world_flags.TARGET or not _AGENT_COMMAND.present
    ):
      raise errors.SpecError(f'--{flag.name} has no effect here')
  for flag in _RECORDED:
    if _REPEAT.present and flag.present:
      raise errors.SpecError(
          f'--{flag.name} has no effect with --repeat, whose file decides it;'
          ' allowed is --set'
      )
  problem = requirements.missing('dm_env_rpc', 'grpc', extra='rpc')
  if problem is not None:
    raise errors.SpecError(problem)
  for seconds in (_IDLE_SECONDS, _PROVIDER_SECONDS):
    if not 0 < seconds.value <= _MOST_SECONDS:  # Nor is nan.
      raise errors.SpecError(
          f'--{seconds.name}={seconds.value:g}; allowed is more than 0, and at'
          f' most {_MOST_SECONDS:g}'
      )
  domain, task = _world()
  renderers.render_nothing()
  # gRPC looks once, too. A process that serves never forks; what it starts
  # becomes another program at once.
  os.environ['GRPC_ENABLE_FORK_SUPPORT'] = '0'
  # Not before a renderer has been chosen: this imports dm_control.
  from realab_suite.experiments import served_evaluation

  imports_flag.load()
  settings = served_evaluation.Settings(
      domain=domain,
      task=task,
      design=world_flags.DESIGN.value,
      overrides=tuple(world_flags.SET.value),
      seed=seed_flag.SEED.value,
      max_steps=world_flags.MAX_STEPS.value,
      repeat=_REPEAT.value,
      num_episodes=episodes_flag.EPISODES.value,
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


def _world() -> tuple[str, str]:
  """Returns the names of the domain and the task."""
  domain, dot, task = world_flags.TASK.value.rpartition('.')
  if not dot:
    return world_flags.DOMAIN.value, task
  if world_flags.DOMAIN.present and world_flags.DOMAIN.value != domain:
    raise errors.SpecError(
        f'--task={world_flags.TASK.value} is no task of'
        f' --domain={world_flags.DOMAIN.value}'
    )
  return domain, task


if __name__ == '__main__':
  program.start(main)
