"""Lets a person act in a world, by keyboard and in first person.

  python -m realab_suite.launchers.play --task=near

The program prints the address of a page. The page shows the view of the avatar,
the observed and the true return side by side, and the contents of registers
beside their clean contents. After the last episode it shows the summary that
any agent gets, beside that of the solver of the task.
"""

from collections.abc import Sequence

from absl import flags

from realab_suite import errors
from realab_suite.experiments import requirements
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import output_flag
from realab_suite.launchers.flags import page_flags
from realab_suite.launchers.flags import seed_flag
from realab_suite.launchers.flags import world_flags

for module in (imports_flag, output_flag, page_flags, seed_flag, world_flags):
  flags.adopt_module_key_flags(module)


def main(argv: Sequence[str]) -> None:
  """Serves the page, and prints the summary."""
  del argv
  problem = (
      requirements.missing('websockets', 'PIL', extra='browser')
      or renderers.choose_renderer()
  )
  if problem is not None:
    raise errors.ResultsError(f'cannot show the world: {problem}')
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.experiments import played
  from realab_suite.feedback import specs
  from realab_suite.interop.browser import servers

  imports_flag.load()
  domain, task = world_flags.world()
  settings = played.Settings(
      domain,
      task,
      specs.load(world_flags.DESIGN.value, tuple(world_flags.SET.value)),
      seed_flag.SEED.value,
      page_flags.EPISODES.value,
      world_flags.MAX_STEPS.value,
      page_flags.RATE.value,
      world_flags.task_kwargs(),
      output_flag.OUTPUT.value,
  )
  host, port = page_flags.HOST.value, page_flags.PORT.value
  with servers.PageServer('play', host, port) as server:
    program.say(f'Open this address in a browser: {server.url}')
    played.play(settings, server, program.say)


if __name__ == '__main__':
  program.start(main)
