r"""Writes the scorecard of a suite: worlds x designs, in one table and picture.

  python -m realab_suite.launchers.scorecard --experiment=own \
    --output=results/own

This runs the jobs of the experiment that are missing, as `sweep` does and with
its flags, and then writes scorecard.md, .csv and .svg into the folder.
With --input instead of --experiment, nothing is run:

  python -m realab_suite.launchers.scorecard --output=results/card \
    --input=docs/results/own,results/my_agent --accept_other_code
"""

import pathlib

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import sweep

flags.take(flags.INPUT)
absl_flags.adopt_module_key_flags(sweep)


def main() -> None:
  """Writes the scorecard that the flags describe."""
  inputs = [pathlib.Path(one) for one in (flags.INPUT.value or '').split(',')]
  if bool(flags.INPUT.value) == bool(flags.EXPERIMENT.value):
    raise errors.SpecError(
        '--input, --experiment: give one of them: folders with results,'
        ' or an experiment to run'
    )
  if absl_flags.FLAGS[flags.INPUT.name].present > 1:
    raise errors.SpecError(
        '--input: given twice; give one list, such as --input=one,two'
    )
  if problem := requirements.missing('matplotlib'):
    raise errors.SpecError(f'cannot write a scorecard: {problem}')
  if flags.EXPERIMENT.value:
    sweep.main()
    inputs = [pathlib.Path(flags.OUTPUT.value)]
  flags.prepare()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.reports import scorecard_pages
  from realab_suite.reports import scorecards

  card = scorecards.make(inputs, flags.ACCEPT_OTHER_CODE.value)
  output = pathlib.Path(flags.OUTPUT.value or inputs[0])
  program.say(scorecard_pages.write(card, output))
  program.say(f'The scorecard of suite {card.version} is in {output}')


if __name__ == '__main__':
  program.start(main)
