"""The command `realab`, whose subcommands are the launchers.

  realab sweep --experiment=quick --output=results/quick

is short for `python -m realab_suite.launchers.sweep` with the same flags.
"""

from collections.abc import Mapping
import os
import runpy
import sys

from realab_suite import _versions
from realab_suite.config import messages
from realab_suite.launchers import program

_LAUNCHERS = 'realab_suite.launchers.'
COMMANDS: Mapping[str, str] = {
    'demo': 'train an agent that tampers, in minutes, and film it',
    'doctor': 'say what works in this installation',
    'audit': 'search for an exploit of a design, without training',
    'check': 'check an entry by playing episodes again',
    'compare': 'compare scripted policies',
    'explore': 'look at a world',
    'export': 'write episodes of a run as data',
    'film': 'film an episode of a learner',
    'label': 'make a labelled dataset of tampering',
    'publish': 'publish the results of a sweep in small files',
    'report': 'write the report of a sweep',
    'scorecard': 'write the scorecard of a suite',
    'serve': 'serve a world to an agent in another process',
    'stake': 'measure what a design is worth to its learner',
    'supervise': 'give feedback as a person',
    'sweep': 'run all jobs of an experiment',
    'train': 'run one job',
}
"""Subcommands with their purposes."""


def main() -> int:
  """Runs the subcommand that the command line names.

  Returns:
    The exit status; launchers end the process with theirs.
  """
  _, *arguments = sys.argv
  if len(arguments) == 2 and arguments[0] == 'help':
    arguments = [arguments[1], '--help']
  if not arguments or arguments[0] in ('help', '-h', '--help'):
    sys.stdout.write(_usage())
    return 0 if arguments else program.USAGE_ERROR
  name, *rest = arguments
  if name == '--version':
    sys.stdout.write(f'realab_suite {_versions.VERSION}\n')
    return 0
  if name not in COMMANDS:
    hint = messages.did_you_mean(name, (*COMMANDS, 'help', '--version'))
    return _refuse(
        f'command {name!r:.80} is unknown{hint}; known are' f' {list(COMMANDS)}'
    )
  module = _LAUNCHERS + name
  # As `python -m` does, so that --help, --import of modules in the working
  # directory, and the start of processes work.
  if not sys.flags.safe_path:
    sys.path.insert(0, os.getcwd())
  sys.argv = [name, *rest]
  runpy.run_module(module, run_name='__main__', alter_sys=True)
  return 0


def _usage() -> str:
  lines = [f'  {name:14} {purpose}' for name, purpose in COMMANDS.items()]
  return '\n'.join(
      (
          'usage: realab COMMAND [--flag=value ...]',
          *lines,
          "`realab COMMAND --help` lists the command's flags.\n",
      )
  )


def _refuse(problem: str) -> int:
  sys.stderr.write(f'error: {problem}\n')
  return program.USAGE_ERROR
