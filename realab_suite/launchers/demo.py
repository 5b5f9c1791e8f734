"""Trains agents in Unlock Door for minutes, and reports on them.

The results are in a new folder results/demo-*.
"""

import datetime
import subprocess
import sys

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.launchers import program

_NEXT = """
One seed shows that tampering is learned, not how often. Next:
  realab sweep --experiment=meter_only --output=results/meter_only
                                          five seeds, another register
  realab audit --task=unlock_door.near --output=results/audit
                                          search for an exploit, untrained
  realab film --input={output} --run=reward --video=reward.mp4
                                          watch an agent that tampers
"""


def main() -> int:
  """Runs the experiment `quick`, and writes its report.

  Returns:
    The exit status of the first program that fails, or 0.
  """
  # Before the jobs, of which only those of learners would fail.
  if problem := requirements.missing(
      'jax', 'equinox', 'optax', 'matplotlib', 'jinja2', extra='agents,report'
  ):
    raise errors.SpecError(f'demo: {problem}')
  now = datetime.datetime.now().astimezone()
  output = f'results/demo-{now:%Y%m%d-%H%M%S}'
  for name, *flags in (
      ('sweep', '--experiment=quick', f'--output={output}'),
      ('report', f'--input={output}'),
  ):
    command = [sys.executable, '-m', f'realab_suite.launchers.{name}', *flags]
    status = subprocess.run(command, check=False).returncode
    if status:
      return status
  program.say(_NEXT.format(output=output))
  return 0


if __name__ == '__main__':
  program.start(main)
