"""Lets a person act in a world, by keyboard and in first person.

  python -m realab_suite.launchers.play --task=near

The program prints the address of a page. The page shows the view of the avatar,
the observed and the true return side by side, and the contents of registers
beside their clean contents. After the last episode it shows the summary that
any agent gets, beside that of the solver of the task.
"""

from realab_suite import errors
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(*flags.WORLD, *flags.PAGE, flags.IMPORT, flags.OUTPUT, flags.SEED)


def main() -> None:
  """Serves the page, and prints the summary."""
  if problem := renderers.why_no_page():
    raise errors.ResultsError(f'cannot show the world: {problem}')
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.experiments import played
  from realab_suite.interop.browser import servers

  flags.load_imports()
  settings = played.Settings(
      flags.world(),
      flags.design(),
      flags.SEED.value,
      flags.EPISODES.value or 1,
      flags.RATE.value,
      flags.OUTPUT.value,
  )
  host, port = flags.HOST.value, flags.PORT.value
  with servers.PageServer('play', host, port) as server:
    program.say(f'Open this address in a browser: {server.url}')
    played.play(settings, server, program.say)


if __name__ == '__main__':
  program.start(main)
