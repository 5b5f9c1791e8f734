r"""Checks an entry: plays episodes of its policies again, and compares rows.

  python -m realab_suite.launchers.check --entry=entries/realab-1M/reward

At least 20 episodes are played, and one of each policy. On the machine of the
entry the rows are the same to the bit; elsewhere differences are listed.
"""

import pathlib

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.lab.experiments import threads
from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(flags.IMPORT, flags.ENTRY)

_DRAW = absl_flags.DEFINE_integer(
    'draw',
    None,
    'Number that the choice of episodes follows. Default: a new one each time.',
    lower_bound=0,
)


def main() -> None:
  """Checks the entry that the flags name."""
  why = '; must be the folder of an entry'
  folder = pathlib.Path(flags.required(flags.ENTRY, why))
  if problem := requirements.missing('pyarrow'):
    raise errors.SpecError(f'cannot read entries: {problem}')
  threads.use_one()
  flags.prepare()
  # Imports numerical libraries, so the number of threads has to be set first.
  from realab_suite.lab.experiments import entries

  entries.check(folder, _DRAW.value, program.say)
  program.say(f'{folder}: the rows are those of the policies')


if __name__ == '__main__':
  program.start(main)
