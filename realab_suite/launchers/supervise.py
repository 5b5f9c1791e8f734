r"""Lets a person provide the feedback of an agent, in a browser.

  python -m realab_suite.launchers.supervise --task=near --policy=random \
    --asks=approval --output=results/supervised

The program prints the address of a page, on which the person approves actions,
corrects them or compares two clips, and may stop the episode. The output gets
the answers (`answers.jsonl`), the design, and the results of the episodes. The
option `recorded` of the provider `person` repeats the answers. The agent is not
judged: a person would have to answer again for a control.
"""

import contextlib

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(
    *flags.WORLD,
    flags.TARGET,
    flags.EPISODES,
    flags.IMPORT,
    flags.OUTPUT,
    flags.POLICY,
    flags.SEED,
)
_ASKS = absl_flags.DEFINE_enum(
    'asks',
    'approval',
    ['approval', 'correction', 'comparison'],
    'Question to the person. A design of --design has questions of its own.',
)
_WAIT = absl_flags.DEFINE_boolean(
    'wait',
    False,
    'Waits for every answer. Otherwise the episode continues without, and the'
    ' provider is silent.',
)


def main() -> None:
  """Serves the page, and writes the answers."""
  output = flags.required(flags.OUTPUT, '; name a folder for the answers')
  for flag in (_ASKS, _WAIT):
    if flags.DESIGN.value and flag.present:
      raise errors.SpecError(
          f'--{flag.name}: without effect beside --design, whose providers'
          ' have `asks` and `waits`; leave one of both out'
      )
  problem = requirements.missing('websockets', 'PIL', extra='browser')
  if problem := problem or renderers.choose_renderer():
    raise errors.ResultsError(f'cannot show the world: {problem}')
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.doors.browser import servers
  from realab_suite.doors.browser import supervised
  from realab_suite.doors.browser import supervised_designs
  from realab_suite.lab.audit import aiming
  from realab_suite.lab.experiments import storage

  flags.load_imports()
  world = flags.world()
  design_source = (
      flags.DESIGN.value
      if flags.DESIGN.value
      else supervised_designs.design(
          _ASKS.value,
          waits=_WAIT.value,
          action_set=world.action_set,
      )
  )
  design = flags.design(design_source)
  with contextlib.ExitStack() as stack:
    env = world.load(design, flags.SEED.value)
    stack.enter_context(contextlib.closing(env))
    name = flags.POLICY.value or flags.RANDOM
    policy = aiming.make_policy(name, env, flags.TARGET.value, 0)
    server = stack.enter_context(contextlib.closing(servers.PageServer()))
    folder = storage.new_folder(output)
    supervision = supervised.Supervision(env, server, folder)
    stack.callback(supervision.close)
    program.say(f'Open this address in a browser: {server.url}')
    num_episodes = flags.EPISODES.value or 1
    supervision.supervise(world, name, policy, num_episodes, program.say)


if __name__ == '__main__':
  program.start(main)
